"""The policies that come with the package."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import controllers
from dexctl.controllers import paced
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import changed
from learning import policies
from learning.evaluation import evaluate, open_subject
from learning.policies.file import read

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "benchmarks" / "results"
Hands = Callable[[str], dexctl.HandModel]


def shipped(name: str, hand_of: Hands) -> policies.Policy:
    """A policy on its hand; skips where the hand's files are not here."""
    spec = read(policies.FOLDER / f"{name}.npz").spec
    return policies.load(name, hand=hand_of(spec.hand))


@pytest.mark.parametrize("name", policies.names())
@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_each_turns_its_objects(name: str, every: bool, hand_of: Hands) -> None:
    """Half a turn in 10 s, and a quarter where set-points go at 0.6 rad/s: some take longer.

    All of its objects twice as far. One for goals brings its object to two in that time.
    """
    shipped(name, hand_of)
    subject = open_subject(name)
    seconds = 20.0 if every else 10.0
    protocol = subject.protocol(episodes=4, seconds=seconds, seed=1000)
    assert subject.trained is not None
    least = seconds * np.pi / (20.0 if subject.trained.env.max_speed < 1.0 else 10.0)
    for turned in subject.objects if every else subject.objects[:1]:
        found = evaluate(subject, protocol, object=turned)
        if found.protocol.task.goals != "none":
            assert np.median(found.goals_reached) >= 2, turned
        else:
            assert np.median(found.rotation) > least, turned


@pytest.mark.parametrize("name", policies.names())
def test_each_has_its_card(name: str, hand_of: Hands) -> None:
    card = json.loads((policies.FOLDER / f"{name}.json").read_text())
    assert card["steps"] + card.get("earlier_steps", 0) >= 600_000
    assert {"python", "torch", "mujoco"} <= set(card["versions"])
    assert card["trained"]["seed"] >= 0
    assert card["figures"]["return"] > 0
    assert card["hand"]["name"] == card["spec"]["hand"]  # so that another one is remarked on
    assert len(card["hand"]["sha256"]) == 64
    assert card == json.loads(json.dumps(shipped(name, hand_of).card))


@pytest.mark.parametrize("name", policies.names())
def test_each_says_under_what_it_was_tested(name: str) -> None:
    """All of it; of what turns as it did in training, or else of what is told axes or goals."""
    card = json.loads((policies.FOLDER / f"{name}.json").read_text())
    measured = {
        script: sum(
            paced(row["who"])[0] == name
            for row in json.loads((RESULTS / f"{script}.json").read_text())["trials"]
        )
        for script in ("conditions", "reorientation")
    }
    script = next(one for one, count in measured.items() if count)
    assert measured[script] == len(card.get("tested", {"results": ()})["results"]), (
        f"expected what `python benchmarks/{script}.py --resume --cards` writes"
    )


@pytest.mark.parametrize("name", policies.names())
def test_each_is_of_its_hand_as_it_is_now(name: str, hand_of: Hands) -> None:
    """Else whoever evaluates it is told that it was trained with another one."""
    card = json.loads((policies.FOLDER / f"{name}.json").read_text())
    assert card["hand"]["sha256"] == hand_of(card["hand"]["name"]).digest


def test_the_package_is_small() -> None:
    assert sum(path.stat().st_size for path in policies.FOLDER.glob("*.npz")) < 13_500_000


def test_an_object_that_is_seen_and_is_no_mirror_image_is_not_turned_the_other_way(
    dex5: dexctl.HandModel,
) -> None:
    """Its orientation in the mirror would be that of another object."""
    why = "the policy sees how the l_shape lies, which is not its own mirror image, expected"
    with pytest.raises(InvalidInput, match=why):
        policies.load("dex5-l-tracked", axis="-z")
    felt = policies.load("dex5-l-any", axis="-z")  # that one does not see it
    assert felt.symmetry is not None and felt.symmetry.mirrors


def test_learned_is_a_controller_of_that_name(dex5: dexctl.HandModel, hand_of: Hands) -> None:
    policy = policies.learned(dex5)
    assert policy.hand is dex5
    # the one for several objects, any way up, comes first
    assert policy.card == shipped("dex5-easy-any", hand_of).card
    assert len(open_subject("learned").objects) == 5
    assert policy.card == open_subject("learned").card
    assert open_subject("dex5-cylinder").objects == ("cylinder",)


def test_objects_of_a_training_are_told_once() -> None:
    """One named twice was met twice as often."""
    subject = open_subject("dex5-cylinder")
    assert subject.trained is not None
    often = changed(subject.trained, {"object": ("cube", "cylinder", "cube")})
    assert replace(subject, trained=often).objects == ("cube", "cylinder")


def test_learned_is_for_the_object_that_suits_the_hand(hand_of: Hands) -> None:
    hand = hand_of("wonik_allegro")  # whose toml names a sphere; there is a policy for cubes, too
    assert policies.learned(hand).card == shipped("wonik_allegro-sphere", hand_of).card


def test_what_there_is_no_policy_for(
    dex5: dexctl.HandModel, four_fingers: dexctl.HandModel
) -> None:
    other = replace(four_fingers.config, name="mine", description=four_fingers.path).build()
    known = "dex5, leap_hand, wonik_allegro, and"
    with pytest.raises(InvalidInput, match=rf"for the hand 'mine'; there is one for {known}"):
        policies.learned(other)
    with pytest.raises(InvalidInput, match=r"control_period is 0.02; .* was trained with 0.05"):
        policies.learned(dex5, control_period=0.02)
    with pytest.raises(UnknownName, match="'dex5-pen'; known: "):
        policies.load("dex5-pen")


def test_numpy_is_enough() -> None:
    code = (
        "import sys; sys.modules['torch'] = sys.modules['gymnasium'] = None; "
        "import dexctl; from learning import policies; "
        "policy = policies.learned(dexctl.hands.load('dex5')); "
        "print(policy.predict([0.0] * policy.observation.size).shape)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "(15,)\n"


def test_it_is_registered() -> None:
    if "learned" not in controllers.names():
        pytest.skip("dexctl is not installed, so its entry points are not known")
    entry = controllers.entry("learned")
    assert (entry.module, entry.title) == ("learning.policies", "learned gait")
