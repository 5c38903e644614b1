"""What benchmarks share: settings, results, timing, trials and shares.

No module here has the name of one in the standard library: `judo_side` runs as a script.
"""
