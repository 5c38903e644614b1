# mujoco-menagerie is an optional package that need not be installed: its names are not checked.
from typing import Any

def __getattr__(name: str) -> Any: ...
