"""Who acts while an agent explores: its policy or a controller."""

from learning.exploration.mixture import (
    POLICY,
    Segments,
    advance,
    fixed_probabilities,
    linear_decay,
    value_probabilities,
)

__all__ = [
    "POLICY",
    "Segments",
    "advance",
    "fixed_probabilities",
    "linear_decay",
    "value_probabilities",
]
