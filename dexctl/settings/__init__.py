"""Settings: nested frozen dataclasses as plain values, as files have them, and by leaf name.

A configuration is a keyword-only frozen dataclass whose fields are numbers, texts, tuples, or
configurations in turn. The names of the leaves of one tree differ, so a setting can be given by
its own name wherever it stands: ``changed(train, {"axis": "x"})``. Two leaves of the same name
(the ``learning_rate`` of two algorithms) are told apart by the path, ``"ppo.learning_rate"``.
"""

from dexctl.settings.located import absolute
from dexctl.settings.marks import BY_PATH, FILE_OR_NAME, NESTED, Located, Text, only
from dexctl.settings.plain import by_path, changed, describe, from_plain, to_plain
from dexctl.settings.tree import difference, differing, get, leaves, paths
from dexctl.settings.words import NamedRanges, Names, Quaternion, Quaternions, Range, Vector

__all__ = [
    "BY_PATH",
    "FILE_OR_NAME",
    "NESTED",
    "Located",
    "NamedRanges",
    "Names",
    "Quaternion",
    "Quaternions",
    "Range",
    "Text",
    "Vector",
    "absolute",
    "by_path",
    "changed",
    "describe",
    "difference",
    "differing",
    "from_plain",
    "get",
    "leaves",
    "only",
    "paths",
    "to_plain",
]
