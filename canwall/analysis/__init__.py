"""What a wall is judged by: metrics, the continuous referent, K-limits and analytic limits.

Pure functions of arrays and numbers; runs, sweeps and the workbench call them, and so can you.
"""

from canwall.analysis.k_limit import LIMITED, Strike, k_limits
from canwall.analysis.referent import ReferentInputs, follow_referent
from canwall.analysis.strike import DESCRIBED, MEASURES, measure

__all__ = [
    "DESCRIBED",
    "LIMITED",
    "MEASURES",
    "ReferentInputs",
    "Strike",
    "follow_referent",
    "k_limits",
    "measure",
]
