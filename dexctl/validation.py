"""Checks of configuration values, with messages that name the field."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput, UnknownName

DAY = 86400.0
"""Longest time that anything is asked to take [s]."""


def check_numbers(
    config: object,
    *,
    positive: tuple[str, ...] = (),
    not_negative: tuple[str, ...] = (),
    fractions: tuple[str, ...] = (),
    optional: tuple[str, ...] = (),
) -> None:
    """Raise InvalidInput where a field of ``config`` is not such a number.

    Those that are ``optional`` are positive, or None.
    """
    positive += tuple(name for name in optional if getattr(config, name) is not None)
    for names, low, high, wanted in (
        (positive, np.nextafter(0.0, 1.0), np.inf, "a finite number above 0"),
        (not_negative, 0.0, np.inf, "a finite number, 0 or more"),
        (fractions, 0.0, 1.0, "a number from 0 to 1"),
    ):
        for name in names:
            value = getattr(config, name)
            found = None if isinstance(value, np.ndarray) else _real(value)
            if found is None or not (np.isfinite(found) and low <= found <= high):
                raise InvalidInput(f"{name} is {shown(value)}; expected {wanted}")


def check_name(what: str, value: object, known: Sequence[object]) -> None:
    """Raise UnknownName where ``value`` is none of those known."""
    if not isinstance(value, Hashable) or value not in known:  # arrays are equal to nothing
        said = value if isinstance(value, str) else shown(value)
        raise UnknownName(what, said, [str(one) for one in known])


def check_whole(config: object, **least: int) -> None:
    """Raise InvalidInput where a field of ``config`` is no whole number from so much on."""
    for name, low in least.items():
        value = getattr(config, name)
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if not (whole and value >= low):
            raise InvalidInput(f"{name} is {shown(value)}; expected a whole number from {low} on")


def check_kind(config: object, **kinds: type) -> None:
    """Raise InvalidInput where a field of ``config`` is not of the class given for it."""
    for name, kind in kinds.items():
        value = getattr(config, name)
        if not isinstance(value, kind):
            raise InvalidInput(f"{name} is {shown(value)}; expected a {kind.__name__}")


def check_mask(
    mask: ArrayLike, shape: tuple[int, ...] | None, name: str = "mask"
) -> NDArray[np.bool_]:
    """``mask`` as an array of ``shape``; InvalidInput where it is not of bools of that shape.

    A shape of None is any.
    """
    try:
        array: NDArray[Any] = np.asarray(mask)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    if array.ndim == 0 and shape == (1,):  # one hand, kept as a batch of one
        array = array.reshape(1)
    if array.dtype != bool or shape not in (None, array.shape):
        wanted = "bools" if shape is None else f"bools of shape {shape}"
        raise InvalidInput(
            f"{name} has shape {array.shape} and kind {array.dtype}; expected {wanted}"
        )
    return array


def truths(name: str, value: ArrayLike) -> NDArray[np.bool_]:
    """``value`` as an array of bools; 0 and 1 are taken for them, and nothing else is.

    Raises:
        InvalidInput: it is none.
    """
    if type(value) is np.ndarray and value.dtype == bool:
        return value
    try:
        array: NDArray[Any] = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    one_or_zero = array.dtype.kind in "iuf" and ((array == 0) | (array == 1)).all()
    if array.dtype != bool and not one_or_zero:
        raise InvalidInput(f"{name} is {shown(value)}; expected bools")
    return array.astype(bool, copy=False)


def shown(value: object) -> str:
    """``value`` on one line of a message, shortened."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:76]} ..."


def shown_numbers(value: ArrayLike) -> str:
    """Numbers on one line of a message, three digits each."""
    return f"({', '.join(f'{number:.3g}' for number in np.ravel(value))})"


def number(
    name: str, value: object, low: float, high: float, wanted: str, *, above: bool = False
) -> float:
    """``value`` as a float from ``low`` (or ``above`` it) to ``high``.

    Raises:
        InvalidInput: it is none; the message says what is ``wanted``.
    """
    found = _real(value)
    if found is None or not low <= found <= high or (above and found == low):
        raise InvalidInput(f"{name} is {shown(value)}; expected {wanted}")
    return found


def _real(value: object) -> float | None:
    """A real number, or an array of no dimensions that holds one; None where it is none."""
    kind = isinstance(value, (int, float, np.number)) or (
        isinstance(value, np.ndarray) and value.shape == () and value.dtype.kind in "iuf"
    )
    if not kind or isinstance(value, (bool, np.complexfloating)):
        return None
    try:
        return float(value)  # type: ignore[arg-type]
    except OverflowError:  # an integer too large
        return None


def numbers(name: str, value: ArrayLike, expected: str) -> NDArray[np.float64]:
    """``value`` as an array of floats, finite or not.

    Raises:
        InvalidInput: it holds what is no real number; the message says what is ``expected``.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        array = np.asarray(value)
        if array.dtype.kind in "biuf":
            return array.astype(float)
        if array.dtype.kind == "O" and not any(isinstance(x, (str, bytes)) for x in array.flat):
            return array.astype(float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InvalidInput(f"{name} is not an array of numbers: {shown(value)}; expected {expected}")


def check_vector(
    name: str, value: object, size: int, expected: str | None = None
) -> NDArray[np.float64]:
    """``value`` as a finite ``(size,)`` array.

    Raises:
        InvalidInput: another shape, or a number that is not finite; the message says what is
            ``expected``.
    """
    try:
        array = numbers(name, cast(Any, value), "")
    except InvalidInput:  # said in other words below
        array = np.empty(0)
    if array.shape != (size,) or not np.isfinite(array).all():
        expected = f"{size} finite numbers" if expected is None else expected
        raise InvalidInput(f"{name} is {shown(value)}; expected {expected}")
    return array


def check_pair(name: str, value: object, expected: str) -> tuple[float, float]:
    """``value`` as two finite numbers.

    Raises:
        InvalidInput: it is none; the message says what is ``expected``.
    """
    array = numbers(name, cast(Any, value), expected)
    if array.shape != (2,) or not np.isfinite(array).all():
        raise InvalidInput(f"{name} is {shown(value)}; expected {expected}")
    low, high = array.tolist()
    return low, high


def check_seed(seed: object, least: int | None = None) -> int:
    """``seed`` as a whole number, from ``least`` on.

    Raises:
        InvalidInput: it is none.
    """
    if isinstance(seed, (int, np.integer)) and not isinstance(seed, bool):
        found = int(seed)
        if least is None or found >= least:
            return found
    wanted = "a whole number" if least is None else f"a whole number from {least} on"
    raise InvalidInput(f"seed is {shown(seed)}; expected {wanted}")


def unit_quaternions(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """``value`` ``(..., 4)`` with a length of 1.

    Raises:
        InvalidInput: it is no such array, or its length is not near 1.
    """
    found = numbers(name, value, "a unit quaternion, wxyz")
    length = np.linalg.norm(found, axis=-1) if found.ndim and found.shape[-1] == 4 else np.nan
    if not np.all(np.abs(length - 1.0) <= 0.01):
        raise InvalidInput(f"{name} is {shown_numbers(found)}; expected a unit quaternion, wxyz")
    return found / np.asarray(length)[..., None]


def unit_quaternion(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """One orientation ``(4,)``, as `unit_quaternions`."""
    found = unit_quaternions(name, value)
    if found.shape != (4,):
        raise InvalidInput(f"{name} has shape {found.shape}; expected one quaternion, wxyz")
    return found


def check_twist(twist: object) -> None:
    """Raise InvalidInput where ``twist`` is not six finite numbers."""
    check_vector("twist", twist, 6, "six finite numbers: (linear [m/s], angular [rad/s])")


AXES: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0), "-y": (0.0, -1.0, 0.0), "-z": (0.0, 0.0, -1.0),
}  # fmt: skip


def unit_axis(axis: object) -> tuple[float, float, float]:
    """An axis by name, or a vector of any length above 0, as a unit vector.

    Raises:
        UnknownName: no such name.
        InvalidInput: no vector of three finite numbers, or one without length.
    """
    if isinstance(axis, str):
        if axis not in AXES:
            raise UnknownName("axis", axis, [*AXES, "a vector x,y,z"])
        return AXES[axis]
    try:
        vector = numbers("axis", cast(Any, axis), "")
    except InvalidInput:  # said in other words below
        vector = np.zeros(0)
    length = np.linalg.norm(vector) if vector.shape == (3,) else 0.0
    if not (np.isfinite(length) and length > 0):
        raise InvalidInput(f"axis is {shown(axis)}; expected three finite numbers, not all zero")
    x, y, z = (vector / length).tolist()
    return x, y, z


class Settings(Protocol):
    """Settings of a controller: a dataclass.

    Those of one that turns objects have ``about(axis)``: the same with the rotation about ``axis``
    ``(3,)``, at the same speed.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]


C = TypeVar("C", bound=Settings)

CONSTRUCTOR = ("control_period", "axis")
"""Keywords of controllers beside their settings."""


def with_changes(
    kind: type[C], config: object, changes: Mapping[str, Any], axis: object = None
) -> C:
    """The settings with single ones changed, and then turned about ``axis``; None leaves it.

    Args:
        kind: the class of the settings.
        config: settings of that class; None: its defaults.
        changes: settings by name, in place of those of ``config``.
        axis: of the wanted rotation, by name or ``(3,)``.

    Raises:
        InvalidInput: ``config`` is of another class, there is no such setting, or a value is out
            of range.
    """
    if config is None:
        config = kind()
    if not isinstance(config, kind):
        raise InvalidInput(f"config is {shown(config)}; expected a {kind.__name__}, or None")
    check_settings(kind, changes, CONSTRUCTOR)
    changed = cast(Any, replace(config, **changes))
    return changed if axis is None else changed.about(axis)


def check_settings(kind: type, names: Iterable[str], more: Sequence[str] = ()) -> None:
    """Raise InvalidInput where one of ``names`` is no field of ``kind``; it tells ``more``, too."""
    own = [field.name for field in fields(kind)]
    for name in names:
        if name not in own:
            known = [one for one in dict.fromkeys((*more, *own)) if one != name]
            raise InvalidInput(
                f"{kind.__name__} has no setting {name!r}; known keywords: {', '.join(known)}"
            )
