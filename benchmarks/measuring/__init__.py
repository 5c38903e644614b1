"""What benchmarks share: settings, results, timing, trials and statistics."""
