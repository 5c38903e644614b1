"""The behaviour mixture: which candidate acts in each environment, as pure functions.

Candidate 0 is the learner's policy, candidates 1 to K - 1 are controllers. A choice holds for a
whole segment of H steps (thesis chapter 4, algorithm qsampling), or until the episode ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats

POLICY = 0


class Segments(NamedTuple):
    """Who acts, and for how long still; of N environments.

    Attributes:
        actor: ``(N,)`` index of the candidate that acts.
        left: ``(N,)`` steps that it acts for still, this one included; 0 before a choice.
    """

    actor: NDArray[np.int64]
    left: NDArray[np.int64]

    @classmethod
    def start(cls, num_envs: int) -> Segments:
        """Everywhere the policy, and a choice is due."""
        return cls(np.full(num_envs, POLICY, np.int64), np.zeros(num_envs, np.int64))

    @property
    def due(self) -> Bools:
        """Where the next step begins with a choice, ``(N,)``."""
        return self.left <= 0

    def after_step(self, done: Bools) -> Segments:
        """After a step; an episode that ended ends its segment."""
        return Segments(self.actor, np.where(done, 0, np.maximum(self.left - 1, 0)))


def value_probabilities(
    values: ArrayLike, temperature: float = 1.0, where: ArrayLike = True
) -> Floats:
    """Softmax of the critic's values over all candidates.

    With one controller this is the thesis's p_psi = exp(Q_psi) / (exp(Q_pi) + exp(Q_psi))
    (eq. softmaxpsi), that is sigmoid(Q_psi - Q_pi), for values of any size.

    Args:
        values: Q(s, a) of the candidates' actions, ``(..., K)``.
        temperature: values are divided by it; 1 is the thesis's.
        where: which candidates there are, ``(..., K)``, one at least; others have none.

    Returns:
        Probabilities ``(..., K)``.

    Raises:
        InvalidInput: a value is not finite, or the temperature not above 0.
    """
    values = np.asarray(values, float)
    if not (np.isfinite(temperature) and temperature > 0):
        raise InvalidInput(f"temperature is {temperature}; expected a finite number above 0")
    if not np.isfinite(values).all():
        raise InvalidInput("the critic's values are not finite: NaN or infinity in Q(s, a)")
    values = np.where(where, values, -np.inf)
    weight = np.exp((values - values.max(axis=-1, keepdims=True)) / temperature)
    return weight / weight.sum(axis=-1, keepdims=True)


def fixed_probabilities(share: float, candidates: int, where: ArrayLike = True) -> Floats:
    """The fixed schedule of FGE: the controllers share ``share`` equally, whatever the state.

    Args:
        share: probability that a controller is chosen, from 0 to 1.
        candidates: K, the policy included.
        where: which candidates there are, ``(..., K)``, the policy always; others have none.

    Returns:
        Probabilities ``(K,)``, or ``(..., K)`` as ``where`` has them.
    """
    if candidates < 1:
        raise InvalidInput(f"candidates is {candidates}; expected at least 1, the policy")
    if not 0.0 <= share <= 1.0:
        raise InvalidInput(f"share is {share}; expected a number from 0 to 1")
    there = np.broadcast_to(np.asarray(where, bool), (*np.shape(where)[:-1], candidates)).copy()
    there[..., POLICY] = False
    count = there.sum(axis=-1, keepdims=True)
    found = there * (share / np.maximum(count, 1))
    found[..., :1] = np.where(count > 0, 1.0 - share, 1.0)
    return found


def linear_decay(step: int, start: float, stop: int | None) -> float:
    """``start`` at step 0, falling linearly to 0 at step ``stop``, and 0 from there on.

    Where ``stop`` is None it stays.
    """
    if stop is None:
        return start
    return start * max(0.0, 1.0 - step / stop) if stop > 0 else 0.0


def advance(
    segments: Segments, probabilities: ArrayLike, uniform: ArrayLike, length: ArrayLike
) -> Segments:
    """Choose who acts where a choice is due; elsewhere the segment goes on.

    Args:
        segments: of N environments.
        probabilities: of the candidates, ``(K,)`` or ``(N, K)``; rows of environments where no
            choice is due are not read.
        uniform: numbers in [0, 1), ``(N,)``, that decide.
        length: of a segment [steps], one number or one for each candidate ``(K,)``.

    Returns:
        The segments for the coming step.

    Raises:
        InvalidInput: lengths below 1.
    """
    probabilities = np.asarray(probabilities, float)
    lengths = np.broadcast_to(np.asarray(length, np.int64), probabilities.shape[-1:])
    if (lengths < 1).any():
        raise InvalidInput(f"length is {np.asarray(length).tolist()}; expected steps of at least 1")
    edges = np.cumsum(probabilities, axis=-1)[..., :-1]
    # without the last edge, which rounding can leave a little below 1
    chosen = (np.asarray(uniform)[:, None] >= edges).sum(axis=-1)
    due = segments.due
    actor = np.where(due, chosen, segments.actor)
    return Segments(actor, np.where(due, lengths[actor], segments.left))
