"""Stiffness sweeps: strikes in memory or through frames, judged for chatter, over any axes."""

from canwall.sweep.dataset import assemble_dataset, read_sweep
from canwall.sweep.execution import sweep
from canwall.sweep.k_limit_table import TABLE_LAWS, compute_k_limit_table, format_k_limit_table
from canwall.sweep.plan import Plan, make_plan
from canwall.sweep.strike import OPERATORS, Operator, PreparedStrike
from canwall.sweep.tables import ineffective_axis_notes, sweep_table

__all__ = [
    "OPERATORS",
    "TABLE_LAWS",
    "Operator",
    "Plan",
    "PreparedStrike",
    "assemble_dataset",
    "compute_k_limit_table",
    "format_k_limit_table",
    "ineffective_axis_notes",
    "make_plan",
    "read_sweep",
    "sweep",
    "sweep_table",
]
