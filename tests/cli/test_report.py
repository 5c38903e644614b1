"""Figures of merit, plots and the page, with numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.files import aside, write_text
from dexctl.report import figures, html, summarise, summarise_batch
from dexctl.report.style import drawing
from dexctl.report.summary import share_of
from dexctl.sim import Trace


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
    assert found.latency_median == pytest.approx(5.5e-3)
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
