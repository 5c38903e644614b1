"""The hands dexctl knows by name: the built-in dex5, and others loaded from their own files."""

from dexctl.hands.registry import check, config, is_own, load, names

__all__ = ["check", "config", "is_own", "load", "names"]
