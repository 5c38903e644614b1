"""Controllers on real servo hands: bus, driver, runner, logs, and an emulator of all of it.

Start with `hardware.hand.ServoHand` and `hardware.runner.Runner`, or `dexctl hardware --help`.
"""
