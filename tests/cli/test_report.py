"""Figures of merit, plots and the page, with numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.files import aside, write_text
from dexctl.limits import HandLimits
from dexctl.report import figures, html, summarise, summarise_batch, words
from dexctl.report.conditions import not_as_usual
from dexctl.report.style import controller_line, drawing, legend_columns, title_of
from dexctl.report.summary import share_of
from dexctl.sim import Push, SceneConfig, Sensing, Trace
from dexctl.statistics import Estimate


def trace(batch: tuple[int, ...] = (), **changes: object) -> Trace:
    """Ten steps of 0.1 s; two fingers, of which the second lifts halfway; dropped after 0.7 s."""
    count = 11
    held = np.arange(count) <= 7
    touch = np.column_stack([np.ones(count, bool), np.arange(count) < 5])
    rotation = np.minimum(np.arange(count), 7) * 0.1

    def spread(values: np.ndarray, trailing: int = 0) -> np.ndarray:
        shape = (values.shape[0], *batch, *values.shape[values.ndim - trailing :])
        return np.broadcast_to(
            values.reshape(len(values), *(1,) * len(batch), *values.shape[1:]), shape
        )

    fields = {
        "time": np.arange(count) * 0.1,
        "q": spread(np.zeros((count, 4)), 1),
        "q_target": spread(np.zeros((count, 4)), 1),
        "in_contact": spread(touch, 1),
        "contact_force": spread(touch * 2.0, 1),
        "contact_position": spread(np.zeros((count, 2, 3)), 2),
        "contact_normal": spread(np.zeros((count, 2, 3)), 2),
        "object_position": spread(np.zeros((count, 3)), 1),
        "object_quaternion": spread(np.tile([1.0, 0, 0, 0], (count, 1)), 1),
        "other_contact": spread(np.zeros(count)),
        "diverged": spread(np.zeros(count, bool)),
        "held": spread(held),
        "rotation": spread(rotation),
        "diagnostics": {
            "0.residual": spread(np.arange(10) / 10),
            "finger": spread(np.where(np.arange(10) < 3, 1, -1)),
        },
        "act_seconds": np.arange(1, 11) * 1e-3,
    }
    return Trace(**{**fields, **changes})


@pytest.mark.parametrize("batch", [(), (3,)])
def test_summary_of_a_trial(batch: tuple[int, ...]) -> None:
    found = summarise(trace(batch), index=1 if batch else 0)
    assert found.rotation == pytest.approx(0.7)
    assert found.time_held == pytest.approx(0.7)
    assert found.dropped
    # rows 0 to 7 are held: five with two fingers, three with one
    assert found.mean_contacts == pytest.approx((5 * 2 + 3 * 1) / 8)
    assert found.largest_residual == pytest.approx(0.7)
    assert found.act_time_median == pytest.approx(5.5e-3)
    assert found.as_dict()["rotation_rad"] == found.rotation


def test_a_controller_without_a_residual() -> None:
    assert summarise(trace(diagnostics={})).largest_residual is None
    with drawing():
        assert len(figures.trial_figure(trace(diagnostics={})).axes) == 2


def test_summary_of_a_batch() -> None:
    rotation = np.tile(np.linspace(0, 1, 11)[:, None], (1, 4)) * [1.0, 2.0, 3.0, 7.0]
    held = np.ones((11, 4), bool)
    held[5:, 0] = False
    found = summarise_batch(trace((4,), rotation=rotation, held=held))
    result = found.as_dict()
    assert result["rotation_rad"]["median"] == pytest.approx(2.5)
    assert result["time_held_s"]["p90"] == pytest.approx(1.0)
    assert (found.holding.count, found.full_turn.count) == (3, 1)
    with pytest.raises(InvalidInput, match=r"batch shape \(\)"):
        summarise_batch(trace())


def test_share_by_hand() -> None:
    """8 of 10: centre (p + z^2 / 2n) / (1 + z^2 / n), z = 1.96."""
    z, n, p = 1.959964, 10, 0.8
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    share = share_of(np.arange(10) < 8)
    assert share.share == 0.8
    assert (share.low, share.high) == pytest.approx((centre - half, centre + half), abs=1e-6)


def test_switching_fingers_from_either_diagnostic() -> None:
    expected = np.zeros((10, 2), bool)
    expected[:3, 1] = True
    np.testing.assert_array_equal(figures.switching_fingers(trace()), expected)
    told = trace((3,), diagnostics={"1.switching": np.tile(expected[:, None], (1, 3, 1))})
    np.testing.assert_array_equal(figures.switching_fingers(told, index=2), expected)
    assert figures.switching_fingers(trace(diagnostics={})) is None


def test_contact_diagram_draws_what_touched() -> None:
    with drawing():
        axes = figures.new_figure(4, 2).add_subplot()
        figures.contact_diagram(axes, trace())
    first, _, second, outline = axes.collections
    bars = [path.get_extents() for path in (*first.get_paths(), *second.get_paths())]
    assert [bar.x1 - bar.x0 for bar in bars] == pytest.approx([1.1, 0.5])
    assert outline.get_paths()[0].get_extents().x1 == pytest.approx(0.3)


def test_plots_leave_the_users_settings_alone() -> None:
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    with drawing():
        page = html.page(
            "A <title>", "", [html.plot(figures.rotation_figure({"igm": trace()}), "a")]
        )
        again = html.page(
            "A <title>", "", [html.plot(figures.rotation_figure({"igm": trace()}), "a")]
        )
    assert dict(mpl.rcParams) == before
    assert page == again  # the same drawing gives the same file
    assert "A &lt;title&gt;" in page and "data:image/svg+xml;base64," in page


def test_files_are_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_text(path, "first")
    with pytest.raises(KeyboardInterrupt):
        _interrupted(path)
    assert path.read_text() == "first"
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def _interrupted(path: Path) -> None:
    with aside(path) as part:
        part.write_text("half of the sec")
        raise KeyboardInterrupt


def test_conditions_say_what_is_not_as_usual() -> None:
    config = SceneConfig(
        object=("sphere",),
        threads=1,
        stiffness=2.0,
        sensing=Sensing(normal_noise=0.1, touch_threshold=0.2),
        push=Push(push_force=1.0),
        limits=HandLimits.real(),
    )
    assert not_as_usual(config) == [
        ("stiffness", "2 N m/rad"),
        ("normal noise", "0.1 rad"),
        ("touch threshold", "0.2 N"),
        ("push force", "1 N"),
        ("speed limit", "0.6 rad/s"),
        ("torque limit", "0.5 N m"),
        ("action latency", "0.05 s"),
    ]
    assert not_as_usual(SceneConfig()) == []


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (words.between(12.3, 11.0, 13.0, "rad", 1), "12.3 rad (11.0 to 13.0)"),
        (words.between(-0.001, -0.5, 0.5), "0.00 (-0.50 to 0.50)"),
        (words.between(0.5, 0.25, 0.75, "%", 0, 100.0), "50 % (25 to 75)"),
        (words.between(90.0, 80.0, 100.0, "°", 0), "90° (80 to 100)"),
        (words.between(None, None, None), "-"),
        (words.between(1.0, np.nan, np.nan, "s"), "1.00 s"),
        (words.interval(Estimate(1.0, 0.5, 1.5, 8), "rad", 1), "1.0 rad (0.5 to 1.5)"),
        (words.spread({"median": 1.0, "p10": 0.0, "p90": 2.0}, "s", 1), "1.0 s (0.0 to 2.0)"),
        (words.number(-0.0049, 2), "0.00"),
        (words.number(-0.0151, 2), "-0.02"),
        (words.number(-10.0, 0), "-10"),
        (words.number(np.inf, 2), "-"),
        (words.percent(0.456), "46 %"),
        (words.percent(None), "-"),
        (words.share(8, 10, 0.49, 0.943), "8 of 10, 80 % (49 to 94 %)"),
        (words.about("-x"), "about -x"),
        (words.about((0.0, 0.6, 0.8)), "about (0, 0.6, 0.8)"),
    ],
)
def test_figures_as_people_read_them(found: str, said: str) -> None:
    assert found == said


def test_one_trial_of_a_batch() -> None:
    whole = trace((3,))
    alone = whole.trial(1)
    assert alone.rotation.shape == alone.held.shape == (11,)
    assert alone.contact_normal.shape == (11, 2, 3)
    assert {name: value.shape for name, value in alone.diagnostics.items()} == {
        "0.residual": (10,), "finger": (10,),
    }  # fmt: skip
    assert summarise(alone) == summarise(whole, 1)


def test_controllers_made_of_others_are_told_apart() -> None:
    names = ("commanded:dex5-cube-z,runs/a/b.npz", "commanded:dex5-sphere-x", "planned:out/t.npz")
    assert [title_of(name) for name in names] == [
        "turning as commanded (dex5-cube-z, b.npz)", "turning as commanded (dex5-sphere-x)",
        "planned gait (t.npz)",
    ]  # fmt: skip
    assert title_of("igm") == "in-grasp manipulation" and title_of("mine") == "mine"
    lines = [tuple(controller_line(name).values()) for name in (*names, "igm", "coordinated")]
    assert len(set(lines)) == len(lines)


@pytest.mark.parametrize(
    ("lengths", "columns"), [([], 1), ([10, 10], 2), ([22] * 5, 3), ([60, 50, 6], 1), ([90], 1)]
)
def test_columns_of_a_legend(lengths: list[int], columns: int) -> None:
    assert legend_columns(["x" * length for length in lengths]) == columns
