"""The hands dexctl knows by name: the built-in dex5, and others loaded from their own files."""

from dexctl.hands.registry import HandEntry, entry, load, names

__all__ = ["HandEntry", "entry", "load", "names"]
