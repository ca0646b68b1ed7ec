"""How stiff a wall can be: strikes on the simulated drive, judged, and the largest K found."""

from canwall.sweep.limit import Limit, k_limit
from canwall.sweep.strike import OPERATORS, Operator, Verdict, strike_over_bus

__all__ = ["OPERATORS", "Limit", "Operator", "Verdict", "k_limit", "strike_over_bus"]
