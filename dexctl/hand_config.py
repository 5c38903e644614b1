"""HandConfig: all that is said of a hand beside its description file; what a my_hand.toml holds."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.description.tree import FARTHEST
from dexctl.exceptions import HandModelError, InvalidInput, UnknownName
from dexctl.state import Floats
from dexctl.validation import check_name, number, numbers, shown

if TYPE_CHECKING:
    from dexctl.hand import HandModel

MENAGERIE = "menagerie:"
"""What the name of a file of the MuJoCo menagerie begins with."""

SERVO_SETTINGS = ("stiffness", "damping", "effort", "velocity")

Vector3 = tuple[float, float, float]
ByJoint = float | dict[str, float] | None


def _check(
    name: str,
    value: object,
    expected: str,
    low: float = -sys.float_info.max,
    high: float = sys.float_info.max,
    *,
    above: bool = False,
) -> None:
    """Raise HandModelError where ``value`` is no number from ``low``, or above it, to ``high``."""
    try:
        number(name, value, low, high, expected, above=above)
    except InvalidInput as error:
        raise HandModelError(str(error)) from None


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    """``value``; HandModelError where it is not by names."""
    if not isinstance(value, Mapping):
        raise HandModelError(f"{name} is {shown(value)}; expected values by names")
    return value


@dataclass(frozen=True, kw_only=True)
class PalmConfig:
    """How the hand sits in the description file's world frame."""

    axis: Vector3 = (0.0, 0.0, 1.0)
    """Where the palm looks, in the file's world frame; of any length. z of the hand's frame."""
    up: Vector3 = (1.0, 0.0, 0.0)
    """Where the stretched fingers point, in the file's world frame; x of the hand's frame when it
    is made perpendicular to `axis`."""

    def __post_init__(self) -> None:
        for name in ("axis", "up"):
            try:
                vector = numbers(name, getattr(self, name), "")
            except InvalidInput:
                vector = np.zeros(0)
            if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
                raise HandModelError(
                    f"palm.{name} is {shown(getattr(self, name))}; expected three finite numbers, "
                    "not all zero"
                )
        axis, up = (np.asarray(v, float) / np.linalg.norm(v) for v in (self.axis, self.up))
        if np.linalg.norm(np.cross(axis, up)) < 1e-3:
            raise HandModelError(
                f"palm.up is {self.up!r}, along palm.axis, {self.axis!r}; expected where the "
                "fingers point, which is another direction"
            )

    @property
    def rotation(self) -> Floats:
        """From the file's world frame into the hand's ``(3, 3)``: z is `axis`, x `up`."""
        z = np.asarray(self.axis, float) / np.linalg.norm(self.axis)
        up = np.asarray(self.up, float) / np.linalg.norm(self.up)
        x = up - (up @ z) * z
        x /= np.linalg.norm(x)
        return np.array([x, np.cross(z, x), z])


@dataclass(frozen=True, kw_only=True)
class ServoConfig:
    """The servos of the joints: one number for all, a table by joint, or none: as in the file."""

    stiffness: ByJoint = None
    """Joint torque per radian between set-point and joint [N m/rad]."""
    damping: ByJoint = None
    """Joint torque per speed of the joint [N m s/rad]."""
    effort: ByJoint = None
    """Torque limit [N m]."""
    velocity: ByJoint = None
    """Speed limit [rad/s]."""

    def __post_init__(self) -> None:
        for name in SERVO_SETTINGS:
            value = getattr(self, name)
            table = value if isinstance(value, Mapping) else {} if value is None else {"": value}
            for joint, one in table.items():
                where = f"servos.{name}" + (f".{joint}" if joint else "")
                least = "0 or more" if name == "damping" else "above 0"
                _check(where, one, f"a finite number {least}", 0.0, above=name != "damping")

    def of(self, name: str, joints: Sequence[str], default: Floats | float = np.nan) -> Floats:
        """One of the settings for each of ``joints`` ``(d,)``, ``default`` where nothing is said.

        Raises:
            UnknownName: a table names another joint.
        """
        value = getattr(self, name)
        found = np.broadcast_to(np.asarray(default, float), (len(joints),)).copy()
        if isinstance(value, Mapping):
            for joint, one in value.items():
                if joint not in joints:
                    raise UnknownName(f"joint in servos.{name}", joint, joints)
                found[list(joints).index(joint)] = one
        elif value is not None:
            found[:] = value
        return found


@dataclass(frozen=True, kw_only=True)
class PostureConfig:
    """Joints by name [rad]; one that is left out is at the middle of its range."""

    open: dict[str, float] = field(default_factory=dict)
    """The open hand, from which the fingers close on an object."""
    grasp: dict[str, float] = field(default_factory=dict)
    """The fingertips about to touch the object; none: found when the grasp is settled."""

    def __post_init__(self) -> None:
        for name in ("open", "grasp"):
            for joint, angle in _mapping(f"postures.{name}", getattr(self, name)).items():
                _check(f"postures.{name}.{joint}", angle, "a finite number [rad]")


@dataclass(frozen=True, kw_only=True)
class HeldObject:
    """Where the hand holds objects, and which."""

    centre: Vector3 | None = None
    """Centre of the object, in the hand's frame (z: where the palm looks) [m]."""
    size: float | None = None
    """Width of the objects that suit the hand [m]."""
    sizes: dict[str, float] = field(default_factory=dict)
    """Width of those that suit it better at another one, by their names [m]."""
    shape: str | None = None
    """Name of the object that suits the hand best."""
    mass: float = 0.1
    """Of objects that the hand holds, where nobody says another [kg]."""
    reach: float | None = None
    """How far round such an object each fingertip can go, to either side of where it holds, with
    nothing but the fingertip touching [rad]; none: not known. Gaits swing no further."""
    travel: float | None = None
    """How far fingers may go with such an object before it waits for them to be put back, where
    contact normals are felt [rad]; none: what suits the number of fingers, within `reach`."""

    def __post_init__(self) -> None:
        if self.centre is not None and not np.isfinite(self.centre).all():
            raise HandModelError(f"object.centre is {self.centre!r}; expected three finite numbers")
        sizes = _mapping("object.sizes", self.sizes).items()
        widths = {f"object.sizes.{name}": width for name, width in sizes}
        if self.size is not None:
            widths["object.size"] = self.size
        for name, width in widths.items():
            expected = f"a finite number above 0, at most {FARTHEST:g} m"
            _check(name, width, expected, 0.0, FARTHEST, above=True)
        if not (np.isfinite(self.mass) and self.mass > 0):
            raise HandModelError(f"object.mass is {self.mass!r}; expected a finite number above 0")
        if self.reach is not None and not (np.isfinite(self.reach) and self.reach > 0):
            raise HandModelError(f"object.reach is {self.reach!r}; expected radians above 0")
        if self.travel is not None and not (np.isfinite(self.travel) and self.travel > 0):
            raise HandModelError(f"object.travel is {self.travel!r}; expected radians above 0")

    def width(self, name: str) -> float | None:
        """How wide the object of that name is where nobody says [m]; None: it is not known."""
        return self.sizes.get(name, self.size)


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """A joint that follows another: its position is ``scale * joint + offset``."""

    joint: str = ""
    """The joint that is followed; none: it is held at `offset`."""
    scale: float = 1.0
    """[rad/rad]"""
    offset: float = 0.0
    """[rad]"""

    def __post_init__(self) -> None:
        for name in ("scale", "offset"):
            _check(f"the {name} of a coupling", getattr(self, name), "a finite number")
        if not self.joint and self.scale != 1.0:
            raise HandModelError(f"a coupling has the scale {self.scale:g}, but lacks joint")


@dataclass(frozen=True, kw_only=True)
class HandConfig:
    """A hand: its description file, and what that file does not say.

    Raises:
        HandModelError: a value is out of range.
    """

    description: Path
    """MJCF or URDF file; in a toml, relative to it. ``menagerie:FOLDER/FILE`` is one of the MuJoCo
    menagerie, from the folder DEXCTL_MENAGERIE or the package mujoco-menagerie."""
    name: str = ""
    """What people read and files note; none: the name of the toml, else of the description."""
    about: str = ""
    """One line for people."""
    fingertips: dict[str, Vector3]
    """One body, site or link for each finger, in the order of the fingers, and where the tip is in
    its frame [m]."""
    fingertip_radius: float = 0.0
    """Of the fingertips about their tip points [m]; 0: the tip points are on the surface."""
    finger_width: float = 0.0
    """How wide fingers are across near their tips [m]; gaits put none down nearer to another than
    1.4 of it. 0: not known, as dex5's."""
    joints: tuple[str, ...] | None = None
    """The joints in the order of the controller board; none: finger by finger, base to tip."""
    palm: PalmConfig = field(default_factory=PalmConfig)
    servos: ServoConfig = field(default_factory=ServoConfig)
    postures: PostureConfig = field(default_factory=PostureConfig)
    object: HeldObject = field(default_factory=HeldObject)
    couplings: dict[str, Coupling] = field(default_factory=dict)
    """Joints that follow others or are held, beside those of which the file says so."""
    source: Path | None = field(default=None, compare=False)
    """The toml that this was read from; not a setting."""

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.description.stem)
        for name in ("fingertip_radius", "finger_width"):
            _check(name, getattr(self, name), "a finite number, 0 or more", 0.0)
        if not _mapping("fingertips", self.fingertips):
            raise HandModelError("fingertips is empty; expected one body, site or link per finger")
        tips = {tip: self._offset(tip, offset) for tip, offset in self.fingertips.items()}
        object.__setattr__(self, "fingertips", tips)

    def _offset(self, fingertip: str, value: Any) -> Vector3:
        try:
            offset = numbers(fingertip, value, "")
        except InvalidInput:
            offset = np.array(np.nan)
        if offset.shape != (3,) or not (np.abs(offset) <= FARTHEST).all():
            raise HandModelError(
                f"{self.description}: fingertip {fingertip!r} has the offset {value!r}; expected "
                f"three lengths in metres, at most {FARTHEST:g}"
            )
        x, y, z = offset.tolist()
        return x, y, z

    @classmethod
    def read(cls, path: str | Path) -> HandConfig:
        """The configuration in a toml file.

        Raises:
            HandModelError: no such file, no TOML, something is missing or out of range.
            UnknownName, InvalidInput: a setting that there is not, or of the wrong kind.
        """
        from dexctl.settings import from_plain  # needs tyro, which `import dexctl` does without

        path = Path(path).expanduser()
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise HandModelError(f"{path}: {error.strerror or error}") from None
        except ValueError as error:  # TOMLDecodeError, or no text
            raise HandModelError(f"{path}: not a TOML file: {error}") from None
        try:
            config = from_plain(cls, {"name": path.stem, **values}, path.name)
        except InvalidInput as error:
            said = str(error).removeprefix(path.name).lstrip(". ")  # the file, once
            raise InvalidInput(f"{path}: {said}") from None
        except HandModelError as error:
            raise HandModelError(f"{path}: {error}") from None
        file = config.description
        if not str(file).startswith(MENAGERIE):
            file = (path.parent / file.expanduser()).absolute()
        return replace(config, description=file, source=path.absolute())

    def write(self, path: str | Path, comments: Mapping[str, str] | None = None) -> None:
        """Write the toml that `read` reads.

        Args:
            path: the file; a description file in its folder, or below, is named relative to it.
            comments: what stands above a setting or table, by its dotted path (``"palm.axis"``).
        """
        from dexctl.files import write_text
        from dexctl.hand_toml import to_toml

        path = Path(path).expanduser().absolute()
        file = self.description
        if not str(file).startswith(MENAGERIE):
            file = file.expanduser().absolute()
            file = file.relative_to(path.parent) if file.is_relative_to(path.parent) else file
        write_text(path, to_toml(replace(self, description=file), comments or {}))

    def check_joints(self, joints: Sequence[str]) -> None:
        """Raise UnknownName where a servo or a posture is of none of ``joints``."""
        for name in SERVO_SETTINGS:
            self.servos.of(name, joints)
        for posture in ("open", "grasp"):
            for joint in getattr(self.postures, posture):
                if joint not in joints:
                    raise UnknownName(f"joint in postures.{posture}", joint, joints)

    def file(self, folder: str | Path | None = None) -> Path:
        """Where the description file is.

        Args:
            folder: for files of the menagerie, the folder that holds its folders. Default: the
                environment variable DEXCTL_MENAGERIE, else the `mujoco-menagerie` package.

        Raises:
            HandModelError: it is not to be had; the message says how to get it.
        """
        name = str(self.description)
        if name.startswith(MENAGERIE):
            from dexctl.hands.menagerie import find

            return find(self.name, name.removeprefix(MENAGERIE), folder)
        path = self.description.expanduser()
        if not path.is_file():
            raise HandModelError(f"{path}: no such file")
        return path

    def build(self, *, folder: str | Path | None = None) -> HandModel:
        """The hand.

        Args:
            folder: see :meth:`file`.

        Raises:
            HandModelError: the file is not to be had or holds no such hand.
            UnknownName: a fingertip or a joint is not in the file; the message says the toml.
        """
        from dexctl.description import read
        from dexctl.hand import HandModel

        description = read(self.file(folder))
        try:
            return HandModel(description, self)
        except UnknownName as error:
            raise UnknownName(self._of_toml(error.kind), error.name, error.known) from None

    def _of_toml(self, kind: str) -> str:
        """``kind`` of thing, with the toml that names it."""
        return kind if self.source is None else f"{kind} of {self.source.name}"

    def check_objects(self, known: Sequence[str]) -> None:
        """Raise UnknownName where an object that suits the hand is none of those ``known``."""
        if self.object.shape is not None:
            check_name(self._of_toml("object.shape"), self.object.shape, known)
        for name in self.object.sizes:
            check_name(self._of_toml("object.sizes"), name, known)
