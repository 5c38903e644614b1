"""Settings of the algorithms; they load without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from dexctl.exceptions import InvalidInput
from dexctl.validation import check_name, check_numbers, check_whole

Imitated = Literal["none", "joints", "set_points"]
IMITATED: tuple[Imitated, ...] = get_args(Imitated)


@dataclass(frozen=True, kw_only=True)
class RememberingConfig:
    """What the algorithms share that learn from a memory.

    Raises:
        InvalidInput: a setting is wrong; the message names it.
    """

    batch_size: int = 512
    """Steps, of the memory, of an update."""
    gradient_steps: int = 2
    """Updates for each step of all environments together."""
    learning_rate: float = 3e-4
    """Learning rate of all networks."""
    learning_rate_end: float | None = None
    """What the learning rate falls to, linearly; none: it stays."""
    decay_start: float = 0.5
    """Share of the steps from which on it falls."""
    policy_average: float = 0.0
    """The policy that is kept is the mean of the actor's weights, each update counting this much
    less than the next; 0: the last ones."""
    network: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of all networks."""
    buffer_size: int = 500_000
    """Steps of an environment that are remembered; each takes up to 0.6 kB of memory and of
    checkpoint."""

    def __post_init__(self) -> None:
        check_whole(self, batch_size=1, gradient_steps=1, buffer_size=1)
        check_numbers(
            self, positive=("learning_rate",), fractions=("decay_start", "policy_average")
        )
        if self.learning_rate_end is not None:
            check_numbers(self, not_negative=("learning_rate_end",))
        check_network(self.network)
        if self.buffer_size < self.batch_size:
            raise InvalidInput(
                f"buffer_size is {self.buffer_size}; expected at least one batch of "
                f"{self.batch_size}"
            )

    def rate(self, left: float) -> float:
        """The learning rate where this share of the training is left."""
        first, last, start = self.learning_rate, self.learning_rate_end, self.decay_start
        if last is None or start >= 1:
            return first
        return first + (last - first) * max(0.0, (1.0 - left - start) / (1.0 - start))


@dataclass(frozen=True, kw_only=True)
class DAggerConfig(RememberingConfig):
    """Dataset aggregation (Ross et al. 2011): labels of the states that the policy comes to."""

    batch_size: int = 1024
    """Steps, of the memory, of an update."""
    learning_rate: float = 1e-3
    """Learning rate of the policy."""
    learning_rate_end: float | None = 1e-5
    """What the learning rate falls to, linearly; none: it stays."""
    policy_average: float = 0.999
    """The policy that is kept is the mean of the actor's weights, each update counting this much
    less than the next; 0: the last ones."""
    buffer_size: int = 1_000_000
    """Labelled steps that are remembered; each takes about 0.3 kB of memory and of checkpoint."""
    action_noise: float = 0.1
    """Standard deviation of what is added to the policy's actions in training, in units of [-1, 1],
    so that states beside its way are labelled too; labels have none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, not_negative=("action_noise",))


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(RememberingConfig):
    """What SAC and TD3 share: they learn from a memory of what anybody did.

    Raises:
        InvalidInput: a setting is wrong; the message names it.
    """

    gamma: float = 0.99
    """Discount of a control step."""
    tau: float = 0.005
    """How far the target critics go towards the critics at each update."""
    learning_starts: int = 5_000
    """Steps before the first update; the policy's part in them is random, but for a run that begins
    with the networks of another."""
    layer_norm: bool = False
    """Layer normalisation in the critics; none in the thesis (Ball et al. 2023: it bounds what
    critics extrapolate to actions that nobody tried)."""
    n_step: int = 1
    """Steps of the returns that critics are trained with; 1 in the thesis."""
    policy_delay: int = 1
    """Updates of the critics to one of the actor."""
    actor_starts: int = 0
    """Steps before the first update of the actor; until then the critics learn alone what its
    actions are worth, as those of a run that begins with a policy's file have to."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole(self, learning_starts=0, actor_starts=0, n_step=1, policy_delay=1)
        check_numbers(self, positive=("tau",), fractions=("gamma", "tau"))


@dataclass(frozen=True, kw_only=True)
class SACConfig(OffPolicyConfig):
    """Soft actor-critic (Haarnoja et al. 2018) with a fixed entropy coefficient."""

    entropy_coefficient: float = 0.0
    """Weight of the policy's entropy in value; 0 in the thesis."""
    initial_deviation: float = 0.1
    """First standard deviation of the actions, before the tanh, of a run that begins with a
    policy's file, which has none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, positive=("initial_deviation",), not_negative=("entropy_coefficient",))


@dataclass(frozen=True, kw_only=True)
class TD3Config(OffPolicyConfig):
    """Twin delayed DDPG (Fujimoto et al. 2018)."""

    policy_delay: int = 2
    """Updates of the critics to one of the actor."""
    exploration_noise: float = 0.1
    """Standard deviation of what is added to the policy's actions in training, in units of
    [-1, 1]."""
    target_noise: float = 0.2
    """Standard deviation of what is added to the target's actions."""
    target_noise_clip: float = 0.5
    """At most this is added to them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, not_negative=("exploration_noise", "target_noise", "target_noise_clip"))


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al. 2017), actor and critic apart.

    Raises:
        InvalidInput: a setting is wrong; the message names it.
    """

    gamma: float = 0.99
    """Discount."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimates."""
    rollout_steps: int = 24
    """Steps of each environment between two updates."""
    epochs: int = 5
    """Passes over these steps in an update."""
    minibatches: int = 4
    """Parts of a pass, each of which is one step of the optimiser."""
    learning_rate: float = 1e-3
    """Learning rate of actor and critic; where it adapts, the first one."""
    learning_rate_end: float | None = None
    """What the learning rate falls to, linearly over the training; none: it stays."""
    critic_learning_rate: float | None = None
    """Of the critic alone, which stays; none: the actor's. A policy that began elsewhere may stand
    a hundredth of what a critic needs that begins at random."""
    target_kl: float | None = 0.01
    """The rate adapts so that a minibatch changes the policy by about this; none: it does not."""
    clip: float = 0.2
    """How far the ratio of densities goes from 1, at most."""
    value_clip: float | None = None
    """How far values go from where they were in an update, at most, in the unit of returns; None:
    as far as they may. It suits returns of about unit size only."""
    value_weight: float = 1.0
    """Weight of the critic's loss, as far as the clipped gradient notices it."""
    entropy_coefficient: float = 0.0
    """What the policy's entropy is worth."""
    max_gradient: float = 1.0
    """Longest gradient, of the actor and of the critic each."""
    critic_steps: int = 0
    """Environment steps in which only the critic learns, after imitation (2 million in the thesis)
    or where a run begins with a policy's file."""
    initial_deviation: float = 0.5
    """First standard deviation of the actions, in units of [-1, 1]."""
    network: tuple[int, ...] = (256, 256)
    """Hidden layers of actor and critic."""
    normalise: bool = True
    """Whether observations are normalised by their running mean and deviation; not the actor's
    where it began with a policy's file, which takes them as they are."""

    def __post_init__(self) -> None:
        check_whole(self, rollout_steps=1, epochs=1, minibatches=1, critic_steps=0)
        check_numbers(
            self,
            positive=("learning_rate", "clip", "max_gradient", "initial_deviation", "value_weight"),
            not_negative=("entropy_coefficient",),
            fractions=("gamma", "gae_lambda"),
        )
        for name in ("critic_learning_rate", "target_kl", "value_clip"):
            if getattr(self, name) is not None:
                check_numbers(self, positive=(name,))
        if self.learning_rate_end is not None:
            check_numbers(self, not_negative=("learning_rate_end",))
            if self.target_kl is not None:
                raise InvalidInput(
                    f"learning_rate_end is {self.learning_rate_end}; expected None where the "
                    "learning rate adapts to target_kl"
                )
        check_network(self.network)


@dataclass(frozen=True, kw_only=True)
class ImitationConfig:
    """Imitation pre-training (IPT, thesis chapter 5): PPO's policy begins with a tree's edges.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    imitated: Imitated = "none"
    """none: the policy begins at random. joints: it begins with beta (q of a state - q of the one
    that it was reached from); set_points: with the change of their set-points, which is the action
    itself in a tree of random actions."""
    imitation_beta: float = 2.0
    """Beta of the joints' labels; 2 in the thesis."""
    imitation_epochs: int = 20
    """Passes over all edges."""
    imitation_batch: int = 256
    """Edges of an update."""

    def __post_init__(self) -> None:
        check_name("imitated", self.imitated, IMITATED)
        check_numbers(self, positive=("imitation_beta",))
        check_whole(self, imitation_epochs=1, imitation_batch=1)


def check_network(widths: tuple[int, ...]) -> None:
    """Raise InvalidInput where these are no widths of hidden layers."""
    if not widths or any(not isinstance(n, int) or n < 1 for n in widths):
        raise InvalidInput(f"network is {widths}; expected layer widths of at least 1")
