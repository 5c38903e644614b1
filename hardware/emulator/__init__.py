"""Emulated Dynamixel servos on a pseudo-terminal: the whole stack without a hand at hand.

>>> from hardware.emulator import Emulator
>>> with Emulator(servos=15) as emulator:  # doctest: +SKIP
...     print(emulator.port)
"""

from hardware.emulator.client import Emulator

__all__ = ["Emulator"]
