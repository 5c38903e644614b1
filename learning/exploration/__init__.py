"""Who acts while an agent explores: its policy or a controller."""

from learning.exploration.config import METHODS, GuidanceConfig, Guiding
from learning.exploration.guide import Guide, Guided, commitment
from learning.exploration.mixture import (
    POLICY,
    Segments,
    advance,
    fixed_probabilities,
    linear_decay,
    value_probabilities,
)

__all__ = [
    "METHODS",
    "POLICY",
    "GuidanceConfig",
    "Guide",
    "Guided",
    "Guiding",
    "Segments",
    "advance",
    "commitment",
    "fixed_probabilities",
    "linear_decay",
    "value_probabilities",
]
