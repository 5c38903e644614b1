"""The version that is installed; apart, because looking it up is a third of `import dexctl`."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("dexctl")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"
