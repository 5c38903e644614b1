"""TrainConfig: everything that decides what a training run does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from dexctl import controllers
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.validation import check_numbers
from learning.envs import EnvConfig
from learning.envs.observation import check_parts
from learning.exploration.guide import GuidanceConfig, check_controllers

ALGORITHMS = ("sac", "td3")
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of a training run; two runs of one configuration give the same bits.

    (On one machine, with the same versions and the same number of threads.) The thesis does not
    publish network sizes, rates and batch sizes: these are ours.

    Attributes:
        env: the environments.
        guidance: the method.
        controllers: names of those that guide; none are made for method "rl".
        algorithm: "sac" (with entropy coefficient 0, the thesis's) or "td3".
        steps: environment steps, of all environments together.
        seed: of everything.
        num_envs: environments stepped together.
        gamma: discount.
        batch_size: transitions of an update.
        gradient_steps: updates for each step of all environments together.
        learning_rate: of actor and critics.
        learning_rate_end, decay_start: what it falls to, linearly, from this share of the steps
            on; None: it stays.
        policy_average: the policy that is kept is the mean of the actor's weights, each update
            counting this much less than the next; 0: the last ones.
        network: hidden layers of actor and critics.
        tau: how far the target critics go towards the critics at each update.
        buffer_size: transitions that the replay buffer holds; one takes about 0.6 kB.
        learning_starts: steps before the first update; the policy's part in them is random.
        critic_parts: parts of the observation that only the critics see; the policy is trained
            with the help of what it will not have. The thesis has none.
        layer_norm: layer normalisation in the critics; the thesis has none.
        n_step: steps of the returns that critics are trained with; the thesis has 1.
        policy_delay: updates of the critics to one of the actor; None: the algorithm's own (SAC 1,
            TD3 2).
        exploration_noise: standard deviation added to the policy's actions (TD3 only).
        overlap: let the environments step while the updates run; the policy that acts is then
            older by ``gradient_steps`` updates, and everything else as it is without.
        device: "auto" takes a GPU where there is one.
        torch_threads: that the updates use.
        log_every: steps between two rows of the logs.
        checkpoint_every: steps between two checkpoints.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    controllers: tuple[str, ...] = ("gait",)
    algorithm: str = "sac"
    steps: int = 1_000_000
    seed: int = 0
    num_envs: int = 128
    gamma: float = 0.99
    batch_size: int = 512
    gradient_steps: int = 2
    learning_rate: float = 3e-4
    learning_rate_end: float | None = None
    decay_start: float = 0.5
    policy_average: float = 0.0
    network: tuple[int, ...] = (256, 256)
    tau: float = 0.005
    buffer_size: int = 500_000
    learning_starts: int = 5_000
    critic_parts: tuple[str, ...] = ()
    layer_norm: bool = False
    n_step: int = 1
    policy_delay: int | None = None
    exploration_noise: float = 0.1
    overlap: bool = True
    device: str = "auto"
    torch_threads: int = 1
    log_every: int = 10_000
    checkpoint_every: int = 100_000

    def __post_init__(self) -> None:
        for name in self.controllers:
            controllers.entry(name)
        check_controllers(self.guidance.method, self.controllers)
        if self.algorithm not in ALGORITHMS:
            raise UnknownName("algorithm", self.algorithm, ALGORITHMS)
        if self.device not in DEVICES:
            raise UnknownName("device", self.device, DEVICES)
        for name in (
            "steps", "num_envs", "batch_size", "gradient_steps", "buffer_size", "torch_threads",
            "log_every", "checkpoint_every", "n_step",
        ):  # fmt: skip
            _whole(name, getattr(self, name), 1)
        _whole("learning_starts", self.learning_starts, 0)
        _whole("seed", self.seed, 0)
        check_numbers(
            self,
            positive=("learning_rate", "tau"),
            not_negative=("exploration_noise",),
            fractions=("gamma", "tau", "decay_start", "policy_average"),
        )
        if self.learning_rate_end is not None:
            check_numbers(self, not_negative=("learning_rate_end",))
        if self.policy_delay is not None:
            _whole("policy_delay", self.policy_delay, 1)
        if self.critic_parts:
            check_parts((*self.env.parts, *self.critic_parts))
        if not self.network or any(not isinstance(n, int) or n < 1 for n in self.network):
            raise InvalidInput(f"network is {self.network}; expected layer widths of at least 1")
        if self.buffer_size < max(self.num_envs, self.batch_size):
            raise InvalidInput(
                f"buffer_size is {self.buffer_size}; expected at least one batch of "
                f"{self.batch_size} and one step of {self.num_envs} environments"
            )

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it; `from_dict` makes it again."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return values | {
            "env": self.env.to_dict(),
            "guidance": asdict(self.guidance),
            "controllers": list(self.controllers),
            "network": list(self.network),
            "critic_parts": list(self.critic_parts),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """The configuration that `to_dict` described.

        Raises:
            InvalidInput: a setting is unknown or wrong.
        """
        try:
            return cls(
                **{
                    **values,
                    "env": EnvConfig(**values["env"]),
                    "guidance": GuidanceConfig(**values["guidance"]),
                    "controllers": tuple(values["controllers"]),
                    "network": tuple(values["network"]),
                    "critic_parts": tuple(values.get("critic_parts", ())),
                }
            )
        except (TypeError, KeyError) as error:
            raise InvalidInput(f"this is no training configuration: {error}") from error


def _whole(name: str, value: object, least: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise InvalidInput(f"{name} is {value!r}; expected a whole number from {least} on")
