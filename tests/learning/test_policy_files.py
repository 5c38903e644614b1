"""Policies: numbers, files, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput
from learning import Policy, load_policy, save_policy
from learning.envs import EnvConfig, FingerGaitingVectorEnv, make_vector
from learning.policy import Layer, PolicySpec


@pytest.fixture(scope="module")
def envs() -> FingerGaitingVectorEnv:
    return make_vector(EnvConfig(object="cylinder", threads=1), 3, seed=0)


@pytest.fixture(scope="module")
def spec(envs: FingerGaitingVectorEnv) -> PolicySpec:
    return PolicySpec.of(envs.hand, envs.observation, envs.action, envs.config)


@pytest.fixture(scope="module")
def layers() -> list[Layer]:
    rng = np.random.default_rng(0)
    sizes = (65, 8, 15)
    return [
        Layer(0.3 * rng.standard_normal((out, into)), 0.1 * rng.standard_normal(out))
        for into, out in pairwise(sizes)
    ]


def test_act_is_the_network_on_the_observation(
    envs: FingerGaitingVectorEnv, spec: PolicySpec, layers: list[Layer]
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
    envs: FingerGaitingVectorEnv, spec: PolicySpec, layers: list[Layer]
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
    tmp_path: Path, envs: FingerGaitingVectorEnv, spec: PolicySpec, layers: list[Layer]
) -> None:
    path = tmp_path / "policy.npz"
    save_policy(path, layers, spec, {"seed": 3, "steps": 1000})
    policy = load_policy(path, parts=envs.config.parts)
    np.testing.assert_array_equal(
        policy.act(envs.state), Policy(envs.hand, layers, spec).act(envs.state)
    )
    card = json.loads(path.with_suffix(".json").read_text())
    assert card == policy.card
    assert card["seed"] == 3
    assert card["spec"]["hand"] == "dex5"
    assert card["spec"]["observation"]["parts"] == list(envs.config.parts)
    path.with_suffix(".json").unlink()
    assert load_policy(path).card == card
    assert sorted(p.name for p in tmp_path.iterdir()) == ["policy.npz"]


def test_loading_needs_numpy_alone(tmp_path: Path, spec: PolicySpec, layers: list[Layer]) -> None:
    save_policy(tmp_path / "p.npz", layers, spec)
    code = (
        "import sys; sys.modules['torch'] = sys.modules['gymnasium'] = None; "
        "from learning.policy import load_policy; "
        f"print(load_policy({str(tmp_path / 'p.npz')!r}).hand.nq)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "15"


def test_another_hand_is_refused(
    tmp_path: Path, spec: PolicySpec, layers: list[Layer], allegro: dexctl.HandModel
) -> None:
    save_policy(tmp_path / "p.npz", layers, spec)
    with pytest.raises(InvalidInput, match=r"policy is for the hand 'dex5' \(15 joints, 5 fing"):
        load_policy(tmp_path / "p.npz", hand=allegro)


def test_other_parts_are_refused(tmp_path: Path, spec: PolicySpec, layers: list[Layer]) -> None:
    save_policy(tmp_path / "p.npz", layers, spec)
    with pytest.raises(InvalidInput, match="trained with the observation parts q, q_target"):
        load_policy(tmp_path / "p.npz", parts=("q", "touch"))


def test_bad_files(tmp_path: Path, spec: PolicySpec, layers: list[Layer]) -> None:
    path = tmp_path / "p.npz"
    with pytest.raises(InvalidInput, match="no such file"):
        load_policy(path)
    with pytest.raises(InvalidInput, match=r"expected one that ends with \.npz"):
        load_policy(tmp_path / "p.zip")
    path.write_bytes(b"no zip")
    with pytest.raises(InvalidInput, match=r"'.*p\.npz' is not a policy file"):
        load_policy(path)
    save_policy(path, layers, spec)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InvalidInput, match="is not a policy file"):
        load_policy(path)
    np.savez(path, card=np.array(json.dumps({"format": 9})))
    with pytest.raises(InvalidInput, match="has format 9; expected 1"):
        load_policy(path)
    np.savez(path, card=np.array(json.dumps({"format": 1})))
    with pytest.raises(InvalidInput, match="lacks 'spec' in its card"):
        load_policy(path)
    changed = {**spec.observation, "version": 0}
    save_policy(path, layers, spec._replace(observation=changed))
    with pytest.raises(InvalidInput, match="layout has version 0; expected 1"):
        load_policy(path)


def test_layers_that_do_not_fit(
    tmp_path: Path, envs: FingerGaitingVectorEnv, spec: PolicySpec, layers: list[Layer]
) -> None:
    with pytest.raises(InvalidInput, match=r"layer 0 .* weight \(15, 8\).*expected \(n, 65\)"):
        Policy(envs.hand, layers[1:], spec)
    with pytest.raises(InvalidInput, match="the policy has 8 outputs; expected 15"):
        Policy(envs.hand, layers[:1], spec)
    with pytest.raises(InvalidInput, match="the policy has no layers"):
        Policy(envs.hand, [], spec)
    bad = Layer(layers[1].weight * np.nan, layers[1].bias)
    with pytest.raises(InvalidInput, match="layer 1 of the policy has numbers that are not finite"):
        save_policy(tmp_path / "p.npz", [layers[0], bad], spec)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_earlier_file(
    tmp_path: Path, spec: PolicySpec, layers: list[Layer], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "p.npz"
    save_policy(path, layers, spec, {"seed": 1})

    def full(stream, **arrays) -> None:
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        save_policy(path, layers, spec, {"seed": 2})
    assert load_policy(path).card["seed"] == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.json", "p.npz"]
