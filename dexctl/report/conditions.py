"""The section of a report that says how to get the same figures again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dexctl.report import html


def conditions(
    setting: Mapping[str, Any], control_period: float, command: str, machine: Mapping[str, Any]
) -> str:
    """The section that says under what conditions a report's figures were found."""
    gravity = ", ".join(f"{g:g}" for g in setting["gravity_m_s2"])
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    width = setting["object_width_m"]
    return html.section(
        "Conditions",
        html.facts(
            [
                ("command", command),
                ("hand", str(setting["hand"])),
                (
                    "object",
                    f"{setting['object']}, "
                    + (f"{width:g} m wide, " if width else "")
                    + f"{setting['object_mass_kg']:g} kg, friction {setting['friction']:g}",
                ),
                ("gravity", f"({gravity}) m/s²"),
                ("seed", str(setting["seed"])),
                ("control", f"{1 / control_period:g} Hz, 10 physics steps each"),
                ("start", "settled grasp, set-points disturbed by N(0, 0.02 rad)"),
                ("machine", f"{machine['processor']}, {machine['cores']} cores"),
                ("system", f"{machine['system']}, Python {machine['python']}"),
                ("versions", versions),
            ]
        ),
    )
