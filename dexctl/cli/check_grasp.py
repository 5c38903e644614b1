"""``dexctl check-grasp``: how good grasps are, settled ones or those of a file."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.text import Text

from dexctl.cli.checks import check_count, check_seconds, make_folder
from dexctl.cli.output import notes, print_json, progress, results, table, to_json
from dexctl.cli.parsing import Switch
from dexctl.cli.trials import check_viz, describe, scene_of, simulation
from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.settings import NESTED
from dexctl.sim import GraspStates, SceneConfig, SettleFailure

if TYPE_CHECKING:
    from dexctl.sim import Simulation
    from dexctl.state import GraspState

PICTURES = 16  # drawing takes a quarter of a second each


@dataclass(kw_only=True)
class CheckGrasp:
    """Say how good a grasp is: the settled one, disturbed ones, or those of a file.

    Reports the contacts, force closure, the qualities of the grasp map, the residual of the
    stability QP, the forces that hold the object's weight inside the friction cones, and whether
    the object stays when the set-points are held. Exits with 1 where a grasp fails a check.
    """

    num_envs: int | None = None
    """How many grasps, disturbed where they are several; of a file the first so many; none: one,
    as it settles, or all of the file."""
    seconds: float = 2.0
    """How long the dynamic check holds the set-points [s]."""
    seed: int = 0
    """Seed of the first grasp's disturbance; grasp i has seed + i."""
    out: Path | None = None
    """Folder for check-grasp.json and pictures of the first 16 grasps (wants an OpenGL)."""
    json: Switch = False
    """Print one JSON object instead of the table."""
    scene: Annotated[SceneConfig, NESTED] = field(default_factory=SceneConfig)

    def run(self) -> int:
        if self.num_envs is not None:
            check_count("--num-envs", self.num_envs)
        check_seconds(self.seconds, self.scene.control_period)
        if self.out is not None:
            check_viz("dexctl check-grasp --out")
        folder = None if self.out is None else make_folder(self.out)
        states = self._states()
        count = self.num_envs or (1 if states is None else len(states))
        config = replace(self.scene, initial_states=None)
        if states is not None or count == 1:
            config = replace(config, disturbance=0.0)
        try:
            held = simulation(config, count, self.seed)
        except SettleFailure as failure:
            self._explain(failure, folder)
            raise
        with held as sim:
            if states is not None:
                sim.place(states, np.arange(count))
            if not self.json:
                notes().print(f"holding the set-points for {self.seconds:g} s", style="dim")
            try:
                if states is None and count > 1:  # until then they touch as if undisturbed
                    grasp_at_rest(sim)
                found = self._check(sim)
            except InvalidInput as error:  # not the user's input any more
                raise SimulationError(f"the check failed: {error}") from error
            if folder is not None:
                self._write(folder, sim, found)
        if self.json:
            print_json(found)
        else:
            self._print(found)
        return 0 if all(found["static"]["stable"]) and all(found["dynamic"]["stable"]) else 1

    def _explain(self, failure: SettleFailure, folder: Path | None) -> None:
        """What was tried where nothing holds: on the terminal, and in the folder with a picture."""
        console, names = notes(), failure.scene.hand.fingertip_names
        failure.__notes__.clear()  # this is the command that they point to
        alike = Counter((one.how, one.reason) for one in failure.attempts)
        shown = table("tried", "fingers", "what came of it")
        for (how, reason), times in alike.items():
            shown.add_row(f"{times} x", how, reason)
        console.print(shown)
        if failure.closest is not None and not np.isnan(failure.closest.gap).all():
            gaps = zip(names, (1000 * failure.closest.gap).round(1) + 0.0, strict=True)
            far = ", ".join(f"{name} {gap:g}" for name, gap in gaps)
            console.print(f"from touching, in the attempt that came closest [mm]: {far}")
        if folder is None:
            return
        from dexctl.files import write_text
        from dexctl.sim import draw_failure

        found = {
            "command": "check-grasp",
            "held": False,
            "error": str(failure),
            "advice": failure.advice,
            "fingers": names,
            "attempts": [
                {
                    "fingers": one.how,
                    "turned_rad": one.yaw,
                    "reason": one.reason,
                    "from_touching_m": one.gap,
                }
                for one in failure.attempts
            ],
        }
        write_text(folder / "check-grasp.json", to_json(found) + "\n")
        try:
            draw_failure(failure, folder / "not_held.png")
        except SimulationError as error:
            console.print(f"no picture: {error}")

    def _states(self) -> GraspStates | None:
        """Those of the file that are of the object, as many as are wanted."""
        if self.scene.initial_states is None or len(self.scene.object) != 1:
            return None
        states, name = GraspStates.load(self.scene.initial_states), self.scene.object[0]
        if name not in states.object:
            known = ", ".join(sorted(set(states.object.tolist())))
            raise InvalidInput(f"--initial-states has none of the object {name!r}, only of {known}")
        mine = states.of(name)
        if self.num_envs is not None and self.num_envs > len(mine):
            raise InvalidInput(
                f"--num-envs is {self.num_envs}; --initial-states has {len(mine)} of the object "
                f"{name!r}"
            )
        return mine

    def _check(self, sim: Simulation) -> dict[str, Any]:
        from dexctl import grasp

        scene, hand, state = scene_of(sim), sim.hand, sim.state
        origin, friction = state.object_position, sim.sim.friction[:, None]
        assert origin is not None  # the simulator knows where the object is
        contacts = (state.contact_position, state.contact_normal, state.in_contact, origin)
        weight = np.concatenate([scene.object_mass * scene.gravity, np.zeros(3)])
        effort = hand.effort if np.isfinite(hand.effort).all() else None
        cones = np.broadcast_to(friction, state.in_contact.shape)
        static = grasp.check_static(
            *contacts,
            cones,
            external_wrench=weight,
            jacobian=hand.contact_jacobian(state.q, state.contact_position),
            effort=effort,
        )
        dynamic = grasp.check_stable(sim, self.seconds)
        solution = grasp.stability_forces(*contacts)
        assert static.forces is not None  # a wrench was given
        return {
            "command": "check-grasp",
            **describe(self.scene, scene),
            "grasps": sim.num_envs,
            "seed": self.seed,
            "fingers": _fingers(hand.fingertip_names, state),
            "contacts": static.contacts,
            "force_closure": static.closure,
            "epsilon_quality": grasp.epsilon_quality(*contacts, cones),
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

    def _write(self, folder: Path, sim: Simulation, found: dict[str, Any]) -> None:
        """The figures, and a picture of each grasp as it was before the check."""
        from dexctl.files import write_text
        from dexctl.report.film import Moment
        from dexctl.sim import Recorder

        console, paths = notes(), [folder / "check-grasp.json"]
        write_text(paths[0], to_json(found) + "\n")
        qpos, touch = sim.sim.qpos, sim.state.in_contact
        try:
            recorder = Recorder(scene_of(sim), None)
        except SimulationError as error:
            console.print(f"no pictures: {error}")
        else:
            with recorder, progress(console) as bar:
                for i in bar.track(range(min(len(qpos), PICTURES)), description="drawing"):
                    recorder(Moment(0.0, qpos[i], touch[i]))
                    paths.append(folder / f"grasp_{i}.png")
                    recorder.picture(paths[-1])
        console.print(f"in {folder}: {', '.join(path.name for path in paths)}")

    def _print(self, found: dict[str, Any]) -> None:
        console, many = results(), found["grasps"] > 1
        what = f"{self.scene.hand_name} holds a {self.scene.object[0]}, {self.scene.palm}"
        kind = "disturbed grasps" if self.scene.initial_states is None else "grasps of the file"
        count = f": {found['grasps']} {kind}, median (lowest to highest)" if many else ""
        console.print(f"{what}{count}", style="bold")
        if not many:
            console.print(_finger_table(found["fingers"]), "")
        static, dynamic = found["static"], found["dynamic"]
        limits = "and torque limits" if static["torque_limits"] else "(torque limits unknown)"
        shown = table()
        for label, values, digits in (
            ("fingertips in touch", found["contacts"], 0),
            ("force closure", found["force_closure"], None),
            ("epsilon quality (L1)", found["epsilon_quality"], 3),
            ("smallest singular value", found["smallest_singular_value"], 3),
            ("isotropy", found["isotropy"], 3),
            ("stability residual", found["stability_residual"], 3),
            (f"holds its weight in the cones {limits}", static["holds_weight"], None),
            ("largest normal force needed [N]", static["largest_normal_force_n"], 2),
            ("static check", static["stable"], None),
            (f"moves when held for {self.seconds:g} s [mm]", 1e3 * dynamic["displacement_m"], 1),
            ("dynamic check", dynamic["stable"], None),
        ):
            shown.add_row(label, _spread(np.asarray(values), digits))
        console.print(shown)


def grasp_at_rest(sim: Simulation, seconds: float = 0.5) -> None:
    """Hold the set-points until the fingers are where these take them."""
    q_target = sim.state.q_target
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


def _finger_table(fingers: list[dict[str, Any]]) -> Any:
    """Where each finger of a single grasp touches, and how hard."""
    shown = table("fingertip", "force [N]", "position [m]", "normal", right=("force [N]",))
    for finger in fingers:
        touching = finger["in_contact"][0]
        shown.add_row(
            finger["name"],
            f"{finger['force_n'][0]:.2f}" if touching else "no touch",
            _vector(finger["position_m"][0], 3) if touching else "",
            _vector(finger["normal"][0], 2) if touching else "",
        )
    return shown


def _spread(values: np.ndarray, digits: int | None) -> str | Text:
    """One value, or what many come to; yes or no without ``digits``."""
    if digits is None:
        if len(values) == 1:
            return "yes" if values[0] else Text("no", "bold red")
        return f"{values.sum()} of {len(values)}"
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    low, middle, high = values.min(), np.median(values), values.max()
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def _vector(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{value:{digits + 3}.{digits}f}" for value in values + 0.0)
