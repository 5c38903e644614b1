# mujoco is a compiled extension whose wheel has no complete stubs: its names are not checked.
from typing import Any

def __getattr__(name: str) -> Any: ...
