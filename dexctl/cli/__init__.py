"""The ``dexctl`` command."""

from dexctl.cli.app import main

__all__ = ["main"]
