"""Evaluation: what policies and controllers do in many episodes, in figures with intervals.

One sentence of it: `open_subject` says who, `Protocol` how, `rollout` lets them act, and
`Evaluation` has the figures. Transfer, robustness, inspection and sweeps roll out nothing else.
"""

from learning.evaluation.figures import Evaluation
from learning.evaluation.protocol import Protocol
from learning.evaluation.rollout import Rollout, evaluate, rollout
from learning.evaluation.subject import Subject, as_trained, open_subject

__all__ = [
    "Evaluation",
    "Protocol",
    "Rollout",
    "Subject",
    "as_trained",
    "evaluate",
    "open_subject",
    "rollout",
]
