"""A hand without touch sensors: full touch, switches, joint torques; nothing tracks the object.

Each by the coordinated gait and by in-grasp manipulation, with an ideal hand and with one whose
gears rub, whose encoders are off and whose sensors are late. The file is written after every row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from common import (
    PALMS,
    Figure,
    Settings,
    earlier,
    outcome,
    percent,
    percent_interval,
    progress,
    settings,
    trials,
    write,
)

import dexctl
from dexctl import controllers
from dexctl.controller import Controller
from dexctl.sim import SceneConfig, Sensing
from dexctl.sim.sensing import TOUCHES
from dexctl.state import GraspState

OBJECTS = ("cube", "cylinder", "sphere", "icosahedron", "dodecahedron")
CONTROLLERS = {"coordinated": "coordinated gait", "igm": "in-grasp manipulation"}
GEAR_FRICTION, OFFSET, LATENCY = 0.02, 0.02, 0.05  # [N m], [rad], [s]
HANDS = {
    "ideal": "an ideal hand",
    "real": f"gear friction {GEAR_FRICTION} N m, encoders {OFFSET} rad off, {LATENCY} s late",
}


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 16
    """Per row."""
    seconds: float = 20.0
    """Simulated, each trial."""
    objects: tuple[str, ...] = OBJECTS
    """Objects to turn."""


class Untracked(Controller):
    """A controller whose states have no pose of the object.

    Args:
        inner: that controller.
    """

    def __init__(self, inner: Controller) -> None:
        super().__init__(inner.hand, control_period=inner.control_period)
        self._inner = inner

    def reset(self, seed: Any = None, mask: Any = None) -> None:
        self._inner.reset(seed, mask)

    def act(self, state: GraspState) -> Any:
        return self._inner.act(replace(state, object_position=None, object_quaternion=None))


def scene(name: str, palm: str, touch: Any, hand: str) -> SceneConfig:
    """What is simulated for a row."""
    if hand == "ideal":
        return SceneConfig(object=(name,), gravity=palm, sensing=Sensing(touch=touch))
    sensing = Sensing(touch=touch, joint_offset=OFFSET, sensor_latency=LATENCY)
    return SceneConfig(object=(name,), gravity=palm, sensing=sensing, gear_friction=GEAR_FRICTION)


def table_of(rows: list[dict[str, Any]], given: Options) -> dict[str, Any]:
    """One line for each controller, hand and scene; one column for each kind of touch."""
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        key = (CONTROLLERS[row["controller"]], row["hand"], f"{row['object']}, {row['palm']}")
        lines.setdefault(key, {})[row["touch"]] = (
            f"{row['rotation_rad']['median']:.1f} rad, {percent_interval(row['holding'])}"
        )
    return {
        "title": f"Touch: median rotation in {given.seconds:g} s, share still holding (95 % "
        f"interval), {given.trials} trials each, object not tracked; real: {HANDS['real']}",
        "header": ["", "hand", "object, palm", *TOUCHES],
        "rows": [[*key, *(cells.get(t, "") for t in TOUCHES)] for key, cells in lines.items()],
    }


def figures_of(rows: list[dict[str, Any]]) -> list[Figure]:
    """All scenes together, for each controller, hand and kind of touch."""
    out = []
    for controller, hand, touch in product(CONTROLLERS, HANDS, TOUCHES):
        key = (controller, hand, touch)
        found = [r for r in rows if (r["controller"], r["hand"], r["touch"]) == key]
        if not found:
            continue
        held, of = (sum(r["holding"][k] for r in found) for k in ("count", "of"))
        turned = float(np.median([r["rotation_rad"]["median"] for r in found]))
        out.append(
            Figure(
                f"{CONTROLLERS[controller]}, touch {touch}, {HANDS[hand]}",
                f"{percent({'count': held, 'of': of, 'share': held / of})} hold, "
                f"median of {len(found)} scenes {turned:.1f} rad",
            )
        )
    return out


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("touch", given)
    names = ("controller", "hand", "object", "palm", "touch")
    done = {tuple(row[name] for name in names) for row in rows}
    hand = dexctl.hands.load("dex5")
    for key in product(CONTROLLERS, HANDS, given.objects, PALMS, TOUCHES):
        if key in done:
            continue
        kind, how, name, palm, touch = key
        controller = Untracked(controllers.make(kind, hand))
        config = scene(name, palm, touch, how)
        trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
        rows.append({**dict(zip(names, key, strict=True)), **outcome(trace)})
        row = rows[-1]
        progress(
            f"{', '.join(key)}: {row['rotation_rad']['median']} rad, {percent(row['holding'])}"
        )
        write("touch", given, figures_of(rows), [table_of(rows, given)], trials=rows, say=False)
    write("touch", given, figures_of(rows), [table_of(rows, given)], trials=rows)


if __name__ == "__main__":
    main()
