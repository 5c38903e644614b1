"""What every benchmark shares: timing, the machine's description, and JSON written whole."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results"
_PACKAGES = ("dexctl", "numpy", "scipy", "pin", "proxsuite", "casadi", "mujoco", "mink")


def machine() -> dict[str, Any]:
    """What a figure depends on beside the code."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _PACKAGES},
    }


def timings(call: Callable[[int], Any], count: int, warm_up: int = 50) -> np.ndarray:
    """Seconds that each of ``count`` calls took; ``call`` gets its index."""
    for i in range(warm_up):
        call(i)
    out = np.empty(count)
    for i in range(count):
        start = time.perf_counter()
        call(i)
        out[i] = time.perf_counter() - start
    return out


def spread(seconds: np.ndarray) -> dict[str, float]:
    """Median, p99 and count of timings, in microseconds."""
    return {
        "median_us": float(np.median(seconds) * 1e6),
        "p99_us": float(np.percentile(seconds, 99) * 1e6),
        "count": len(seconds),
    }


def write(name: str, result: dict[str, Any]) -> Path:
    """Write ``results/name.json`` with the machine's description, aside first and then renamed."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    aside = path.with_suffix(".part")
    aside.write_text(
        json.dumps({"benchmark": name, **result, "machine": machine()}, indent=2) + "\n"
    )
    aside.replace(path)
    print(json.dumps(result, indent=2))
    print(f"written: {path}")
    return path
