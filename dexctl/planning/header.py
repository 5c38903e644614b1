"""TreeHeader: what a tree is of, how it was grown, and what came of its expansions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.planning.scene_settings import PHYSICS
from dexctl.settings import absolute, difference, differing, from_plain, get, to_plain
from dexctl.sim import SceneConfig
from dexctl.validation import shown

if TYPE_CHECKING:
    from dexctl.sim import Scene


FORMAT = 1
_SAME = (
    "hand", "joint_names", "object", "object_width", "object_mass", "gravity", "axis",
    "expansion", "action_names",
)  # fmt: skip


def _text(value: object) -> bool:
    return isinstance(value, str)


def _texts(value: object) -> bool:
    return isinstance(value, (list, tuple)) and all(map(_text, value))


def _amount(value: object) -> bool:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return False
    return 0 <= value < math.inf


def _whole(value: object) -> bool:
    return isinstance(value, int) and _amount(value)


def _counts(value: object) -> bool:
    return isinstance(value, dict) and all(map(_whole, value.values()))


def _vector(value: object) -> bool:
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        return False
    return all(isinstance(one, (int, float)) and math.isfinite(one) for one in value)


def _direction(value: Any) -> bool:
    return _vector(value) and abs(math.hypot(*value) - 1.0) < 1e-6


def _mapping(value: object) -> bool:
    return isinstance(value, dict)


_RIGHT: dict[str, Callable[[Any], bool]] = {
    "hand": _text, "joint_names": _texts, "object": _text, "object_width": _amount,
    "object_mass": _amount, "gravity": _vector, "axis": _direction, "expansion": _text,
    "action_names": _texts, "settings": _mapping, "versions": _mapping, "seed": _whole,
    "scene": lambda value: value is None or _mapping(value), "expansions": _whole,
    "refused": _counts, "physics_steps": _whole, "seconds": _amount,
}  # fmt: skip
"""What each entry may be."""


@dataclass(kw_only=True)
class TreeHeader:
    """What stands in a tree's file beside its arrays.

    Attributes:
        hand: its name.
        joint_names: in the order of ``q``.
        object: its name.
        object_width: [m].
        object_mass: [kg].
        gravity: ``(3,)`` [m/s^2].
        axis: of the rotation, unit.
        expansion: the way of expanding, by its class.
        action_names: what the columns of the actions are.
        settings: of expansion, metric, bounds, stability and goals, by name.
        versions: of dexctl, MuJoCo and numpy.
        seed: of its random numbers.
        scene: of `SceneConfig`, where the scene was built from one.
        expansions: how many were tried.
        refused: why candidates were not taken in, and how many.
        physics_steps: that were simulated.
        seconds: wall time that it took [s].
    """

    hand: str
    joint_names: tuple[str, ...]
    object: str
    object_width: float
    object_mass: float
    gravity: tuple[float, ...]
    axis: tuple[float, ...]
    expansion: str
    action_names: tuple[str, ...]
    settings: dict[str, Any]
    versions: dict[str, str]
    seed: int
    scene: dict[str, Any] | None = None
    expansions: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    physics_steps: int = 0
    seconds: float = 0.0

    @classmethod
    def of(
        cls,
        scene: Scene,
        axis: np.ndarray,
        expansion: str,
        action_names: Sequence[str],
        settings: Mapping[str, Any],
        seed: int,
    ) -> TreeHeader:
        """Of a tree that is about to be grown."""
        return cls(
            hand=scene.hand.name,
            joint_names=tuple(scene.hand.joint_names),
            object=scene.object,
            object_width=float(scene.object_width),
            object_mass=float(scene.object_mass),
            gravity=tuple(scene.gravity.tolist()),
            axis=tuple(np.asarray(axis, float).tolist()),
            expansion=expansion,
            action_names=tuple(action_names),
            settings=dict(settings),
            versions={name: version(name) for name in ("dexctl", "mujoco", "numpy")},
            seed=int(seed),
        )

    def build_scene(self) -> Scene:
        """The scene that the tree is of: as it was configured, else by what the header says.

        Raises:
            InvalidInput, UnknownName: it cannot be built, or is of another hand or object.
        """
        from dexctl.sim import Scene

        if self.scene is None:
            return Scene.build(
                self.hand,
                self.object,
                self.gravity,
                object_mass=self.object_mass,
                object_size=self.object_width or None,
            )
        scenes = from_plain(SceneConfig, self.scene).scenes()
        found = [(scene.hand.name, scene.object) for scene in scenes]
        if found != [(self.hand, self.object)]:
            raise InvalidInput(
                f"the tree is of the hand {self.hand!r} and the object {self.object!r}, the scene "
                f"in its header of {found}; expected the same"
            )
        return scenes[0]

    def to_plain(self) -> dict[str, Any]:
        """Plain values, for a file."""
        return {"format": FORMAT, **asdict(self)}

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> TreeHeader:
        """From what `to_plain` gave.

        Raises:
            InvalidInput: it is of another format, something is missing or what it cannot be.
            UnknownName: no such object.
        """
        if not isinstance(values, Mapping) or values.get("format") != FORMAT:
            found = values.get("format") if isinstance(values, Mapping) else None
            raise InvalidInput(f"its format is {found}; expected {FORMAT}")
        rest = {name: value for name, value in values.items() if name != "format"}
        known = set(cls.__dataclass_fields__)
        if set(rest) != known:
            odd = ", ".join(sorted(set(rest) ^ known))
            raise InvalidInput(f"its header has other entries than expected: {odd}")
        for name, right in _RIGHT.items():
            if not right(rest[name]):
                raise InvalidInput(
                    f"{name} of its header is {shown(rest[name])}, which it cannot be"
                )
        SceneConfig(object=(rest["object"],)).check_objects("its header")
        for name in ("joint_names", "gravity", "axis", "action_names"):
            rest[name] = tuple(rest[name])
        return cls(**rest)

    def check_same(self, other: TreeHeader) -> None:
        """Raise InvalidInput where the two are not of one hand, object, gravity and expansion.

        Nor, where both know their scene's configuration, of one friction, servos and time steps.
        """
        for name in _SAME:
            mine, theirs = getattr(self, name), getattr(other, name)
            if name in ("object_width", "object_mass", "gravity", "axis"):
                same = np.shape(mine) == np.shape(theirs) and np.allclose(mine, theirs, atol=1e-9)
            else:
                same = mine == theirs
            if not same:
                raise InvalidInput(f"the tree is of the {name} {mine!r}; expected {theirs!r}")
        if self.scene is None or other.scene is None:
            return
        usual = to_plain(SceneConfig())
        for name in PHYSICS:  # files of earlier versions may lack what there was not
            mine, theirs = (one.get(name, usual[name]) for one in (self.scene, other.scene))
            if mine != theirs:
                raise InvalidInput(f"the tree is of the {name} {mine!r}; expected {theirs!r}")

    def check_settings(self, settings: Mapping[str, Any]) -> None:
        """Raise InvalidInput where the tree was grown with other settings than these.

        Args:
            settings: configurations, by their names in ``settings``.
        """
        for what, now in settings.items():
            try:
                before = from_plain(type(now), self.settings[what], what)
            except (KeyError, InvalidInput, UnknownName) as error:
                raise InvalidInput(
                    f"the tree's settings are not of this version: {error}"
                ) from None
            here = Path.cwd()  # files may be named from it
            before, now = absolute(before, here), absolute(now, here)
            for path in differing(before, now):
                raise InvalidInput(
                    f"the tree was grown with {what}.{path} {get(before, path)}, not "
                    f"{get(now, path)}; expected the same to go on with it, or a new tree"
                )

    def check_same_settings(self, other: TreeHeader) -> None:
        """Raise InvalidInput where the two were grown with other settings, of those both know.

        Files of earlier versions lack what there was not; of a merged tree one header is left, by
        which its nodes are held and followed.
        """
        mine, theirs = self.settings, other.settings
        found = difference(_shared(theirs, mine), _shared(mine, theirs))
        if found is not None:
            raise InvalidInput(f"the trees have different settings: {found}; expected the same")

    @classmethod
    def sum(cls, headers: Sequence[TreeHeader]) -> TreeHeader:
        """Of trees that are merged: what was counted is added up."""
        refused: dict[str, int] = {}
        for header in headers:
            for why, count in header.refused.items():
                refused[why] = refused.get(why, 0) + count
        return replace(
            headers[0],
            expansions=sum(header.expansions for header in headers),
            physics_steps=sum(header.physics_steps for header in headers),
            seconds=max(header.seconds for header in headers),
            refused=refused,
        )


def _shared(some: Any, others: Any) -> Any:
    """What ``some`` says under the names that ``others`` have too."""
    if not (isinstance(some, Mapping) and isinstance(others, Mapping)):
        return some
    return {name: _shared(some[name], others[name]) for name in some if name in others}
