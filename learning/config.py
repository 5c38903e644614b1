"""TrainConfig: everything that decides what a training run does, and the recipes by name.

The defaults are the thesis's method, with numbers of ours where it gives none. "fast" is what made
policies gait within a million steps; docs/learning.md says what each part of it brings. "distil"
makes one policy of controllers and of other policies, which it imitates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, get_args

from dexctl import controllers, hands
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.files import is_path
from dexctl.hand_config import HandConfig
from dexctl.settings import FILE_OR_NAME, NESTED, Located, changed
from dexctl.validation import check_whole
from learning import policies
from learning.algorithms.config import (
    DAggerConfig,
    ImitationConfig,
    PPOConfig,
    RememberingConfig,
    SACConfig,
    TD3Config,
)
from learning.envs.config import EnvConfig
from learning.exploration.config import (
    GuidanceConfig,
    Guiding,
    absolute_guides,
    check_controllers,
)
from learning.starts.config import StartsConfig
from learning.training.curriculum import CurriculumConfig

Kind = Literal["sac", "td3", "ppo", "dagger"]
ALGORITHMS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of a training run; two runs of one configuration give the same bits.

    (On one machine, with the same versions and the same number of threads.) The thesis does not
    publish network sizes, rates and batch sizes: these are ours.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    env: EnvConfig = EnvConfig()
    guidance: Annotated[GuidanceConfig, NESTED] = GuidanceConfig()
    curriculum: Annotated[CurriculumConfig, NESTED] = CurriculumConfig()
    controllers: Annotated[tuple[str, ...], Located(absolute_guides)] = ("gait",)
    """Controllers that guide, or policies, one or several; OBJECT,...=NAME guides with these
    objects only. Not used by the method rl."""
    algorithm: Kind = "sac"
    """Who learns: sac (with entropy coefficient 0, the thesis's), td3, ppo (method rl only), or
    dagger, which only imitates (method rl+bc only)."""
    sac: SACConfig = SACConfig()
    td3: TD3Config = TD3Config()
    ppo: PPOConfig = PPOConfig()
    dagger: DAggerConfig = DAggerConfig()
    starts: Annotated[StartsConfig, NESTED] = StartsConfig()
    imitation: Annotated[ImitationConfig, NESTED] = ImitationConfig()
    begin_from: Annotated[Path | None, FILE_OR_NAME] = None
    """Folder of a run whose networks this one begins with, as where ranges are drawn only once
    the gait is there (thesis, chapter 5), or a policy, by name or file, whose critics are learned
    anew (`actor_starts`); none: random ones. They must be of one shape."""
    steps: int = 1_000_000
    """Environment steps, of all environments together."""
    seed: int = 0
    """Seed of everything; the same seed and settings give the same policy on the same machine."""
    num_envs: int = 128
    """Environments stepped together."""
    symmetry: bool = False
    """Whether each transition that is learned from is turned by a symmetry of the hand that is
    drawn for it (72 degrees on dex5); for sac, td3 and dagger."""
    overlap: bool = True
    """Whether the environments step while the updates run; the policy that acts is then older by
    the updates of one step."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the updates run; auto takes a GPU where there is one."""
    torch_threads: int = 1
    """How many threads the updates use."""
    log_every: int = 10_000
    """Steps between two rows of progress.csv and TensorBoard."""
    checkpoint_every: int = 100_000
    """Steps between two checkpoints."""

    def __post_init__(self) -> None:
        for name in self.controllers:
            self._check_guide(Guiding.of(name))
        check_controllers(self.guidance.method, self.controllers)
        if controllers.paced(str(self.begin_from))[0] != str(self.begin_from):
            raise InvalidInput(
                f"begin_from is {self.begin_from}; networks have no pace: "
                "expected it without a pace"
            )
        check_whole(
            self,
            steps=1,
            seed=0,
            num_envs=len(self.env.scene.object),
            torch_threads=1,
            log_every=1,
            checkpoint_every=1,
        )
        if self.algorithm == "ppo" and self.symmetry:
            raise InvalidInput(
                "symmetry is True and algorithm is 'ppo', which keeps no transitions; expected "
                "sac, td3 or dagger"
            )
        if self.algorithm == "ppo" and self.guidance.method != "rl":
            raise InvalidInput(
                f"algorithm is 'ppo' and method {self.guidance.method!r}; ppo learns from its own "
                "actions only: expected method 'rl', or the algorithm sac or td3"
            )
        if self.algorithm == "dagger":
            self._check_dagger()
        if self.curriculum and not self.env.scene.randomisation:
            raise InvalidInput(
                f"level_start is {self.curriculum.level_start} and there are no ranges to widen; "
                "expected a range such as mass_range, or level_start 1"
            )
        drawn = self.env.scene.randomisation.drawn
        for name in self.curriculum.level_schedule:
            if name not in drawn:
                raise InvalidInput(
                    f"level_schedule names {name}, by which nothing is drawn; drawn: "
                    f"{', '.join(drawn)}"
                )
        self._check_starts()
        own = self.learner
        if isinstance(own, RememberingConfig) and own.buffer_size < max(
            self.num_envs, own.batch_size
        ):
            raise InvalidInput(
                f"buffer_size is {own.buffer_size}; expected at least one batch of "
                f"{own.batch_size} and one step of {self.num_envs} environments"
            )

    def _check_guide(self, guide: Guiding) -> None:
        there = self.env.scene.object
        for name in guide.objects:
            if name not in there:
                raise UnknownName("object of a guide", name, there)
        name = guide.controller
        plain, pace = controllers.paced(name)
        if plain != name:
            policies.check_pace(pace)
        is_file = is_path(plain) or controllers.is_policy_file(name)
        known = (controllers.POLICIES, *policies.names())
        if not (controllers.is_named(name) or is_file or plain in known):
            raise UnknownName("controller", name, (*controllers.names(), *policies.names()))

    def _check_dagger(self) -> None:
        guidance = self.guidance
        if guidance.method != "rl+bc":
            raise InvalidInput(
                f"algorithm is 'dagger' and method {guidance.method!r}; dagger learns from what "
                "controllers would do where the policy comes to: expected method 'rl+bc'"
            )
        if guidance.hard_stop is not None and guidance.hard_stop < self.steps:
            raise InvalidInput(
                f"algorithm is 'dagger', whose labels end at the hard_stop {guidance.hard_stop}; "
                f"expected none, or at least the {self.steps} steps"
            )
        guides = [Guiding.of(name).objects for name in self.guides]
        shown = {name for objects in guides for name in objects or self.env.scene.object}
        missing = [name for name in self.env.scene.object if name not in shown]
        if missing:
            raise InvalidInput(
                f"algorithm is 'dagger', and no controller guides with {', '.join(missing)}; "
                "expected one for each object"
            )

    def _check_starts(self) -> None:
        start, file = self.starts.start_from, self.env.scene.initial_states
        if start != "fixed" and file is not None:
            raise InvalidInput(
                f"start_from is {start!r} and initial_states is {file}; expected one of them"
            )
        self.env.task.check_starts(start not in ("fixed", "gravity") or file is not None)
        draws = self.env.scene.randomisation
        if start == "gravity" and draws.draws_gravity:
            raise InvalidInput(
                "start_from is 'gravity', which scales gravity, and gravity_tilt or "
                "gravity_turning_range draws it for each episode; expected one of them"
            )
        if start in ("grasps", "paths", "explored") and draws.size_range is not None:
            raise InvalidInput(
                f"start_from is {start!r}, whose grasps are of one size, and size_range is "
                f"{draws.size_range}; expected one of them"
            )
        imitated = self.imitation.imitated
        if imitated != "none" and self.algorithm != "ppo":
            raise InvalidInput(
                f"imitated is {imitated!r} and algorithm {self.algorithm!r}; expected ppo, whose "
                "policy begins so (a guide shows the others)"
            )
        if imitated != "none" and start != "paths" and file is None:
            raise InvalidInput(
                f"imitated is {imitated!r} and start_from {start!r}; expected 'paths', or "
                "initial_states"
            )

    @property
    def learner(self) -> SACConfig | TD3Config | PPOConfig | DAggerConfig:
        """The settings of the algorithm that is chosen."""
        return getattr(self, self.algorithm)

    def with_mass(self, hand: HandConfig | None = None) -> TrainConfig:
        """The same with the object's mass said, for what is kept: the hand's toml may change.

        Args:
            hand: what its toml says; None: it is read.
        """
        scene = self.env.scene
        scene = scene.with_mass(hands.config(scene.hand) if hand is None else hand)
        return replace(self, env=replace(self.env, scene=scene))

    @property
    def guides(self) -> tuple[str, ...]:
        """Who guides the run, as `controllers` says it; nobody for the method rl."""
        return () if self.guidance.method == "rl" else self.controllers

    @property
    def guide_names(self) -> tuple[str, ...]:
        """Names of these controllers and policies, each once, without their objects."""
        return tuple(dict.fromkeys(Guiding.of(name).controller for name in self.guides))


_QUICK = {
    "layer_norm": True,
    "n_step": 5,
    "learning_rate": 1e-3,
    "learning_rate_end": 1e-4,
    "policy_average": 0.999,
    "tau": 0.02,
}


def _fast() -> TrainConfig:
    base = TrainConfig()
    return replace(
        base,
        env=replace(base.env, scaled=True, critic_parts=("object_position", "object_quaternion")),
        guidance=replace(
            base.guidance,
            cloned="visited",
            cloning="squared",
            cloning_weight="equal",
            beta=10.0,
            hard_stop=500_000,
        ),
        sac=changed(base.sac, _QUICK),
        td3=changed(base.td3, _QUICK),
    )


def _distil() -> TrainConfig:
    base = TrainConfig()
    return replace(
        base,
        env=replace(base.env, scaled=True),
        guidance=replace(base.guidance, method="rl+bc", hard_stop=None),
        controllers=("coordinated",),
        algorithm="dagger",
    )


RECIPES: Mapping[str, Callable[[], TrainConfig]] = {
    "thesis": TrainConfig, "fast": _fast, "distil": _distil,
}  # fmt: skip


def recipe(name: str, method: str | None = None) -> TrainConfig:
    """The configuration of the recipe ``name``.

    Args:
        name: one of `RECIPES`.
        method: of the guidance; None is the recipe's own. Where it clones nothing, the recipe's
            settings of cloning are left as they are by default.

    Raises:
        UnknownName: no such recipe, or no such method.
    """
    if name not in RECIPES:
        raise UnknownName("recipe", name, RECIPES)
    made, usual = RECIPES[name](), GuidanceConfig()
    guidance = made.guidance if method is None else replace(made.guidance, method=method)
    if not guidance.imitates:
        guidance = replace(
            guidance,
            cloned=usual.cloned,
            cloning=usual.cloning,
            cloning_weight=usual.cloning_weight,
            beta=usual.beta,
        )
    return replace(made, guidance=guidance)
