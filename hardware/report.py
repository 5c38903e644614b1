"""A run's log as one HTML page: what happened, tracking, torques, temperatures, rates, contacts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dexctl.report import html
from dexctl.report.style import drawing, finger_colour, new_figure
from dexctl.state import Floats
from hardware.log import Log

__all__ = ["DROP_DISTANCE", "build", "figures_of_merit", "rotation_about_z", "write"]

DROP_DISTANCE = 0.05  # as in `dexctl.sim.trial` [m]


def figures_of_merit(log: Log) -> dict[str, float]:
    """Numbers of a log, with units in their names; {} of a log without ticks."""
    ticks = log.ticks
    if len(ticks.get("time", ())) < 2:
        return {}
    time, error = ticks["time"], ticks["q_target"] - ticks["q"]
    found = {
        "seconds": float(time[-1] - time[0]),
        "rate_hz": float((len(time) - 1) / (time[-1] - time[0])),
        "tracking_rms_rad": float(np.sqrt(np.nanmean(error**2))),
        "tracking_worst_rad": float(np.nanmax(np.abs(error))),
        "torque_rms_nm": float(np.sqrt(np.nanmean(ticks["torque"] ** 2))),
        "torque_worst_nm": float(np.nanmax(np.abs(ticks["torque"]))),
        "late_over_1ms": float(np.nanmean(ticks["lateness"] > 1e-3)),
        "lateness_p99_s": float(np.nanpercentile(ticks["lateness"], 99)),
        "stale_joints": float(1.0 - np.nanmean(ticks["fresh"])),
        "mean_contacts": float(np.nanmean(ticks["in_contact"].sum(axis=1))),
    }
    angle = rotation_about_z(log)
    if angle is not None:
        lost = _lost(log)
        found["rotation_rad"] = float(angle[-1 if lost is None else lost])
        if lost is not None:
            found["object_lost_at_s"] = float(time[lost])
    return found


def _lost(log: Log) -> int | None:
    """First tick with the object farther from where it began than `DROP_DISTANCE`, if any."""
    position = log.ticks.get("object_position")
    if position is None or position.dtype == object or position.ndim != 2:
        return None
    away = np.flatnonzero(np.linalg.norm(position - position[0], axis=1) > DROP_DISTANCE)
    return int(away[0]) if len(away) else None


def rotation_about_z(log: Log) -> Floats | None:
    """Unwrapped turn of the object about z since the first tick, ``(T,)`` [rad].

    None where nothing tracks the object, as on a real hand.
    """
    quaternion = log.ticks.get("object_quaternion")
    if quaternion is None or quaternion.dtype == object or quaternion.ndim != 2:
        return None
    w, x, y, z = quaternion.T
    w0, x0, y0, z0 = quaternion[0]
    # of q * conj(q0): the twist about z of the swing-twist decomposition
    real = w * w0 + x * x0 + y * y0 + z * z0
    along = -w * z0 - x * y0 + y * x0 + z * w0
    return np.unwrap(2.0 * np.arctan2(along, real))


def build(log: Log) -> str:
    """The report as one HTML document; a log without ticks gives a page that says so."""
    run = log.run
    merits = figures_of_merit(log)
    sections = [html.section("What happened", *_what_happened(log))]
    if merits:
        sections.append(
            html.section("Figures", html.facts((name, f"{v:.4g}") for name, v in merits.items()))
        )
        with drawing():
            sections.append(html.section("Joints", _tracking(log), _torque(log)))
            sections.append(html.section("Clock", _clock(log)))
            if log.ticks["in_contact"].any():
                sections.append(html.section("Touch", _touch(log)))
            if log.health:
                sections.append(html.section("Servos", _health(log)))
    else:
        sections.append(html.paragraph("The log holds no ticks.", "note"))
    about = [(key, str(value)) for key, value in run.items() if not isinstance(value, dict | list)]
    sections.append(html.section("Run", html.facts([("log", log.path.name), *about])))
    name = str(run.get("controller", "a run"))
    return html.page(f"{name} on a servo hand", str(run.get("date", "")), sections)


def _what_happened(log: Log) -> list[str]:
    summary = log.summary
    parts = []
    if log.cut:
        parts.append(html.paragraph("The log ends before its end mark: the run was cut off."))
    if summary:
        cause = f" ({summary['cause']})" if summary.get("cause") else ""
        parts.append(
            html.paragraph(f"Outcome: {summary['outcome']}{cause}. {summary['torque_message']}.")
        )
        counts = summary.get("counts", {})
        parts.append(html.table(("event", "times"), [(k, str(v)) for k, v in counts.items()]))
    else:
        parts.append(html.paragraph("No summary: the torque state is not known from this log."))
    rows = [
        (
            f"{e.get('time', 0):.2f} s",
            str(e.get("event")),
            str(e.get("state")),
            str(e.get("detail")),
        )
        for e in log.events
    ]
    return [*parts, html.table(("time", "event", "state", "detail"), rows)]


def _fingers(log: Log, count: int) -> list[int]:
    """The finger of each joint: equal shares, as in all hands of serial fingers known here."""
    fingers = max(log.ticks["in_contact"].shape[1], 1)
    return [j * fingers // count for j in range(count)]


def _tracking(log: Log) -> str:
    time, error = log.ticks["time"], log.ticks["q_target"] - log.ticks["q"]
    figure = new_figure(8.0, 2.6)
    axes = figure.subplots()
    for j, finger in enumerate(_fingers(log, error.shape[1])):
        axes.plot(time, error[:, j], color=finger_colour(finger), linewidth=0.7)
    axes.set(xlabel="time [s]", ylabel="rad", title="Set-point less joint angle")
    return html.plot(figure, "tracking error over time", "One colour per finger.")


def _torque(log: Log) -> str:
    time, torque = log.ticks["time"], log.ticks["torque"]
    figure = new_figure(8.0, 2.6)
    axes = figure.subplots()
    for j, finger in enumerate(_fingers(log, torque.shape[1])):
        axes.plot(time, torque[:, j], color=finger_colour(finger), linewidth=0.7)
    axes.set(xlabel="time [s]", ylabel="N m", title="Torque, from the servos' current")
    return html.plot(figure, "torque over time")


def _clock(log: Log) -> str:
    figure = new_figure(8.0, 2.4)
    axes = figure.subplots(1, 2)
    lateness = 1e3 * log.ticks["lateness"]
    axes[0].plot(log.ticks["time"], lateness, linewidth=0.7)
    axes[0].set(xlabel="time [s]", ylabel="ms", title="Lateness of ticks")
    seconds = log.ticks.get("controller_seconds")
    if seconds is not None and np.isfinite(seconds).any():
        axes[1].hist(1e3 * seconds[np.isfinite(seconds)], bins=40)
    axes[1].set(xlabel="ms", ylabel="ticks", title="Controller's time")
    return html.plot(figure, "lateness over time, and how long the controller took")


def _touch(log: Log) -> str:
    time, force = log.ticks["time"], log.ticks["contact_force"]
    angle = rotation_about_z(log)
    figure = new_figure(8.0, 4.4 if angle is not None else 2.6)
    axes = np.atleast_1d(figure.subplots(1 if angle is None else 2, 1))
    for i in range(force.shape[1]):
        axes[0].plot(time, force[:, i], color=finger_colour(i), linewidth=0.8)
    axes[0].set(ylabel="N", title="Normal force of each fingertip")
    if angle is not None:
        end = _lost(log)  # a fallen object turns too, and nobody turns it
        axes[1].plot(time[:end], angle[:end])
        axes[1].set(ylabel="rad", title="Object's turn about z (known in simulation only)")
    axes[-1].set(xlabel="time [s]")
    return html.plot(figure, "contact forces over time")


def _health(log: Log) -> str:
    time = [item["time"] for item in log.health]
    figure = new_figure(8.0, 2.4)
    axes = figure.subplots(1, 2)
    for axis, name, unit in ((axes[0], "temperature", "C"), (axes[1], "voltage", "V")):
        values = np.array([item[name] for item in log.health], float)
        axis.plot(time, values, linewidth=0.8)
        axis.set(xlabel="time [s]", ylabel=unit, title=name.capitalize())
    return html.plot(figure, "temperature and voltage over time", "One line per servo.")


def write(log: Log, path: Path) -> None:
    """Write the report to ``path``."""
    from dexctl.files import write_text

    write_text(path, build(log))
