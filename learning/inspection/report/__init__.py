"""The report of an inspection: plots, and one HTML page with everything in it.

Unlike the rest of ``learning`` (but for its commands) it may import `dexctl.report`.
"""

from learning.inspection.report.page import build

__all__ = ["build"]
