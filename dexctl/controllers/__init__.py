"""The controllers by name, for the command line, benchmarks and configuration files.

dexctl's own stand in a table. Other packages add theirs through the entry-point group
``dexctl.controllers``: the name is the controller's, the object is called as ``object(hand,
control_period=..., **options)``, without ``control_period`` where the controller may choose, and
returns the `Controller`. One that names a keyword ``axis`` can be told about which axis to turn the
object; any other turns about z. It is loaded when it is made, not before.

A controller that needs a file, or another controller, has it after its name: ``planned:tree.npz``,
``regulated:dex5-nine``, ``steered:goal``, ``pursuing:dex5-cube-goals``,
``sequence:dex5-cube-z,dex5-cube-x``. A policy has its pace there, where it is to go slower than it
was trained to: ``dex5-robust@0.8``.
"""

from dexctl.controllers.composed import centred, commanded, pursuing, regulated, sequence, steered
from dexctl.controllers.hold import Hold
from dexctl.controllers.making import made_for_another, make, resolve
from dexctl.controllers.table import (
    GROUP,
    POLICIES,
    ControllerEntry,
    entry,
    ignores,
    is_named,
    names,
)
from dexctl.controllers.words import absolute, is_policy_file, keeps_period, label, paced

__all__ = [
    "GROUP",
    "POLICIES",
    "ControllerEntry",
    "Hold",
    "absolute",
    "centred",
    "commanded",
    "entry",
    "ignores",
    "is_named",
    "is_policy_file",
    "keeps_period",
    "label",
    "made_for_another",
    "make",
    "names",
    "paced",
    "pursuing",
    "regulated",
    "resolve",
    "sequence",
    "steered",
]
