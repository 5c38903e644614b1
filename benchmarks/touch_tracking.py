"""Where an object is by touch alone: its shape tracked, reckoned without it, and fitted anew.

A learned gait, which lets contacts slip as it likes, turns each object, whichever way up; what the
sensors tell goes to three estimates of its pose at once. `TouchTracking` knows the shape and how
the fingers moved, `ContactOdometry` only how they moved, and a least-squares fit by scipy only the
shape: it brings the surface to the contacts of each control period from where it had it before.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from common import (
    Figure,
    Settings,
    in_turns,
    measure_in_scenes,  # noqa: F401
    progress,
    ratio,
    settings,
    spread,
    write,
)
from scipy.optimize import least_squares

from dexctl import GraspState, HandModel, controllers
from dexctl.grasp import TouchTracking
from dexctl.grasp.odometry import ContactOdometry
from dexctl.rotations import angle_between, from_rotation_vector, inverse, multiply, rotate
from dexctl.settings import Names, from_plain
from dexctl.sim import SceneConfig, Shape, Simulation, object_names
