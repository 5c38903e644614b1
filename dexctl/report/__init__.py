"""Reports of trials: figures of merit, plots, and one HTML file that needs nothing beside it.

Plots need the extra ``viz`` (matplotlib), which is loaded when the first one is drawn.
"""

from dexctl.report.summary import BatchSummary, TrialSummary, summarise, summarise_batch

__all__ = ["BatchSummary", "TrialSummary", "summarise", "summarise_batch"]
