"""Check, calibrate and run a servo hand, or an emulated one."""

from __future__ import annotations

from hardware.cli.calibrate import Calibrate
from hardware.cli.check import Check
from hardware.cli.identify import Identify
from hardware.cli.latency import Latency
from hardware.cli.replay import ReplayLog, Report
from hardware.cli.run import Run

COMMANDS = {
    "check": Check,
    "calibrate": Calibrate,
    "run": Run,
    "latency": Latency,
    "identify": Identify,
    "replay": ReplayLog,
    "report": Report,
}
