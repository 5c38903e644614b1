"""The file of a policy, and the card beside it.

A policy file is a numpy ``.npz`` with the weights of a multilayer perceptron (``weight_0``,
``bias_0``, ``weight_1`` and so on) and a JSON text, ``card``, that says what they are for: hand,
observation, action. The JSON file of the same name beside it has the same text for people, and what
trained the policy; nothing reads it.

Files come from anywhere, so nothing in one is believed: the members are read one by one, no more of
each than the archive holds, and nothing is unpickled.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from reprlib import repr as short
from sys import float_info
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.files import DAMAGED, aside, write_text
from learning.envs.history import check_steps
from learning.envs.observation import VERSION
from learning.policies.policy import Layer, PolicySpec, check_layers

FORMAT = 1
LARGEST = 2**30  # of a policy file, unpacked [bytes]
LARGEST_CARD = 2**24  # [bytes], four for a character
_COMPRESSED = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class Stored(NamedTuple):
    """What a policy file holds.

    Attributes:
        layers: of the perceptron, checked against each other.
        spec: what they are for.
        card: all that is said about them.
    """

    layers: tuple[Layer, ...]
    spec: PolicySpec
    card: dict[str, Any]


def save(
    path: str | Path,
    layers: Sequence[Layer | tuple[ArrayLike, ArrayLike]],
    spec: PolicySpec,
    card: Mapping[str, Any] | None = None,
) -> None:
    """Write a policy file and its card, each whole or not at all.

    Args:
        path: ends with ``.npz``; the card goes to the same name with ``.json``.
        layers: (weight ``(outputs, inputs)``, bias ``(outputs,)``) of each.
        spec: what they are for.
        card: what trained them: anything that JSON can hold (configuration, versions, seed, steps,
            figures).

    Raises:
        InvalidInput: another ending, or numbers that are not finite.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InvalidInput(f"policy path is {str(path)!r}; expected one that ends with .npz")
    checked = check_layers([Layer(np.asarray(w), np.asarray(b)) for w, b in layers])
    own = {
        "format": FORMAT,
        "dexctl": dexctl.__version__,
        "spec": spec._asdict(),
        "layers": [list(layer.weight.shape) for layer in checked],
    }
    text = json.dumps({**own, **(card or {}), **own}, indent=2)
    arrays: dict[str, Any] = {}
    for i, layer in enumerate(checked):
        arrays |= {f"weight_{i}": layer.weight, f"bias_{i}": layer.bias}
    with aside(path) as part, part.open("wb") as stream:
        np.savez(stream, card=np.array(text), **arrays)
    write_text(path.with_suffix(".json"), text + "\n")


def read(path: Path) -> Stored:
    """What the policy file ``path`` holds.

    Raises:
        InvalidInput: no such file, or one that is damaged, is no policy or is of another format;
            one line that names the file and what is wrong with it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            text, arrays = _members(archive)
        card = json.loads(text)
    except FileNotFoundError:
        raise InvalidInput(f"policy {str(path)!r}: no such file") from None
    except DAMAGED as error:  # InvalidInput is a ValueError
        what = " ".join(str(error).split()) or type(error).__name__
        raise InvalidInput(f"{str(path)!r} is not a policy file: {what[:200]}") from None
    try:
        _check_card(card)
        layers = _layers(arrays)
        shapes = [list(layer.weight.shape) for layer in layers]
        _expect(card["layers"] == shapes, "layers", card["layers"], f"{short(shapes)}, as stored")
    except InvalidInput as error:
        raise InvalidInput(f"policy {str(path)!r}: {error}") from None
    spec = _spec(card)
    names = {name: tuple(spec[name]) for name in ("joint_names", "fingertip_names", "history")}
    return Stored(layers, PolicySpec(**{**spec, **names}), card)


def annotate(path: str | Path, **entries: Any) -> None:
    """Add to what the card of a policy file says, or put it in the place of what it said.

    Args:
        path: of the file; the card beside it is written, too.
        **entries: anything that JSON can hold, such as what the policy was tested under.

    Raises:
        InvalidInput: no such file, or one that is damaged or no policy.
    """
    layers, spec, card = read(Path(path))
    save(path, layers, spec, {**card, **entries})


def _members(archive: zipfile.ZipFile) -> tuple[str, dict[str, np.ndarray]]:
    """The card's text, and the arrays by name."""
    members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    if len(members) != len(archive.infolist()):
        raise InvalidInput("it holds two arrays of one name")
    if sum(member.file_size for member in members.values()) > LARGEST:
        raise InvalidInput(f"its arrays take more than {LARGEST >> 20} MiB")
    if any(
        m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for m in members.values()
    ):
        raise InvalidInput("it is compressed in an unknown way")
    card = members.pop("card", None)
    if card is None:
        raise InvalidInput("it holds no card")
    text = _array(archive, card, "U")
    if text.shape != () or text.nbytes > LARGEST_CARD:
        raise InvalidInput(f"its card has shape {short(text.shape)} and {text.nbytes} bytes")
    return str(text), {name: _array(archive, member, "f") for name, member in members.items()}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, kind: str) -> np.ndarray:
    """The array in ``member``, whose numbers are of ``kind``."""
    name = short(member.filename)
    with archive.open(member) as stream:
        version = npy.read_magic(stream)
        if version not in _HEADERS:
            raise InvalidInput(f"{name} has a header of version {version}")
        shape, fortran, dtype = _HEADERS[version](stream)
        if dtype.kind != kind:
            wanted = {"U": "a text", "f": "floats"}[kind]
            raise InvalidInput(f"{name} is of {dtype}; expected {wanted}")
        # before anything of that size is asked for
        claimed, stored = prod(shape) * dtype.itemsize, member.file_size - stream.tell()
        if claimed != stored:
            raise InvalidInput(f"{name} claims {claimed} bytes; the file holds {stored}")
        data = stream.read()
    values = np.frombuffer(data, dtype).astype(dtype.newbyteorder("="))
    return values.reshape(shape, order="F" if fortran else "C")


def _layers(arrays: dict[str, np.ndarray]) -> tuple[Layer, ...]:
    """The arrays as layers: no number left out, and nothing besides."""
    count = len(arrays) // 2
    wanted = [f"{what}_{i}" for i in range(count) for what in ("weight", "bias")]
    if set(arrays) != set(wanted):
        raise InvalidInput(
            f"it holds the arrays {short(sorted(arrays))}; expected weight_0, bias_0, weight_1 and "
            "so on"
        )
    return check_layers([Layer(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(count)])


def _check_card(card: Any) -> None:
    """Raise InvalidInput where a card does not say what a policy needs."""
    _check_keys(card, "card", ("format",), also=True)
    if card["format"] != FORMAT:
        raise InvalidInput(f"it has format {short(card['format'])}; expected {FORMAT}")
    _check_keys(card, "card", ("spec", "layers"), also=True)
    spec = _spec(card)
    _check_keys(spec, "spec", PolicySpec._fields)
    _expect(_is_steps(spec["history"]), "history", spec["history"], "a list of control steps")
    _expect(_is_name(spec["hand"], 4096), "hand", spec["hand"], "a name, or a file")
    _expect(_is_name(spec["activation"]), "activation", spec["activation"], "a name")
    for key in ("joint_names", "fingertip_names"):
        _expect(_is_names(spec[key]), key, spec[key], "a list of names")
    action, observation = spec["action"], spec["observation"]
    _check_keys(action, "action", ("max_speed", "max_lead", "control_period"))
    for key, value in action.items():
        _expect(_is_number(value) and value > 0, f"action {key}", value, "a number above 0")
    _check_keys(observation, "observation", ("version",), also=True)
    if observation["version"] != VERSION:
        return  # the observation says so, and what it knows
    _check_keys(observation, "observation", ("version", "parts", "scaled", "centre"))
    parts, scaled, centre = (observation[key] for key in ("parts", "scaled", "centre"))
    _expect(_is_names(parts), "observation parts", parts, "a list of names")
    _expect(isinstance(scaled, bool), "observation scaled", scaled, "true or false")
    three = isinstance(centre, list) and len(centre) == 3 and all(map(_is_number, centre))
    _expect(three, "observation centre", centre, "three numbers")


def _spec(card: Mapping[str, Any]) -> Any:
    """What a card says the layers are for; older files do not say that there is no history."""
    spec = card["spec"]
    return {"history": [], **spec} if isinstance(spec, dict) else spec


def _check_keys(values: Any, name: str, keys: Sequence[str], *, also: bool = False) -> None:
    """Raise InvalidInput where ``values`` has not these keys, or others that ``also`` forbids."""
    _expect(isinstance(values, dict), name, values, "an object with names")
    for key in keys:
        if key not in values:
            raise InvalidInput(f"{name} lacks {key!r}")
    for key in () if also else values:
        if key not in keys:
            raise InvalidInput(f"{name} has an unknown {short(key)}; known: {', '.join(keys)}")


def _expect(good: bool, name: str, value: Any, wanted: object) -> None:
    if not good:
        raise InvalidInput(f"{name} is {short(value)}; expected {wanted}")


def _is_name(value: Any, longest: int = 200) -> bool:
    return isinstance(value, str) and 0 < len(value) <= longest


def _is_names(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(map(_is_name, value))


def _is_steps(value: Any) -> bool:
    try:
        return isinstance(value, list) and len(check_steps(value)) == len(value)
    except InvalidInput:
        return False


def _is_number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= float_info.max  # not so for nan
