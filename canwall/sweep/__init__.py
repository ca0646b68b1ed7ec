"""How stiff a wall can be: strikes in memory or through frames, judged, over any axes."""

from canwall.sweep.dataset import gathered
from canwall.sweep.plan import Plan, make_plan
from canwall.sweep.shown import sweep_table, without_effect
from canwall.sweep.strike import OPERATORS, Operator, Strike
from canwall.sweep.sweeping import read_sweep, sweep

__all__ = [
    "OPERATORS",
    "Operator",
    "Plan",
    "Strike",
    "gathered",
    "make_plan",
    "read_sweep",
    "sweep",
    "sweep_table",
    "without_effect",
]
