"""``dexctl hands check``: whether a hand is what its files say, and holds something."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.text import Text

from dexctl.cli.checks import check_count, check_seconds
from dexctl.cli.hand_checks import SECONDS, TRIALS, check_hand
from dexctl.cli.output import notes, print_json, results, table
from dexctl.cli.parsing import Switch
from dexctl.exceptions import DexctlError

if TYPE_CHECKING:
    from dexctl.sim import Scene


@dataclass(kw_only=True)
class Check:
    """Check a hand: Jacobians, simulator against kinematics, touch, reach, and whether it holds.

    Exits with 1 where it fails a check.
    """

    hand: Annotated[str, tyro.conf.Positional]
    """Name of the hand, its toml, or its MJCF or URDF file."""
    object: str | None = None
    """Name of the object that it is to hold; none: what its toml says, else a cube."""
    seconds: float = SECONDS
    """How long it has to hold that [s]."""
    trials: int = TRIALS
    """How many disturbed grasps, palm up and as many palm down."""
    seed: int = 0
    """Seed of postures and disturbances."""
    out: Path | None = None
    """Folder for pictures and report.html."""
    json: Switch = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        from dexctl import hands

        check_seconds(self.seconds, 0.05)
        check_count("--trials", self.trials)
        if self.object is not None:
            from dexctl.sim.scene_config import SceneConfig

            SceneConfig(object=(self.object,)).check_objects()
        hand = hands.load(self.hand)
        scenes: list[Scene] = []
        found = []
        shown = table("check", "", "found")
        words = {True: "yes", False: Text("no", "bold red"), None: ""}
        for one in check_hand(
            hand, self.object, seconds=self.seconds, trials=self.trials, seed=self.seed,
            built=scenes.append,
        ):  # fmt: skip
            found.append(one)
            shown.add_row(one.name, words[one.good], one.said)
        pictures = []
        if self.out is not None:
            from dexctl.cli.hand_page import hand_page

            try:
                pictures = hand_page(
                    self.out.expanduser(),
                    scenes[0] if scenes else None,
                    title=hand.name,
                    source=str(hand.path),
                    checks=found,
                )
            except DexctlError as error:
                notes().print(f"dexctl: no pictures: {error}")
        if self.json:
            checks = [one._asdict() for one in found]
            print_json(
                {"command": "hands check", "hand": self.hand, "sha256": hand.digest,
                 "checks": checks, "pictures": pictures}
            )  # fmt: skip
        else:
            results().print(shown)
        return 0 if all(one.good is not False for one in found) else 1
