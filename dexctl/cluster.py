"""A Ray cluster that is there already: the only door to Ray."""

from __future__ import annotations

import logging
import socket
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dexctl.exceptions import DexctlError, MissingExtra

ROOT = Path(__file__).resolve().parents[1]  # tasks run the same code as this process

_ANSWER = 3.0  # a head that listens has answered by then [s]


class ClusterError(DexctlError, RuntimeError):
    """The Ray cluster cannot be used."""


def connect(address: str) -> Any:
    """Ray, connected; ``shutdown`` leaves the cluster again.

    Args:
        address: of its head, "HOST:PORT", "ray://HOST:PORT", or "auto" for the one on this machine.

    Raises:
        MissingExtra: Ray is not installed.
        ClusterError: there is no cluster at that address.
    """
    if find_spec("ray") is None:
        raise MissingExtra("--ray", "distributed")
    _check_there(address)
    import ray

    try:
        ray.init(
            address,
            log_to_driver=False,
            logging_level=logging.ERROR,
            runtime_env={"env_vars": {"PYTHONPATH": str(ROOT)}},
        )
    except (ConnectionError, ValueError, RuntimeError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise ClusterError(f"no Ray cluster at {address}: {why}") from error
    return ray


def _check_there(address: str) -> None:
    """Raise ClusterError where nobody listens; Ray itself would try again for minutes."""
    if address == "auto":
        return
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not (host and colon and port.isdecimal() and 0 < int(port) < 65536):
        raise ClusterError(
            f"no Ray cluster at {address}: expected HOST:PORT, ray://HOST:PORT or auto"
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), _ANSWER).close()
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise ClusterError(
            f"no Ray cluster at {address}: {why}; expected its head's HOST:PORT, ray://HOST:PORT "
            "or auto"
        ) from None


def inside() -> Any:
    """Ray, in one of its tasks."""
    import ray

    return ray


def cores(ray: Any) -> int:
    """How many cores the cluster has, at least one."""
    return max(int(ray.cluster_resources().get("CPU", 1)), 1)


def reason(error: Exception) -> str:
    """What a task failed of; Ray's own message is a traceback."""
    cause = getattr(error, "cause", None) or error
    lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
    return lines[-1] if lines else type(cause).__name__
