"""``dexctl evaluate``."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.planning import Kinematic, grow
from dexctl.settings import to_plain
from dexctl.sim import GraspStates, Scene, SceneConfig, Simulation
from dexctl.sim.conditions import under
from learning import policies
from learning.cli.evaluate import Evaluate
from learning.evaluation import Protocol, open_subject
from learning.policies import PolicySpec

MakePolicy = Callable[..., str]


def run(*arguments: str) -> int:
    command = parse(Evaluate, "dexctl evaluate", arguments)
    assert command is not None
    return command.run()


def test_a_policy_as_json(
    policy_of: MakePolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = policy_of({"seed": 7}, object="cylinder")
    out = tmp_path / "out"
    arguments = ("--object", "cylinder", "cube", "--episodes", "3", "--seconds", "0.5")
    assert run(policy, *arguments, "--json", "--out", str(out)) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((out / "evaluate.json").read_text())
    assert found["card"]["seed"] == 7
    assert [one["object"] for one in found["results"]] == ["cylinder", "cube"]
    first = found["results"][0]
    assert first["share_dropped"]["value"] == 0.0
    assert abs(first["rotation_median_rad"]["value"]) < 0.05
    assert set(first["disturbance"].values()) == {0.0}
    assert found["protocol"]["scene"]["object"] == ["cylinder", "cube"]
    assert found["protocol"]["episodes"] == 3
    assert len((out / "episodes.csv").read_text().splitlines()) == 1 + 2 * 3


def test_a_controller_in_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("--episodes", "2", "--seconds", "0.1", "--object", "cube", "sphere")
    assert run("hold", *arguments, "--robustness", "--out", str(tmp_path / "out")) == 0
    table = capsys.readouterr().out
    assert "2 episodes of 0.1 s" in table
    assert table.count("rotation, rad") == 2  # a table for each object
    assert table.count("joint noise 0.1 rad") == 2 and table.count("push force 2 N") == 2
    figures = list(csv.DictReader((tmp_path / "out" / "figures.csv").open()))
    assert len(figures) == 42
    assert figures[4]["joint_noise"] == "0.1"
    assert float(figures[0]["share_dropped_high"]) == pytest.approx(0.657, abs=1e-3)  # Wilson
    curves = list(csv.DictReader((tmp_path / "out" / "curves.csv").open()))
    assert len(curves) == 42 * 3
    assert curves[2]["time_s"] == "0.1" and curves[2]["share_held"] == "1.0"
    assert curves[2]["share_near"] == "1.0" and curves[2]["share_near_low"] != "1.0"
    assert {row["conditions"] for row in (*curves, *figures)} == {""}
    for name in ("rotation.png", "robustness.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")


def test_files_say_the_conditions(tmp_path: Path) -> None:
    names = ("everything", "any-gravity")
    arguments = ("--episodes", "2", "--seconds", "0.1", "--out", str(tmp_path / "out"))
    assert run("hold", "--conditions", *names, *arguments) == 0
    for name in ("figures.csv", "curves.csv", "episodes.csv"):
        rows = list(csv.DictReader((tmp_path / "out" / name).open()))
        assert {row["conditions"] for row in rows} == {"everything any-gravity"}


def test_conditions_have_to_be_named() -> None:
    with pytest.raises(InvalidInput, match="--conditions has nothing behind it; expected names"):
        run("hold", "--episodes", "1", "--seconds", "0.1", "--conditions")


def test_robustness_under_conditions_says_what_it_ran(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The noise of the heading is in every row."""
    arguments = ("--episodes", "2", "--seconds", "0.1", "--out", str(tmp_path / "out"))
    assert run("hold", "--conditions", "everything", "--robustness", *arguments) == 0
    table = capsys.readouterr().out
    assert "normal noise 0.1 rad" in table.splitlines()[0] and table.count("none") == 1
    with (tmp_path / "out" / "figures.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 21 and {row["force_noise"] for row in rows} == {"0.5"}
    assert [row["normal_noise"] for row in rows].count("0.1") == 17
    assert (tmp_path / "out" / "robustness.png").exists()


def test_one_table_of_figures(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("igm", "--episodes", "2", "--seconds", "0.2", "--axis=0,0,-1") == 0
    table = capsys.readouterr().out
    assert "igm, palm up, about (0, 0, -1)" in table
    assert "cube" in table and "made a full turn" in table
    assert all(len(line) <= 80 for line in table.splitlines()[2:])
    # it turns the other way, about the other axis: forwards
    assert float(re.search(r"rotation +([-.0-9]+) rad", table)[1]) > 0.01  # type: ignore[index]


def test_starts_that_do_not_hold_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], at_rest: Callable[..., GraspStates]
) -> None:
    """And another spelling of the option; nothing was said, and the policy blamed."""
    config = SceneConfig(object=("cylinder",), threads=1)
    with Simulation(config, 4, 0) as made:
        state = made.state
    good = at_rest(made.hand, state, ["cylinder"] * 4)
    good.save(tmp_path / "good.npz")
    replace(good, q_target=good.q - 0.5).save(tmp_path / "loose.npz")
    short = ("hold", "--object", "cylinder", "--episodes", "4", "--seconds", "0.1", "--json")
    assert run(*short, "--from", str(tmp_path / "loose.npz")) == 0
    said = capsys.readouterr()
    assert "4 of 4 starts do not hold for 0.5 s with dex5, cylinder, palm up" in " ".join(
        said.err.split()
    )
    file = json.loads(said.out)["protocol"]["scene"]["initial_states"]
    assert file == str(tmp_path / "loose.npz")
    assert run(*short, "--initial-states", str(tmp_path / "good.npz")) == 0
    assert "do not hold" not in capsys.readouterr().err


def test_what_is_not_said_is_as_in_training(
    policy_of: MakePolicy, capsys: pytest.CaptureFixture[str]
) -> None:
    """But without noise, late sensors, pushes and given starts."""
    policy = policy_of(
        object=("sphere", "cylinder"), gravity="down", axis=(2.0, 0.0, 0.0), object_mass=0.05,
        control_period=0.1, speed_limit=0.6, max_reward=0.3, touch_threshold=0.1, substeps=20,
        joint_noise=0.1, sensor_latency=0.1, push_force=1.0, push_seconds=2.0, threads=1,
        initial_states="states.npz",
    )  # fmt: skip
    short = ("--episodes", "2", "--seconds", "0.2", "--json")
    assert run(policy, *short) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["object"] for one in found["results"]] == ["sphere", "cylinder"]
    scene, task = found["protocol"]["scene"], found["protocol"]["task"]["turning"]
    assert (scene["gravity"], task["axis"], task["max_reward"]) == ("down", [2.0, 0.0, 0.0], 0.3)
    assert (scene["object_mass"], scene["control_period"], scene["substeps"]) == (0.05, 0.1, 20)
    assert (scene["limits"]["speed_limit"], scene["sensing"]["touch_threshold"]) == (0.6, 0.1)
    assert (scene["sensing"]["joint_noise"], scene["sensing"]["sensor_latency"]) == (0.0, 0.0)
    assert scene["push"] == {"push_force": 0.0, "push_seconds": 2.0}
    assert (scene["initial_states"], scene["threads"]) == (None, None)
    others = ("--object", "cube", "--gravity", "up", "--axis=-x", "--push-force", "0.5")
    assert run(policy, *short, *others) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["object"] for one in found["results"]] == ["cube"]
    scene, task = found["protocol"]["scene"], found["protocol"]["task"]["turning"]
    assert (scene["gravity"], task["axis"]) == ("up", "-x")
    assert found["results"][0]["disturbance"]["push_force"] == 0.5


def test_conditions_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("hold", "--episodes", "2", "--seconds", "0.1", "--conditions", "everything", "limits")
    assert run(*words, "--torque-limit", "0.7", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["conditions"] == ["everything", "limits"]
    scene = found["protocol"]["scene"]
    assert scene["randomisation"]["mass_range"] == [0.05, 0.25]
    assert scene["limits"] == {"speed_limit": 0.6, "torque_limit": 0.7, "action_latency": 0.05}
    assert run(*words) == 0
    assert "friction range 0.6, 1.4" in capsys.readouterr().out
    with pytest.raises(UnknownName, match="unknown conditions 'moon'"):
        run("hold", "--conditions", "moon")


def test_conditions_take_the_place_of_the_trainings(capsys: pytest.CaptureFixture[str]) -> None:
    """A policy that was trained with limits is nominal without them."""
    limited = policies.load("dex5-any").card["trained"]["env"]["scene"]["limits"]
    assert limited["torque_limit"] == 0.5 and limited["action_latency"] == 0.05
    words = ("dex5-any", "--episodes", "1", "--seconds", "0.1", "--object", "cube", "--json")
    for names, conditions in ((("nominal",), ("nominal",)), (("any-gravity",), ("any-gravity",))):
        assert run(*words, "--conditions", *names) == 0
        scene = json.loads(capsys.readouterr().out)["protocol"]["scene"]
        wanted = to_plain(under(SceneConfig(object=("cube",), object_mass=0.1), *conditions))
        assert scene == json.loads(json.dumps(wanted))
    assert run(*words) == 0  # as it was trained, where nothing is said
    scene = json.loads(capsys.readouterr().out)["protocol"]["scene"]
    assert scene["limits"]["torque_limit"] == 0.5


@pytest.mark.parametrize("who", ["dex5-easy", "coordinated", "hold"])
@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (("--goals", "cube"), "goals is 'cube', .* expected goal_quaternion or goal_rotation"),
        (("--commands", "x,y"), "commands is x, y, .* expected goal_angular_velocity among"),
    ],
)
def test_who_is_not_told_what_is_wanted_is_refused(
    who: str, asked: tuple[str, ...], told: str
) -> None:
    words = ("--episodes", "1", "--seconds", "0.1", "--object", "cube")
    with pytest.raises(InvalidInput, match=told) as caught:
        run(who, *words, *asked)
    assert who in str(caught.value)


@pytest.mark.parametrize(
    ("who", "asked", "told"),
    [
        ("dex5-cube-goals", ("--goals", "none"), "goals is 'none', and the policy 'dex5-cube-goal"),
        ("dex5-axes", ("--goals", "cube"), "goals is 'cube'"),
    ],
)
def test_who_has_to_be_told_is_refused_without(who: str, asked: tuple[str, ...], told: str) -> None:
    with pytest.raises(InvalidInput, match=told):
        run(who, "--episodes", "1", "--seconds", "0.1", *asked)
    axes = open_subject("dex5-axes")
    with pytest.raises(InvalidInput, match="commands is none, and the policy 'dex5-axes' is told"):
        axes.acting(axes.protocol(commands=()))


@pytest.mark.parametrize("asked", [("--goals", "cube"), ("--commands", "x")])
def test_who_is_told_is_evaluated(asked: tuple[str, ...]) -> None:
    words = ("--episodes", "1", "--seconds", "0.1", "--object", "cube")
    assert run("goal", *words, *asked) == 0


def test_the_root_is_gone_to_from_elsewhere(
    tmp_path: Path, at_rest: Callable[..., GraspStates]
) -> None:
    """Whoever starts there has come to it by doing nothing."""
    words = ("--episodes", "1", "--seconds", "0.1", "--object", "cube", "--goals", "root")
    with pytest.raises(InvalidInput, match="goals is 'root', .* expected initial_states"):
        run("hold", *words)
    with Simulation(SceneConfig(threads=1), 1, 0) as made:
        at_rest(made.hand, made.state, ["cube"]).save(tmp_path / "states.npz")
    assert run("hold", *words, "--from", str(tmp_path / "states.npz")) == 0  # the root never varies


def test_the_transfer_matrix(
    policy_of: MakePolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sphere, out = policy_of(object="sphere", object_mass=0.05), tmp_path / "out"
    arguments = ("--episodes", "2", "--seconds", "0.2", "--object", "cube", "--out", str(out))
    assert run("--transfer", sphere, "cylinder=igm", *arguments) == 0
    table = capsys.readouterr().out
    assert "policy of" in table
    found = json.loads((out / "evaluate.json").read_text())
    assert found["protocol"]["scene"]["object_mass"] == 0.05
    matrix = found["transfer"]
    assert matrix["objects"] == ["sphere", "cylinder", "cube"]
    assert [one["object"] for one in matrix["policies"]] == ["sphere", "cylinder"]
    row = matrix["rotation_median_rad"][1]
    scores = matrix["rotation_score"][1]
    assert scores[1]["value"] == 1.0
    assert scores[2]["value"] == pytest.approx(row[2]["value"] / row[1]["value"])
    assert len((out / "transfer.csv").read_text().splitlines()) == 1 + 6
    assert (out / "transfer.png").read_bytes().startswith(b"\x89PNG")
    assert found["cards"][1] is None


def cut(path: str) -> str:
    whole = Path(path).read_bytes()
    Path(path).write_bytes(whole[: len(whole) // 2])
    return path


def of_another_hand(folder: Path) -> str:
    parts = {"version": 1, "parts": ["q"], "scaled": False, "centre": [0, 0, 0]}
    action = {"max_speed": 2.0, "max_lead": 0.25, "control_period": 0.05}
    spec = PolicySpec("paw", ("a", "b"), ("tip",), parts, action)
    policies.save(folder / "paw.npz", [(np.zeros((2, 2)), np.zeros(2))], spec, {})
    return str(folder / "paw.npz")


def without_card(path: str) -> str:
    np.savez(path, weight_0=np.zeros((15, 65)), bias_0=np.zeros(15))
    return path


def of_format(path: str, number: int) -> str:
    np.savez(path, card=np.array(json.dumps({"format": number})))
    return path


BAD: dict[str, tuple[Callable[[MakePolicy, Path], list[str]], str]] = {
    "controller": (lambda p, _: ["gate"], "unknown controller 'gate'; known: igm, .*dex5-cylinder"),
    "no file": (lambda p, f: [str(f / "none.npz")], "policy .*none.npz': no such file"),
    "no run": (lambda p, f: [str(f)], "is no run folder: it has no config.json"),
    "cut off": (lambda p, _: [cut(p())], "cube-up.npz' is not a policy file"),
    "no card": (
        lambda p, _: [without_card(p())], "cube-up.npz' is not a policy file: it holds no card"
    ),
    "format": (lambda p, _: [of_format(p(), 9)], "has format 9; expected 1"),
    "card of another version": (
        lambda p, _: [p({"trained": {"env": {"colour": "red"}}})],
        "card of policy '.*cube-up.npz' is of another version: .*colour",
    ),
    "hand": (
        lambda p, f: [of_another_hand(f), "--hand", "dex5"],
        r"the policy is for the hand 'paw' \(2 joints, 1 fingers\); got 'dex5' \(15 joints",
    ),
    "hand not there": (lambda p, f: [of_another_hand(f)], "unknown hand 'paw'; known: dex5"),
    "parts": (
        lambda p, _: [p(), "--parts", "q", "touch"],
        "the policy was trained with the observation parts q, q_target, .*; got q, touch",
    ),
    "part": (lambda p, _: [p(), "--parts", "smell"], "unknown observation part 'smell'"),
    "period": (
        lambda p, _: [p(), "--control-period", "0.1"],
        "control_period is 0.1; the policy '.*cube-up.npz' was trained with 0.05",
    ),
    "object": (lambda p, _: ["hold", "--object", "brick"], "unknown object 'brick'; known: cube"),
    "axis": (lambda p, _: ["hold", "--axis", "w"], "unknown axis 'w'; known: x, y, z"),
    "latency": (lambda p, _: ["hold", "--sensor-latency", "-1"], "sensor_latency is -1"),
    "seconds": (lambda p, _: ["hold", "--seconds", "0"], "seconds is 0"),
    "too short": (lambda p, _: ["hold", "--seconds", "0.01"], "--seconds is 0.01"),
    "episodes": (lambda p, _: ["hold", "--episodes", "0"], "episodes is 0"),
    "nothing": (lambda p, _: [], "got neither of a policy and --transfer"),
    "both": (
        lambda p, _: ["hold", "--transfer", "cube=igm"], "got both of a policy and --transfer"
    ),
    "transfer and robustness": (
        lambda p, _: ["--robustness", "--transfer", "cube=igm", "sphere=igm"],
        "got --transfer and --robustness",
    ),
    "transfer of one": (lambda p, _: ["--transfer", "cube=igm"], "got 1 policies for a transfer"),
    "transfer object": (
        lambda p, _: ["--transfer", "brick=igm", "cube=igm"],
        "unknown object 'brick'; known: cube",
    ),
    "transfer without card": (
        lambda p, _: ["--transfer", p({}), "sphere=igm"],
        "'.*cube-up.npz' has no such card: give it, as in cube=.*cube-up.npz",
    ),
    "transfer of several": (
        lambda p, _: ["--transfer", p(object=("cube", "sphere")), "sphere=igm"],
        "was trained on cube and sphere: give it, as in cube=",
    ),
    "transfer up and down": (
        lambda p, _: ["--transfer", p(), p(object="sphere", gravity="down")],
        "the policies were trained with gravity up and down; say which with --gravity",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str, policy_of: MakePolicy, tmp_path: Path) -> None:
    arguments, said = BAD[case]
    with pytest.raises((InvalidInput, UnknownName), match=said) as caught:
        run(*arguments(policy_of, tmp_path))
    assert "\n" not in str(caught.value)


def test_several_policies_do_where_it_is_said(
    policy_of: MakePolicy, capsys: pytest.CaptureFixture[str]
) -> None:
    names = (policy_of(), policy_of(object="sphere", gravity="down"))
    short = ("--episodes", "1", "--seconds", "0.1", "--json")
    assert run("--transfer", *names, *short, "--gravity", "down") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["protocol"]["scene"]["gravity"] == "down"
    assert found["transfer"]["objects"] == ["cube", "sphere"]


def test_cards_of_other_versions_are_read_as_far_as_they_matter(policy_of: MakePolicy) -> None:
    env = {"scene": {"object": ["sphere"], "gravity": "down"}, "task": {"axis": "x"}}
    trained = {"env": env, "guidance": {"method": "rl"}, "sac": {"colour": "red"}, "depth": 3}
    subject = open_subject(policy_of({"trained": trained}))
    assert (subject.objects, subject.guides) == (("sphere",), ())
    assert subject.protocol(axis="y").scene.gravity == "down"
    assert open_subject(policy_of({})).protocol() == Protocol()


def test_a_tracker_is_as_late_as_a_policy_has_learned_by() -> None:
    """Undisturbed but for that: told at once, it goes to fewer goals in a row."""
    for name in ("dex5-cube-goals", "pursuing:dex5-cube-goals"):
        subject = open_subject(name)
        sensing = subject.protocol().scene.sensing
        assert sensing.tracker_latency == 0.1 and sensing.tracker_position_noise == 0.0
        assert subject.protocol(tracker_latency=0.0).scene.sensing.tracker_latency == 0.0
    assert open_subject("dex5-seen").protocol().scene.sensing.tracker_latency == 0.0


def test_a_controller_for_one_object_is_evaluated_with_that_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Scene.build("dex5", "cylinder", "up")
    grow(scene, Kinematic(batch=32), until_rotation=0.4, path=tmp_path / "tree.npz")
    name, short = f"planned:{tmp_path / 'tree.npz'}", ("--episodes", "1", "--seconds", "0.1")
    assert run(name, *short, "--json") == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["protocol"]["scene"]["object"] == ["cylinder"]
    assert "is made for" not in said.err
    for other, said in (
        (("--object", "cube"), "the object cylinder; this is cube"),
        (("--gravity", "down"), "gravity (0, 0, -9.81) m/s²; this is (0, 0, 9.81)"),
    ):
        assert run(name, *short, *other) == 0
        assert f"tree.npz is made for {said}" in " ".join(capsys.readouterr().err.split())


def test_goals_have_figures_of_their_own(capsys: pytest.CaptureFixture[str]) -> None:
    short = ("--goals", "yaw", "--episodes", "2", "--seconds", "0.3", "--goal-seconds", "0.2")
    assert run("goal", *short) == 0
    said = capsys.readouterr().out
    assert "goal, palm up, goals yaw" in said
    assert "goals in a row" in said
    assert run("goal", *short, "--json") == 0
    found = json.loads(capsys.readouterr().out)["results"][0]
    assert found["share_first_goal_reached"]["count"] == 2
    assert found["first_goal_median_s"]["value"] == 0.2


def test_commands_that_a_policy_was_never_told_are_named(
    policy_of: MakePolicy, capsys: pytest.CaptureFixture[str]
) -> None:
    turning = {"commands": ["x", "z"], "command_speed_range": [0.5, 0.5]}
    env = {"task": {"turning": turning}, "parts": ["q", "goal_angular_velocity"]}
    name = policy_of({"trained": {"env": env}}, **env)
    short = ("--episodes", "1", "--seconds", "0.1")
    assert run(name, *short) == 0
    assert "was trained with" not in capsys.readouterr().err
    for other, said in (
        (("--commands", "y"), "commands x, z at 0.5 rad/s; this is commands y at 0.5 rad/s"),
        (("--command-speed-range", "0.2,1"), "this is commands x, z at 0.2 to 1 rad/s"),
    ):
        assert run(name, *short, *other) == 0
        assert said in " ".join(capsys.readouterr().err.split())
