"""Suggested grasps: the best of a search, settled in the simulator, palm up and palm down.

The search (`dexctl.sim.grasp_search`) and its score (`dexctl.sim.grasp_score`) are kinematics and
the kernel; what is returned has been held by the simulated hand. Everything in it can be said in a
hand's toml: ``SuggestedGrasp.applied``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.hand import HandModel
from dexctl.hand_config import HandConfig, HeldObject, PostureConfig
from dexctl.sim import checks
from dexctl.sim.grasp_score import GraspScore, Ranked, ranked
from dexctl.sim.grasp_search import LEAST_FINGERS, GraspSearch, Placement
from dexctl.sim.no_grasp import explained, flat_fingers
from dexctl.sim.objects import MESH
from dexctl.sim.scene import Scene
from dexctl.sim.settle import SettledGrasp, settle
from dexctl.sim.settle_failure import SettleFailure
from dexctl.sim.shapes import Shape
from dexctl.sim.tactile import TouchSensors
from dexctl.sim.workspace import Workspace
from dexctl.state import Floats
from dexctl.validation import check_seed

HOLDING_TIME = 10.0
"""How long a suggested grasp is to hold after it has settled [s]."""
_LOOK = 0.5  # how often it is looked at in that time [s]
_DRIFT = 0.01  # of the object in that time, at most [m]
_OPENING = 0.03  # the open fingertips are so far from the object [m]
_FAR = (0.0, 0.0, 10.0)  # where the object is out of the way [m]
PALMS = ("up", "down")
_PLACEMENTS, _NEARBY = 240, 80  # places that are looked at, all over and near a grasp
_REACH = (0.15, 0.45)  # least and most that is written down of how far a finger can swing [rad]


class SuggestedGrasp(NamedTuple):
    """A grasp that was found.

    Attributes:
        object: its name.
        centre: where it is held, hand frame, ``(3,)`` [m].
        size: its width [m]; 0 for a mesh of its own size.
        yaw: how far it is turned about z [rad].
        open_q: the open hand, ``(d,)`` [rad].
        grasp_q: the hand about to touch it, ``(d,)`` [rad].
        fingers: names of the fingertips that hold it.
        score: how good it is by the kernel, with its parts.
        time_up, time_down: for how long it held, palm up and palm down, of 10 s with nothing but
            the set-points held; 0: it did not settle [s].
    """

    object: str
    centre: Floats
    size: float
    yaw: float
    open_q: Floats
    grasp_q: Floats
    fingers: tuple[str, ...]
    score: GraspScore
    time_up: float
    time_down: float

    @property
    def placement(self) -> Placement:
        """Where the object is, how wide, and how it is turned."""
        return Placement(self.centre, self.size or 1.0, self.yaw)

    @property
    def held_up(self) -> bool:
        """Whether it held to the end, palm up."""
        return self.time_up >= HOLDING_TIME

    @property
    def held_down(self) -> bool:
        """Whether it held to the end, palm down."""
        return self.time_down >= HOLDING_TIME

    @property
    def note(self) -> str:
        """What was chosen, in one line."""
        how = f"for {self.time_up:g} s palm up and {self.time_down:g} s palm down"
        size = f" {1000 * self.size:.0f} mm wide" if self.size else ""
        return (
            f"grasp suggested: {self.object}{size} at {self.centre.round(4).tolist()}, held by "
            f"{', '.join(self.fingers)}, {how}"
        )

    def applied(self, config: HandConfig, joint_names: tuple[str, ...]) -> HandConfig:
        """A hand's configuration that says this grasp.

        Args:
            config: of the hand.
            joint_names: of the hand, in its order.
        """

        def named(q: Floats) -> dict[str, float]:
            return dict(zip(joint_names, np.round(q, 4).tolist(), strict=True))

        x, y, z = np.round(self.centre, 4).tolist()
        shape = None if self.object == MESH else self.object
        least, most = _REACH
        reach = None if self.score.swing > most else round(max(self.score.swing, least), 2)
        held = HeldObject(
            centre=(x, y, z), size=round(self.size, 4) or None, shape=shape, reach=reach,
            mass=config.object.mass,
        )  # fmt: skip
        postures = PostureConfig(open=named(self.open_q), grasp=named(self.grasp_q))
        return replace(config, postures=postures, object=held)


def suggest(
    hand: HandModel,
    name: str,
    *,
    mesh: str | Path | None,
    object_mass: float | None,
    object_size: float | None,
    friction: float | ArrayLike,
    grasp_centre: ArrayLike | None,
    grip: float,
    twist: ArrayLike,
    count: int,
    tries: int,
    seed: int,
    near: SuggestedGrasp | None = None,
) -> tuple[SuggestedGrasp, ...]:
    """See `Scene.suggest_grasp`."""
    options: dict[str, Any] = {
        "mesh": mesh, "object_mass": object_mass, "friction": friction, "grip": grip
    }  # fmt: skip
    checks.count("count", count)
    checks.count("tries", tries)
    seed = check_seed(seed, 0)
    if object_size is not None:
        checks.object_size(object_size)
    if not isinstance(near, SuggestedGrasp | None):
        raise InvalidInput(f"near is {near!r}; expected a grasp that suggest_grasp gave, or None")
    wanted = checks.vector("twist", twist, 6)
    if not wanted.any():
        raise InvalidInput("twist is all zero; expected the direction in which to move the object")
    if hand.n_fingers < 2:
        raise SimulationError(
            f"{hand.name}: 1 finger, {hand.fingertip_names[0]}; expected 2 or more to hold a {name}"
        )
    search = _search(hand, name, object_size, grasp_centre, wanted, seed, options, near)
    if why := flat_fingers(search):
        raise SimulationError(f"{hand.name}: no grasp of a {name}: {why}")
    best = ranked(search, _PLACEMENTS if near is None else _NEARBY)
    if best is None or not len(best.score):
        needed = min(LEAST_FINGERS, hand.n_fingers)
        raise SimulationError(
            f"{hand.name}: no place, size and posture found in which {needed} fingertips touch a "
            f"{name} with palm and links clear of it; {explained(search)}"
        )
    held: list[SuggestedGrasp] = []
    failure: SettleFailure | None = None
    for row in _spread(best, tries):
        found, failed = _settled(hand, name, search, best, row, options)
        failure = failure or failed
        if found is not None:
            held.append(found)
        if sum(one.held_up and one.held_down for one in held) == count:
            break
    if not held:
        assert failure is not None  # one row at least was tried, and did not settle
        raise failure

    def order(one: SuggestedGrasp) -> tuple[float, ...]:
        both = min(one.time_up, one.time_down)
        return -both, -max(one.time_up, one.time_down), -one.score.total

    return tuple(sorted(held, key=order))


_FOUND: dict[tuple[Any, ...], tuple[SuggestedGrasp, ...]] = {}


def suggested(
    hand: HandModel, name: str, gravity: str | ArrayLike, **options: Any
) -> SuggestedGrasp:
    """The grasp that a scene takes where nobody says one; searched for once in a process."""
    key = (
        hand.path, hand.path.stat().st_mtime_ns, repr(hand.config), hand.joint_names, name,
        repr(options),
    )  # fmt: skip
    if key not in _FOUND:
        twist = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        _FOUND[key] = suggest(hand, name, twist=twist, count=1, tries=12, seed=0, **options)
    time = {"up": "time_up", "down": "time_down"}.get(str(gravity))
    # the first of those that hold longest
    return max(_FOUND[key], key=lambda one: 0.0 if time is None else getattr(one, time))


def _search(
    hand: HandModel,
    name: str,
    size: float | None,
    centre: ArrayLike | None,
    twist: Floats,
    seed: int,
    options: dict[str, Any],
    near: SuggestedGrasp | None = None,
) -> GraspSearch:
    own_size = name == MESH and size is None
    scene = Scene.build(
        hand, name, object_size=None if own_size else 1.0, grasp_centre=_FAR, **options
    )
    x, y, z, a, b, c = twist.tolist()
    return GraspSearch(
        workspace=Workspace(
            scene.model, hand, scene.lower, scene.upper, scene.open_q, scene.object_body, seed=seed
        ),
        shape=Shape.of_body(scene.model, scene.object_body),
        size=1.0 if own_size else size,
        centre=None if centre is None else checks.vector("grasp_centre", centre, 3),
        base=scene.open_q,
        torque=hand.effort,
        stiffness=scene.stiffness,
        grip=scene.grip,
        friction=scene.friction(),
        weight=9.81 * scene.object_mass,
        twist=(x, y, z, a, b, c),
        seed=seed,
        near=None if near is None else near.placement,
    )


def _spread(best: Ranked, count: int) -> list[int]:
    """The best ``count`` rows, neighbours of better ones later than others."""
    centres, sizes = best.contacts.centre, np.array([p.size for p in best.contacts.placement])
    first: list[int] = []
    for i in range(len(sizes)):
        near = (np.linalg.norm(centres[first] - centres[i], axis=-1) < 0.01) & (
            np.abs(sizes[first] - sizes[i]) < 0.01
        )
        if near.sum() < 2:
            first.append(i)
    later = [i for i in range(len(sizes)) if i not in first]
    return (first + later)[:count]


def _settled(
    hand: HandModel,
    name: str,
    search: GraspSearch,
    best: Ranked,
    row: int,
    options: dict[str, Any],
) -> tuple[SuggestedGrasp | None, SettleFailure | None]:
    """The grasp of a row where it holds, palm up or palm down, else why not."""
    found, place = best.contacts, best.contacts.placement[row]
    own_size = name == MESH and search.size == 1.0
    opened = _opened(search, found.q[row], found.position[row], found.normal[row])
    q, yaw = found.q[row], place.yaw
    failure: SettleFailure | None = None
    times: dict[str, float] = {}
    for palm in PALMS:
        scene = Scene.build(
            hand, name, palm, object_size=None if own_size else place.size,
            grasp_centre=place.centre, open_q=opened, grasp_q=q, **options,
        )  # fmt: skip
        try:
            settled = settle(scene, thorough=False)
        except SettleFailure as error:
            failure, times[palm] = failure or error, 0.0
            continue
        times[palm] = time_held(scene, settled)
        yaw = settled.yaw
    if not any(times.values()):
        return None, failure
    active = found.active[row]
    return (
        SuggestedGrasp(
            name, place.centre, 0.0 if own_size else place.size, yaw, opened, q,
            tuple(n for n, on in zip(hand.fingertip_names, active, strict=True) if on),
            best.score[row], times["up"], times["down"],
        ),
        failure,
    )  # fmt: skip


def _opened(search: GraspSearch, q: Floats, position: Floats, normal: Floats) -> Floats:
    """The hand with its fingertips moved away from the object, along the normals."""
    space = search.workspace
    hand, start = space.hand, q
    target = hand.fingertip_positions(q) - _OPENING * normal
    still = hand.moves.sum(axis=0) > 1
    for _ in range(40):
        configuration = hand.configuration(q)
        tips = configuration.fingertip_position
        jacobian = configuration.contact_jacobian(tips).reshape(-1, hand.nq) * ~still
        error = (target - tips).ravel()
        step = jacobian.T @ np.linalg.solve(
            jacobian @ jacobian.T + 1e-4 * np.eye(len(error)), error
        )
        q = np.clip(q + np.clip(step, -0.1, 0.1), space.lower, space.upper)
    return np.where(still, start, q)


def time_held(scene: Scene, settled: SettledGrasp, seconds: float = HOLDING_TIME) -> float:
    """How long a settled grasp holds the object with its set-points held, at most ``seconds``."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos, data.qvel = settled.qpos, settled.qvel
    data.ctrl[scene.actuators] = settled.q_target * scene.ctrl_per_radian
    sensors = TouchSensors(model, scene.hand.n_fingers)
    start = settled.qpos[scene.object_qpos][:3]
    needed, time = min(3, scene.hand.n_fingers), 0.0
    steps = round(_LOOK / model.opt.timestep)
    while time < seconds - _LOOK / 2:  # what has slipped is not waited for
        mujoco.mj_step(model, data, steps)
        if data.time < time + (steps - 0.5) * model.opt.timestep:
            return time  # it diverged, and began anew
        reading = sensors.read(data.sensordata[None, sensors.columns], 0.05)
        moved = np.linalg.norm(data.qpos[scene.object_qpos][:3] - start)
        if moved > _DRIFT or reading.in_contact[0].sum() < needed:
            return time
        time = float(data.time)
    return seconds
