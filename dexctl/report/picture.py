"""The picture of the README: key frames of a gait above its contact diagram."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np

from dexctl.report.figures import contact_diagram, switching_fingers
from dexctl.report.style import controller_line, drawing, new_figure
from dexctl.report.summary import column
from dexctl.sim import Trace

_CLOSE_UP = 0.82  # the part of the picture's height that is shown


def compose(trace: Trace, pictures: Mapping[float, np.ndarray], title: str) -> bytes:
    """The picture as the content of a PNG file.

    Args:
        trace: of one trial.
        pictures: its key frames ``(height, width, 3)`` by simulated time [s].
        title: above everything.
    """
    rotation = column(trace.rotation)
    with drawing():
        figure = new_figure(11.0, 5.4)
        figure.suptitle(title, x=0.012, ha="left", weight="bold", fontsize=13)
        figure.get_layout_engine().set(h_pad=0.02, hspace=0.0)  # type: ignore[union-attr]
        top, bottom = figure.subfigures(2, 1, height_ratios=(1.3, 1.7), squeeze=False)[:, 0]
        for axes, (time, picture) in zip(
            top.subplots(1, len(pictures), squeeze=False)[0], pictures.items(), strict=True
        ):
            axes.imshow(_centre(picture), interpolation="lanczos")
            axes.set_axis_off()
            angle = np.rad2deg(rotation[np.argmin(np.abs(trace.time - time))])
            axes.set_title(
                f"{time:.1f} s, {angle:.0f}°", fontsize=10, weight="normal", loc="center"
            )
        diagram, turn = bottom.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
        contact_diagram(diagram, trace)
        outlined = " (outlined: being switched)" if switching_fingers(trace) is not None else ""
        diagram.set_title(f"Fingertips in touch{outlined}")
        line = controller_line("coordinated")
        turn.plot(trace.time, np.rad2deg(rotation), lw=2.0, **line)
        turn.set(xlabel="time [s]", ylabel="rotation [deg]")
        turn.set_ylim(bottom=min(0.0, float(np.rad2deg(rotation.min()))))
        for time in pictures:
            turn.axvline(time, color="#7b8794", lw=0.8, ls=(0, (2, 2)))
        bottom.align_ylabels([diagram, turn])
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()


def png(picture: np.ndarray) -> bytes:
    """A picture ``(height, width, 3)`` uint8 as the content of a PNG file."""
    with drawing():  # says so where there is no matplotlib
        from matplotlib.image import imsave

        buffer = io.BytesIO()
        imsave(buffer, picture, format="png")
    return buffer.getvalue()


def _centre(picture: np.ndarray) -> np.ndarray:
    """The square in the middle of a picture, where the hand is."""
    height, width = picture.shape[:2]
    side = round(_CLOSE_UP * min(height, width))
    left, top = (width - side) // 2, (height - side) // 2
    return picture[top : top + side, left : left + side]
