"""Policies: numbers, files, and what is refused."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hands.identity import identity
from dexctl.settings import from_plain
from learning import policies
from learning.envs import EnvConfig, ManipulationVectorEnv, make_vector
from learning.policies import Layer, Policy, PolicySpec, file


@pytest.fixture(scope="module")
def envs() -> ManipulationVectorEnv:
    return make_vector(from_plain(EnvConfig, {"object": "cylinder", "threads": 1}), 3, seed=0)


@pytest.fixture(scope="module")
def spec(envs: ManipulationVectorEnv) -> PolicySpec:
    return PolicySpec.of(envs.hand, envs.observation, envs.action, "dex5")


@pytest.fixture(scope="module")
def layers() -> list[Layer]:
    rng = np.random.default_rng(0)
    sizes = (65, 8, 15)
    return [
        Layer(0.3 * rng.standard_normal((out, into)), 0.1 * rng.standard_normal(out))
        for into, out in pairwise(sizes)
    ]


def test_act_is_the_network_on_the_observation(
    envs: ManipulationVectorEnv, spec: PolicySpec, layers: list[Layer]
) -> None:
    policy = Policy(envs.hand, layers, spec)
    assert policy.control_period == 0.05
    x = envs.observation(envs.state)[1].astype(float)
    hidden = np.maximum(layers[0].weight @ x + layers[0].bias, 0.0)
    action = np.tanh(layers[1].weight @ hidden + layers[1].bias)
    np.testing.assert_allclose(policy.predict(x), action, atol=1e-12)
    change = policy.act(envs.state)
    assert change.shape == (3, 15)
    np.testing.assert_allclose(policy.act(envs.state[1]), change[1], atol=1e-12)
    limited = envs.action.limited(envs.state[1], 0.1 * action)
    np.testing.assert_allclose(change[1], limited, atol=1e-12)


def test_a_policy_does_on_a_plant_what_its_actions_do_in_the_environment(
    envs: ManipulationVectorEnv, spec: PolicySpec, layers: list[Layer]
) -> None:
    from dexctl.sim import BatchSimulator, Scene

    small = [layers[0], Layer(0.1 * layers[1].weight, 0.1 * layers[1].bias)]
    policy = Policy(envs.hand, small, spec)
    plant = BatchSimulator(Scene.build("dex5", "cylinder"), 3, seed=4, threads=1)
    observations, _ = envs.reset(seed=4)
    for _ in range(5):
        state = plant.read()
        plant.write(state.q_target + policy.act(state))
        plant.step()
        observations, *_ = envs.step(policy.predict(observations))
    # the environment's limits on set-points are the policy's own
    np.testing.assert_allclose(plant.read().q, envs.state.q, atol=1e-9)


def test_files_come_back(
    tmp_path: Path, envs: ManipulationVectorEnv, spec: PolicySpec, layers: list[Layer]
) -> None:
    path = tmp_path / "policy.npz"
    policies.save(path, layers, spec, {"seed": 3, "steps": 1000})
    policy = policies.load(path, parts=envs.config.parts)
    np.testing.assert_array_equal(
        policy.act(envs.state), Policy(envs.hand, layers, spec).act(envs.state)
    )
    card = json.loads(path.with_suffix(".json").read_text())
    assert card == policy.card
    assert card["seed"] == 3
    assert card["spec"]["hand"] == "dex5"
    assert card["spec"]["observation"]["parts"] == list(envs.config.parts)
    path.with_suffix(".json").unlink()
    assert policies.load(path).card == card
    assert sorted(p.name for p in tmp_path.iterdir()) == ["policy.npz"]


def test_a_card_may_say_more_later(tmp_path: Path, spec: PolicySpec, layers: list[Layer]) -> None:
    path = tmp_path / "policy.npz"
    policies.save(path, layers, spec, {"seed": 7})
    policies.annotate(path, tested=[{"held": 0.9}])
    policies.annotate(path, tested=[{"held": 0.8}])
    again = policies.load(path)
    assert (again.card["seed"], again.card["tested"]) == (7, [{"held": 0.8}])
    assert json.loads(path.with_suffix(".json").read_text()) == again.card
    for one, other in zip(again.layers, layers, strict=True):
        np.testing.assert_array_equal(one.weight, other.weight)
        np.testing.assert_array_equal(one.bias, other.bias)


def test_loading_needs_numpy_alone(tmp_path: Path, spec: PolicySpec, layers: list[Layer]) -> None:
    policies.save(tmp_path / "p.npz", layers, spec)
    code = (
        "import sys; sys.modules['torch'] = sys.modules['gymnasium'] = None; "
        "from learning import policies; "
        f"print(policies.load({str(tmp_path / 'p.npz')!r}).hand.nq)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "15"


def test_another_hand_is_refused(
    tmp_path: Path, spec: PolicySpec, layers: list[Layer], four_fingers: dexctl.HandModel
) -> None:
    policies.save(tmp_path / "p.npz", layers, spec)
    with pytest.raises(InvalidInput, match=r"policy is for the hand 'dex5' \(15 joints, 5 fing"):
        policies.load(tmp_path / "p.npz", hand=four_fingers)


def test_other_parts_are_refused(tmp_path: Path, spec: PolicySpec, layers: list[Layer]) -> None:
    policies.save(tmp_path / "p.npz", layers, spec)
    with pytest.raises(InvalidInput, match="trained with the observation parts q, q_target"):
        policies.load(tmp_path / "p.npz", parts=("q", "touch"))


def test_paths_that_hold_no_policy(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"'.*p\.npz': no such file"):
        policies.load(tmp_path / "p.npz")
    with pytest.raises(
        UnknownName, match=r"wonik_allegro-sphere, a policy file \(\.npz\), a run folder"
    ):
        policies.load(tmp_path / "p.zip")
    with pytest.raises(InvalidInput, match=r"there is no policy\.npz in it"):
        policies.load(tmp_path)
    with pytest.raises(InvalidInput, match=r"expected one that ends with \.npz"):
        policies.save(tmp_path / "p.zip", [], policies.load("dex5-easy").spec)


def test_a_run_folder_is_its_policy(
    tmp_path: Path, spec: PolicySpec, layers: list[Layer], envs: ManipulationVectorEnv
) -> None:
    run = tmp_path / "run.npz"  # whatever it is called
    run.mkdir()
    policies.save(run / "policy.npz", layers, spec, {"seed": 5})
    assert policies.load(run, hand="dex5").card["seed"] == 5
    assert policies.learned(envs.hand, policy=run).hand is envs.hand


def claims(shape: str, descr: str = "'<f8'") -> bytes:
    """An array's file of no more than its header."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def npy(array: np.ndarray) -> bytes:
    stream = BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


W, B = np.zeros((15, 65)), np.zeros(15)
SPEC = policies.load("dex5-cylinder").spec._asdict()
CARD: dict[str, Any] = {"format": 1, "spec": SPEC, "layers": [[15, 65]]}
# what the file holds instead: another card, or other members (None: without it); and the complaint
BAD_CARDS: dict[str, tuple[Any, str]] = {
    "list": ([1], r"card is \[1\]; expected an object"),
    "null": (None, "card is None"),
    "no format": ({}, "card lacks 'format'"),
    "format": ({"format": 9}, "it has format 9; expected 1"),
    "no spec": ({"format": 1}, "card lacks 'spec'"),
    "spec a text": ({**CARD, "spec": "dex5"}, "spec is 'dex5'; expected an object"),
    "spec empty": ({**CARD, "spec": {}}, "spec lacks 'hand'"),
    "spec with more": ({**CARD, "spec": {**SPEC, "paw": 1}}, "spec has an unknown 'paw'"),
    "shapes": ({**CARD, "layers": [[15, 66]]}, r"layers is \[\[15, 66\]\].*\[\[15, 65\]\]"),
    "more shapes": ({**CARD, "layers": [[15, 65], [15, 15]]}, "layers is .*, as stored"),
    "no shapes": ({**CARD, "layers": None}, "layers is None"),
}
BAD_SPECS: dict[str, tuple[dict[str, Any], str]] = {
    "hand null": ({"hand": None}, "hand is None; expected a name"),
    "hand a list": ({"hand": ["dex5"]}, r"hand is \['dex5'\]; expected a name"),
    "hand unknown": ({"hand": "paw"}, "unknown hand 'paw'"),
    "joints a text": ({"joint_names": "abc"}, "joint_names is 'abc'; expected a list of names"),
    "joints others": ({"joint_names": ["a"]}, r"the policy is for .* \(1 joints, 5 fingers\)"),
    "tips of numbers": ({"fingertip_names": [1]}, r"fingertip_names is \[1\]"),
    "activation": ({"activation": "sin"}, "unknown activation 'sin'"),
    "activation a list": ({"activation": []}, r"activation is \[\]; expected a name"),
    "observation": ({"observation": 5}, "observation is 5; expected an object"),
    "no version": ({"observation": {}}, "observation lacks 'version'"),
    "version": ({"observation": {"version": 0}}, "layout has version 0; expected 1"),
    "action": ({"action": []}, r"action is \[\]; expected an object"),
    "action lacks": ({"action": {}}, "action lacks 'max_speed'"),
}
BAD_PARTS: dict[str, tuple[str, Any, str]] = {
    "speed": ("action", {"max_speed": True}, "action max_speed is True; expected a number"),
    "lead": ("action", {"max_lead": float("nan")}, "action max_lead is nan"),
    "huge": ("action", {"max_lead": 10**400}, "action max_lead is 10+"),
    "period": ("action", {"control_period": 0}, "action control_period is 0"),
    "action key": ("action", {"grip": 1}, "action has an unknown 'grip'"),
    "key": ("observation", {"paw": 1}, "observation has an unknown 'paw'"),
    "parts": ("observation", {"parts": "q"}, "observation parts is 'q'; expected a list"),
    "no parts": ("observation", {"parts": []}, r"observation parts is \[\]"),
    "part": ("observation", {"parts": ["paw"]}, "unknown observation part 'paw'"),
    "parts twice": ("observation", {"parts": ["q", "q"]}, "each named once"),
    "fewer parts": ("observation", {"parts": ["q"]}, r"weight \(15, 65\).*expected \(n, 15\)"),
    "scaled": ("observation", {"scaled": 1}, "observation scaled is 1; expected true or false"),
    "centre": ("observation", {"centre": [0, 0]}, "observation centre is .*three numbers"),
    "centre text": ("observation", {"centre": ["0"] * 3}, "observation centre is .*three numbers"),
}
BAD_MEMBERS: dict[str, tuple[dict[str, bytes | None], str]] = {
    "no card": ({"card": None}, "it holds no card"),
    "card of numbers": ({"card": npy(B)}, "is of float64; expected a text"),
    "card of bytes": ({"card": npy(np.array(b"{}"))}, "is of |S2; expected a text"),
    "cards": ({"card": npy(np.array(["{}", "{}"]))}, r"its card has shape \(2,\)"),
    "no JSON": ({"card": npy(np.array("{"))}, "is not a policy file: Expecting"),
    "nested": ({"card": npy(np.array("[" * 200_000 + "]" * 200_000))}, "recursion"),
    "surrogates": ({"card": npy(np.array("{}"))[:-1] + b"\xff"}, "is not a policy file"),
    "no layer": ({"weight_0": None, "bias_0": None}, "the policy has no layers"),
    "no bias": ({"bias_0": None}, r"it holds the arrays \['weight_0'\]"),
    "layer missing": ({"weight_0": None, "weight_1": npy(W)}, "expected weight_0, bias_0"),
    "layer too many": (
        {"weight_1": npy(np.zeros((15, 15))), "bias_1": npy(B)},
        r"layers is \[\[15, 65\]\]; expected \[\[15, 65\], \[15, 15\]\], as stored",
    ),
    "another array": ({"momentum": npy(B)}, "it holds the arrays .*momentum"),
    "800 GB": ({"weight_0": claims("(100000, 1000000)")}, "claims 800000000000 bytes; .* holds 0"),
    "negative": ({"weight_0": claims("(-1, -1)") + bytes(8)}, "is not a policy file"),
    "wide text": ({"card": claims("()", "'<U99999999'")}, "claims 399999996 bytes"),
    "deep header": ({"weight_0": claims("(" * 9000)}, "is not a policy file"),
    "header no dict": ({"weight_0": claims("0}}#")}, "is not a policy file"),
    "no dtype": ({"weight_0": claims("(1,)", "'paw'")}, "is not a policy file"),
    "version 9": ({"weight_0": b"\x93NUMPY\x09\x00" + bytes(80)}, r"header of version \(9, 0\)"),
    "no array": ({"weight_0": b"paw"}, "is not a policy file"),
    "pickle": ({"weight_0": npy(np.array([W], object))}, "is of object; expected floats"),
    "complex": ({"weight_0": npy(W + 1j)}, "is of complex128; expected floats"),
    "dates": ({"weight_0": npy(W.astype("M8[s]"))}, "is of datetime64.*; expected floats"),
    "integers": ({"bias_0": npy(B.astype(int))}, "'bias_0.npy' is of int64; expected floats"),
    "record": ({"bias_0": npy(np.zeros(15, "f8,f8"))}, "expected floats"),
    "not finite": ({"bias_0": npy(B + np.inf)}, "layer 0 .* not finite"),
    "flat weight": ({"weight_0": npy(W.ravel())}, r"layer 0 .* weight \(975,\)"),
    "a number": ({"weight_0": npy(np.array(1.0))}, r"layer 0 .* weight \(\)"),
    "empty weight": ({"weight_0": npy(W[:0]), "bias_0": npy(B[:0])}, r"weight \(0, 65\)"),
}


def write(path: Path, card: Any, changed: Mapping[str, bytes | None]) -> None:
    text = npy(np.array(json.dumps(card)))
    members = {"card": text, "weight_0": npy(W), "bias_0": npy(B)} | dict(changed)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            if data is not None:
                archive.writestr(f"{name}.npy", data)


def refused(path: Path, message: str) -> None:
    with pytest.raises(InvalidInput, match=message) as caught:
        policies.load(path)
    said = str(caught.value)
    assert str(path) in said
    assert "\n" not in said
    assert len(said) < 500


def test_the_file_that_the_bad_ones_are_made_of_is_good(tmp_path: Path) -> None:
    write(tmp_path / "p.npz", CARD, {})
    assert policies.load(tmp_path / "p.npz").predict(np.ones(65)).tolist() == [0.0] * 15


@pytest.mark.parametrize("case", [*BAD_CARDS, *BAD_SPECS, *BAD_PARTS, *BAD_MEMBERS])
def test_bad_content(tmp_path: Path, case: str) -> None:
    card, changed = CARD, {}
    if case in BAD_CARDS:
        card, message = BAD_CARDS[case]
    elif case in BAD_SPECS:
        other, message = BAD_SPECS[case]
        card = {**CARD, "spec": {**SPEC, **other}}
    elif case in BAD_PARTS:
        key, other, message = BAD_PARTS[case]
        card = {**CARD, "spec": {**SPEC, key: {**SPEC[key], **other}}}
    else:
        changed, message = BAD_MEMBERS[case]
    write(tmp_path / "p.npz", card, changed)
    refused(tmp_path / "p.npz", message)


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x05\x06" + bytes(18)])
def test_files_that_are_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "p.npz").write_bytes(content)
    refused(tmp_path / "p.npz", "is not a policy file")


def test_archives_that_take_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file, "LARGEST", 2**20)
    with zipfile.ZipFile(tmp_path / "p.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("card.npy", bytes(2**20 + 1))
    refused(tmp_path / "p.npz", "its arrays take more than 1 MiB")


def test_damaged_bytes_are_a_policy_or_one_line(tmp_path: Path) -> None:
    whole = (policies.FOLDER / "dex5-cylinder.npz").read_bytes()
    expected = policies.load("dex5-cylinder").predict(np.ones(65))
    rng = np.random.default_rng(0)
    path = tmp_path / "p.npz"
    for i in range(100):
        data = bytearray(whole)
        if i % 4 == 0:
            del data[rng.integers(len(data)) :]
        else:
            start = len(data) - 1000 if i % 4 == 1 else 0  # where its members are listed
            where = rng.integers(start, len(data))
            data[where] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        try:
            policy = policies.load(path)
        except InvalidInput:
            continue
        np.testing.assert_array_equal(policy.predict(np.ones(65)), expected)


def test_layers_that_do_not_fit(
    tmp_path: Path, envs: ManipulationVectorEnv, spec: PolicySpec, layers: list[Layer]
) -> None:
    with pytest.raises(InvalidInput, match=r"layer 0 .* weight \(15, 8\).*expected \(n, 65\)"):
        Policy(envs.hand, layers[1:], spec)
    with pytest.raises(InvalidInput, match="the policy has 8 outputs; expected 15"):
        Policy(envs.hand, layers[:1], spec)
    with pytest.raises(InvalidInput, match="the policy has no layers"):
        Policy(envs.hand, [], spec)
    bad = Layer(layers[1].weight * np.nan, layers[1].bias)
    with pytest.raises(InvalidInput, match="layer 1 of the policy has numbers that are not finite"):
        policies.save(tmp_path / "p.npz", [layers[0], bad], spec)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_earlier_file(
    tmp_path: Path, spec: PolicySpec, layers: list[Layer], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "p.npz"
    policies.save(path, layers, spec, {"seed": 1})

    def full(stream, **arrays) -> None:
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        policies.save(path, layers, spec, {"seed": 2})
    assert policies.load(path).card["seed"] == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.json", "p.npz"]


def test_another_hand_than_in_training_is_told(
    envs: ManipulationVectorEnv, spec: PolicySpec, layers: list[Layer], tmp_path: Path
) -> None:
    copy = tmp_path / "mine.xml"
    copy.write_text(envs.hand.path.read_text().replace("0.014", "0.015"))
    mine = replace(envs.hand.config, description=copy, name="mine").build()
    card = {"hand": identity(envs.hand)}
    assert policies.other_hand(Policy(envs.hand, layers, spec, card)) is None
    assert policies.other_hand(Policy(mine, layers, spec, {})) is None  # nobody knows
    said = policies.other_hand(Policy(mine, layers, spec, card))
    assert said is not None
    assert envs.hand.digest[:12] in said and mine.digest[:12] in said and "mine" in said


def test_a_policy_of_a_hand_from_a_file(
    envs: ManipulationVectorEnv, spec: PolicySpec, layers: list[Layer], tmp_path: Path
) -> None:
    hand_file = tmp_path / ("long" * 50) / "mine.toml"
    hand_file.parent.mkdir()
    envs.hand.config.write(hand_file)
    path = tmp_path / "p.npz"
    policies.save(path, layers, spec._replace(hand=str(hand_file)), {"steps": 1})
    assert policies.load(path).hand.config.source == hand_file
    hand_file.unlink()
    with pytest.raises(InvalidInput, match=r"p\.npz.*mine\.toml: no such file"):
        policies.load(path)
    assert policies.load(path, hand=envs.hand).hand is envs.hand
