"""Analysis of walls: metrics, the continuous referent, K-limits and analytic limits.

Pure functions of arrays and numbers, for runs, sweeps, the workbench and your own scripts.
"""

from canwall.analysis.k_limit import K_LIMIT, RepeatableStrike, k_limits
from canwall.analysis.referent import AskedWall, ReferentInputs, follow_referent
from canwall.analysis.strike import MEASURE_DESCRIPTIONS, MEASURES, measure_strike

__all__ = [
    "K_LIMIT",
    "MEASURES",
    "MEASURE_DESCRIPTIONS",
    "AskedWall",
    "ReferentInputs",
    "RepeatableStrike",
    "follow_referent",
    "k_limits",
    "measure_strike",
]
