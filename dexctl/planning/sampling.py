"""sample_grasps: grasps all over an object, without a tree (thesis chapter 3, Algorithm SGS)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.files import make_parent
from dexctl.planning.arguments import check_kinds
from dexctl.planning.contacts import ContactModel
from dexctl.planning.header import TreeHeader
from dexctl.planning.metric import Metric, Nearest
from dexctl.planning.nodes import Frame, Nodes, children, put, root_of
from dexctl.planning.scene_settings import Stepping
from dexctl.planning.stability import Stability
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotate
from dexctl.settings import to_plain
from dexctl.sim import SceneConfig
from dexctl.sim.grasp_states import GraspStates
from dexctl.state import Bools, Floats
from dexctl.switch.landing import split, turned
from dexctl.validation import check_name, check_numbers, check_seed, check_whole, number, shown

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator, Scene


PLACES = ("fingertips", "joints")
_PALM = np.array([0.0, 0.0, 1.0])  # hands are described so that their palm looks along z


@dataclass(frozen=True, kw_only=True)
class GraspSampling:
    """Where objects and fingertips are put before the simulation settles them."""

    place: str = "fingertips"
    """What is drawn of the hand: the places of its fingertips, or, naively, its joints, which also
    serves hands whose joints have not a servo each."""
    displacement: float = 0.01
    """The object lies this far from where the settled grasp holds it [m]."""
    tilt: float = 0.3
    """And leans by this much [rad]; its rotation about the axis is anything."""
    overlap: float = 0.008
    """Fingertips are put up to this far inside the surface, or outside of it: each is about as
    likely to touch as not [m]."""
    azimuth: float = 0.5
    """They stand within this of where the settled grasp has them, about the direction that the palm
    looks in (z) [rad]."""
    height: float = 0.02
    """And within this of the object's centre along it [m]."""
    settle_seconds: float = 0.5
    """Simulated before contacts are counted (t_s) [s]."""
    min_contacts: int = 3
    """Fewest fingertips that touch then (n_c,min), no fewer than `Stability` asks for later."""
    apart: float = 0.1
    """Grasps nearer than this to one that is kept are not distinct, by the metric."""
    batch: int = 128
    """How many are settled at a time."""

    def __post_init__(self) -> None:
        check_name("place", self.place, PLACES)
        check_numbers(
            self,
            positive=("displacement", "tilt", "overlap", "azimuth", "settle_seconds"),
            not_negative=("height", "apart"),
        )
        check_whole(self, min_contacts=0, batch=1)


class SampledGrasps(NamedTuple):
    """What `sample_grasps` found.

    Attributes:
        nodes: the grasps, as nodes of a tree without edges.
        states: the same, for a file that episodes start from.
        tried: how many were settled.
        refused: why others were not kept, and how many.
        seconds: wall time [s].
    """

    nodes: Nodes
    states: GraspStates
    tried: int
    refused: dict[str, int]
    seconds: float


def sample_grasps(
    scene: Scene,
    count: int,
    sampling: GraspSampling | None = None,
    *,
    axis: ArrayLike = (0.0, 0.0, 1.0),
    seed: int = 0,
    metric: Metric | None = None,
    stability: Stability | None = None,
    most_tried: int | None = None,
    seconds: float | None = None,
    threads: int | None = None,
    scene_config: SceneConfig | None = None,
    path: str | Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> SampledGrasps:
    """Settle random grasps and keep those that hold (thesis chapter 3, Algorithm SGS).

    The object is put somewhere near the settled grasp, any way round; fingertips are put on an
    annulus that overlaps its surface; what has enough of them in touch after a while, nothing
    else (`Stability.fingertips_only`), and holds, is a grasp.

    Args:
        scene: hand, object and gravity.
        count: how many distinct ones are wanted.
        sampling: None: its defaults, with the `min_contacts` of ``stability``.
        axis: about which the object lies any way round. Fingertips stand around the direction that
            the palm looks in, whatever the axis.
        seed: of the random numbers.
        metric: for what counts as distinct; None: its default.
        stability: None: the default check; its `min_contacts` are those of ``sampling``.
        most_tried: give up after settling so many; None: a hundred for each that is wanted.
        seconds: give up after this time, with those that were found; None: never.
        threads: of the physics; None: every core.
        scene_config: what the scene was built from, for the states' ``meta``, which says what the
            header of a tree does, and for how the physics is stepped; None: not known.
        path: where the states are written at the end, however that comes: after Ctrl-C those that
            had been found.
        progress: called with the number of grasps so far.

    Raises:
        InvalidInput: no such number of grasps, seed, time or settings, a check that asks for more
            contacts than are sampled, fingertips that cannot be placed since joints have not a
            servo each, ``path`` cannot be written; or none was found at all.
        SimulationError: the object does not stay in the hand.
    """
    from dexctl.sim import BatchSimulator, Scene

    for name, value in (("count", count), ("most_tried", 1 if most_tried is None else most_tried)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1:
            raise InvalidInput(f"{name} is {shown(value)}; expected a whole number above 0")
    seed = check_seed(seed, 0)
    file = None if path is None else make_parent(path)
    metric = Metric() if metric is None else metric
    config, check = _settings(sampling, stability)
    check_kinds(
        (Scene, "scene", scene), (Metric, "metric", metric),
        (SceneConfig, "scene_config", scene_config),
    )  # fmt: skip
    if seconds is not None:
        number("seconds", seconds, 0.0, np.finfo(float).max, "a number above 0", above=True)
    root = root_of(scene)
    frame = Frame.of(axis, root)
    draw = _Draws(scene, frame, root, config)
    rng, start = np.random.default_rng(seed), perf_counter()
    most = 100 * count if most_tried is None else most_tried
    settings = {"sampling": config, "metric": metric, "stability": check}
    header = TreeHeader.of(
        scene, frame.axis, "sample_grasps", (),
        {name: to_plain(value) for name, value in settings.items()}, seed,
    )  # fmt: skip
    header.scene = None if scene_config is None else to_plain(scene_config)
    search, found, refused = Nearest(scene.hand.nq + 6), list[Nodes](), Counter[str]()
    try:
        with BatchSimulator(
            scene, config.batch, disturbance=0.0, threads=threads,
            **Stepping.of(scene_config)._asdict(),
        ) as sim:  # fmt: skip
            ends = np.inf if seconds is None else start + seconds
            while len(search) < count and header.expansions < most and perf_counter() < ends:
                placed, reached = draw(rng)
                kept, why = _settled(sim, placed, reached, frame, config, check)
                header.expansions += config.batch
                distinct = _distinct(search, metric.of(frame, kept), config.apart)
                refused.update(why)
                refused["distinct"] += len(kept) - len(distinct)
                found.append(kept.take(distinct))
                if progress is not None:
                    progress(min(len(search), count))
    finally:
        header.refused, header.seconds = dict(refused), perf_counter() - start
        if file is not None and any(map(len, found)):
            _first(found, count, header, scene)[1].save(file)
    if not any(map(len, found)):
        raise InvalidInput(
            f"none of {header.expansions} random grasps of {scene!r} holds: {header.refused}"
        )
    nodes, states = _first(found, count, header, scene)
    return SampledGrasps(nodes, states, header.expansions, header.refused, header.seconds)


def _settings(
    sampling: GraspSampling | None, stability: Stability | None
) -> tuple[GraspSampling, Stability]:
    """Both, with the `min_contacts` of the one that is given where the other is not."""
    if stability is None:
        config = GraspSampling() if sampling is None else sampling
        check_kinds((GraspSampling, "sampling", config))
        return config, Stability(min_contacts=config.min_contacts)
    check_kinds((Stability, "stability", stability))
    least = stability.min_contacts
    config = GraspSampling(min_contacts=least) if sampling is None else sampling
    check_kinds((GraspSampling, "sampling", config))
    if config.min_contacts == GraspSampling.min_contacts < least:  # nobody asked for fewer
        config = replace(config, min_contacts=least)
    if config.min_contacts < least:  # it would be of no effect
        raise InvalidInput(
            f"sampling.min_contacts is {config.min_contacts} and stability.min_contacts {least}, "
            "which are fingertips that touch later on; expected no more of them than at first"
        )
    return config, stability


def _first(
    found: Sequence[Nodes], count: int, header: TreeHeader, scene: Scene
) -> tuple[Nodes, GraspStates]:
    """The first ``count`` of those found, and as states."""
    nodes = Nodes.concatenate(found)
    nodes = nodes.take(np.arange(min(count, len(nodes))))
    states = GraspStates(
        hand=scene.hand.name,
        q=nodes.q,
        q_target=nodes.q_target,
        object_position=nodes.object_position,
        object_quaternion=nodes.object_quaternion,
        object=np.full(len(nodes), scene.object),
        joint_names=np.array(scene.hand.joint_names),
        meta=json.dumps(header.to_plain()),
    )
    return nodes, states


class _Draws:
    """Random poses of the object, and hands around it."""

    def __init__(self, scene: Scene, frame: Frame, root: Nodes, config: GraspSampling) -> None:
        self._scene, self._frame, self._root, self._config = scene, frame, root, config
        if config.place == "joints":  # of any hand: nothing has to be reached
            return
        try:
            self._model = ContactModel(scene, friction=0.5, margin=0.0)
        except InvalidInput as error:
            raise InvalidInput(f"{error}; expected sampling.place joints, or such a hand") from None
        geometry = self._model.geometry
        self._tip = geometry.poses(root.q).centres(geometry.tips)
        flat = split(self._tip[0] - frame.position, _PALM)[1]
        self._neutral = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)

    def __call__(self, rng: np.random.Generator) -> tuple[Nodes, Bools]:
        """N grasps to be settled, and whether their fingertips could be put where they are."""
        frame, config, count = self._frame, self._config, self._config.batch
        shift = rng.normal(size=(count, 3))
        shift *= (
            config.displacement
            * rng.uniform(size=(count, 1))
            / np.linalg.norm(shift, axis=1, keepdims=True)
        )
        position = frame.position + shift
        spin = from_rotation_vector(frame.axis * rng.uniform(-np.pi, np.pi, (count, 1)))
        way = rng.uniform(-np.pi, np.pi, count)
        lean = np.stack([np.cos(way), np.sin(way)], axis=1) @ frame.across
        tilt = from_rotation_vector(config.tilt * np.sqrt(rng.uniform(size=(count, 1))) * lean)
        quaternion = multiply(tilt, multiply(spin, np.tile(frame.quaternion, (count, 1))))
        q, reached = self._hands(position, quaternion, rng)
        still = np.zeros((count, 6))
        nodes = Nodes(
            q=q,
            q_target=q,
            object_position=position,
            object_quaternion=quaternion,
            joint_velocity=np.zeros_like(q),
            object_velocity=still,
            in_contact=np.zeros((count, self._scene.hand.n_fingers), bool),
            rotation=frame.rotation(quaternion, np.zeros(count)),
            cost=np.zeros(count),
        )
        return nodes, reached

    def _hands(
        self, position: Floats, quaternion: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Bools]:
        config, scene, count = self._config, self._scene, len(position)
        if config.place == "joints":
            low, high = np.maximum(scene.lower, -np.pi), np.minimum(scene.upper, np.pi)
            return rng.uniform(low, high, (count, scene.hand.nq)), np.ones(count, bool)
        model, axis, m = self._model, _PALM, scene.hand.n_fingers
        where = rng.uniform(-config.azimuth, config.azimuth, (count, m))
        direction = turned(np.broadcast_to(self._neutral, (count, m, 3)), where, axis)
        turn = np.broadcast_to(quaternion[:, None], (count, m, 4))
        out = rotate(inverse(turn), direction)
        up = rotate(inverse(turn), np.broadcast_to(axis, out.shape))
        height = rng.uniform(-config.height, config.height, (count, m, 1))
        begin = height * up + 2.0 * model.shape.radius * out
        distance, _ = model.shape.ray(begin, -out)
        hit = np.isfinite(distance)
        gap = rng.uniform(-config.overlap, config.overlap, (count, m))
        away = np.where(hit, distance, model.shape.radius) - model.geometry.tips.radius - gap
        place = rotate(turn, begin - away[..., None] * out) + position[:, None]
        found = model.reach(np.tile(self._root.q, (count, 1)), place, np.ones((count, m), bool))
        return found.q, found.good


def _settled(
    sim: BatchSimulator,
    placed: Nodes,
    reached: Bools,
    frame: Frame,
    config: GraspSampling,
    check: Stability,
) -> tuple[Nodes, Counter[str]]:
    """What is left of grasps after they have settled, and why others are not."""
    why: Counter[str] = Counter(reach=int((~reached).sum()))
    put(sim, placed)
    for _ in range(max(1, round(config.settle_seconds / sim.control_period))):
        sim.step(reached)
    touch = sim.read().in_contact.sum(axis=1) >= config.min_contacts
    clean = ((sim.other_contact == 0) | (not check.fingertips_only)) & ~sim.diverged
    why["contacts"] = int((reached & ~touch).sum())
    why["other contact"] = int((reached & touch & ~clean).sum())
    hopeful = reached & touch & clean
    stable = check.check(sim, hopeful).stable
    why["stability"] = int((hopeful & ~stable).sum())
    rows = np.flatnonzero(stable)
    return children(frame, sim, placed.take(rows), np.zeros(len(rows)), rows), why


def _distinct(search: Nearest, points: np.ndarray, apart: float) -> list[int]:
    """Which points are ``apart`` from all that were kept; they are added to these."""
    kept = []
    for i, point in enumerate(points):
        if len(search):
            _, distance = search.nearest(point[None])
            if distance[0] < apart:
                continue
        search.add(point[None])
        kept.append(i)
    return kept
