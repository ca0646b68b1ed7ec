"""How stiff a wall can be: strikes in memory or through frames, judged, over any axes."""

from canwall.sweep.dataset import gathered
from canwall.sweep.plan import Plan, make_plan
from canwall.sweep.strike import OPERATORS, Operator, PreparedStrike
from canwall.sweep.sweeping import read_sweep, sweep
from canwall.sweep.tables import sweep_table, without_effect

__all__ = [
    "OPERATORS",
    "Operator",
    "Plan",
    "PreparedStrike",
    "gathered",
    "make_plan",
    "read_sweep",
    "sweep",
    "sweep_table",
    "without_effect",
]
