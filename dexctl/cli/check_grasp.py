"""``dexctl check-grasp``: how good the settled grasp of an object is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.cli.output import notes, print_json, results
from dexctl.cli.parsing import check_count, check_seconds
from dexctl.cli.trials import CONTROL_PERIOD, SceneOptions
from dexctl.exceptions import InvalidInput, SimulationError

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator, Scene
    from dexctl.state import GraspState


@dataclass(kw_only=True)
class CheckGrasp(SceneOptions):
    """Settle a grasp and say how good it is.

    Reports the contacts, force closure, the qualities of the grasp map, the residual of the
    stability QP, the forces that hold the object's weight inside the friction cones, and whether
    the object stays when the set-points are held. One grasp is taken as it settles; several get
    set-points disturbed by N(0, 0.02 rad). Exits with 1 where a grasp fails a check.
    """

    num_envs: int = 1
    """How many grasps."""
    seconds: float = 2.0
    """How long the dynamic check holds the set-points [s]."""
    seed: int = 0
    """Seed of the first grasp's disturbance; grasp i has seed + i."""
    json: bool = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        check_count("--num-envs", self.num_envs)
        check_seconds(self.seconds, CONTROL_PERIOD)
        scene = self.build_scene()
        from dexctl.sim import BatchSimulator

        disturbance = 0.02 if self.num_envs > 1 else 0.0
        if not self.json:
            notes().print(f"holding the set-points for {self.seconds:g} s", style="dim")
        with BatchSimulator(scene, self.num_envs, CONTROL_PERIOD, disturbance=disturbance) as sim:
            self.set_friction(sim)
            sim.reset(self.seed)
            try:
                if self.num_envs > 1:  # the contacts are those of the undisturbed grasp until then
                    grasp_at_rest(sim)
                found = self._check(scene, sim)
            except InvalidInput as error:  # not the user's input any more
                raise SimulationError(f"the check failed: {error}") from error
        if self.json:
            print_json(found)
        else:
            self._print(found)
        return 0 if all(found["static"]["stable"]) and all(found["dynamic"]["stable"]) else 1

    def _check(self, scene: Scene, sim: BatchSimulator) -> dict[str, Any]:
        from dexctl import grasp

        hand, state = scene.hand, sim.read()
        origin = state.object_position
        assert origin is not None  # the simulator knows where the object is
        contacts = (state.contact_position, state.contact_normal, state.in_contact, origin)
        weight = np.concatenate([scene.object_mass * scene.gravity, np.zeros(3)])
        effort = hand.effort if np.isfinite(hand.effort).all() else None
        static = grasp.check_static(
            *contacts,
            self.friction,
            external_wrench=weight,
            jacobian=hand.contact_jacobian(state.q, state.contact_position),
            effort=effort,
        )
        dynamic = grasp.check_stable(sim, self.seconds)
        solution = grasp.stability_forces(*contacts)
        assert static.forces is not None  # a wrench was given
        return {
            "command": "check-grasp",
            **self.describe(scene),
            "grasps": self.num_envs,
            "seed": self.seed,
            "fingers": _fingers(hand.fingertip_names, state),
            "contacts": static.contacts,
            "force_closure": static.closure,
            "epsilon_quality": grasp.epsilon_quality(*contacts, self.friction),
            "smallest_singular_value": grasp.smallest_singular_value(*contacts),
            "isotropy": grasp.isotropy(*contacts),
            "stability_residual": solution.residual,
            "static": {
                "stable": static.stable,
                "holds_weight": static.forces.feasible,
                "largest_normal_force_n": static.forces.normal.max(axis=-1),
                "torque_limits": effort is not None,
            },
            "dynamic": {
                "stable": dynamic.stable,
                "seconds": self.seconds,
                "displacement_m": dynamic.displacement,
                "rotation_rad": dynamic.rotation,
                "contacts_at_the_end": dynamic.contacts,
            },
        }

    def _print(self, found: dict[str, Any]) -> None:
        from rich.table import Table

        console, many = results(), self.num_envs > 1
        what = f"{self.hand} holds a {self.object}, {self.palm}"
        count = f": {self.num_envs} disturbed grasps, median (lowest to highest)" if many else ""
        console.print(f"[bold]{what}{count}[/bold]")
        if not many:
            fingers = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
            for heading in ("fingertip", r"force \[N]", r"position \[m]", "normal"):
                fingers.add_column(heading, justify="right" if "force" in heading else "left")
            for finger in found["fingers"]:
                touching = finger["in_contact"][0]
                fingers.add_row(
                    finger["name"],
                    f"{finger['force_n'][0]:.2f}" if touching else "no touch",
                    _vector(finger["position_m"][0], 3) if touching else "",
                    _vector(finger["normal"][0], 2) if touching else "",
                )
            console.print(fingers, "")
        static, dynamic = found["static"], found["dynamic"]
        limits = "and torque limits" if static["torque_limits"] else "(torque limits unknown)"
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
        for label, values, digits in (
            ("fingertips in touch", found["contacts"], 0),
            ("force closure", found["force_closure"], None),
            ("epsilon quality (L1)", found["epsilon_quality"], 3),
            ("smallest singular value", found["smallest_singular_value"], 3),
            ("isotropy", found["isotropy"], 3),
            ("stability residual", found["stability_residual"], 3),
            (f"holds its weight in the cones {limits}", static["holds_weight"], None),
            (r"largest normal force needed \[N]", static["largest_normal_force_n"], 2),
            ("static check", static["stable"], None),
            (rf"moves when held for {self.seconds:g} s \[mm]", 1e3 * dynamic["displacement_m"], 1),
            ("dynamic check", dynamic["stable"], None),
        ):
            table.add_row(label, _spread(np.asarray(values), digits))
        console.print(table)


def grasp_at_rest(sim: BatchSimulator, seconds: float = 0.5) -> None:
    """Hold the set-points until the fingers are where these take them."""
    q_target = sim.read().q_target
    for _ in range(round(seconds / sim.control_period)):
        sim.write(q_target)
        sim.step()


def _fingers(names: tuple[str, ...], state: GraspState) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "in_contact": state.in_contact[:, i],
            "force_n": state.contact_force[:, i],
            "position_m": state.contact_position[:, i],
            "normal": state.contact_normal[:, i],
        }
        for i, name in enumerate(names)
    ]


def _spread(values: np.ndarray, digits: int | None) -> str:
    """One value, or what many come to; yes or no without ``digits``."""
    if digits is None:
        if len(values) == 1:
            return "yes" if values[0] else "[bold red]no[/bold red]"
        return f"{values.sum()} of {len(values)}"
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    low, middle, high = values.min(), np.median(values), values.max()
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def _vector(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{value:{digits + 3}.{digits}f}" for value in values + 0.0)
