"""The errors dexctl raises: each names the value it met and the ones it would have taken."""

from __future__ import annotations

from collections.abc import Iterable


class DexctlError(Exception):
    """Base of every error that dexctl raises on purpose."""


class InvalidInput(DexctlError, ValueError):
    """An argument has the wrong shape, range or kind, or is not finite."""


class UnknownName(DexctlError, LookupError):
    """A name is not in the list that it was looked up in.

    Attributes:
        kind: what was looked up ("hand", "object", ...).
        name: the name that was not found.
        known: the names that would have been found.
    """

    def __init__(self, kind: str, name: object, known: Iterable[str]) -> None:
        self.kind = kind
        self.name = name
        self.known = tuple(known)
        super().__init__(f"unknown {kind} {name!r}; known: {', '.join(self.known) or 'none'}")


class HandModelError(DexctlError, ValueError):
    """A hand description cannot be made into a HandModel."""


class MissingExtra(DexctlError, ImportError):
    """A feature needs packages that the core install leaves out."""

    def __init__(self, feature: str, extra: str) -> None:
        self.feature = feature
        self.extra = extra
        super().__init__(f"{feature} needs the extra: pip install 'dexctl[{extra}]'")


class SimulationError(DexctlError, RuntimeError):
    """A simulated scene cannot be built, stepped or restored."""


class RoomShadowed(DexctlError, ImportError):
    """Another package of the name of one of dexctl's is found before it."""
