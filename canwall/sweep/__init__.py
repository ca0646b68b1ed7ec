"""Stiffness sweeps: strikes in memory or through frames, judged for chatter, over any axes."""

from canwall.sweep.dataset import assemble_dataset, check_name, plan_of, read_sweep, write_sweep
from canwall.sweep.execution import sweep
from canwall.sweep.journal import how_to_go_on
from canwall.sweep.law_tables import (
    LAW_TABLES,
    compute_law_table,
    format_law_table,
    format_worst,
)
from canwall.sweep.plan import Plan, make_plan, repeat_strike
from canwall.sweep.strike import OPERATORS, Operator, PreparedStrike
from canwall.sweep.tables import ineffective_axis_notes, sweep_table

__all__ = [
    "LAW_TABLES",
    "OPERATORS",
    "Operator",
    "Plan",
    "PreparedStrike",
    "assemble_dataset",
    "check_name",
    "compute_law_table",
    "format_law_table",
    "format_worst",
    "how_to_go_on",
    "ineffective_axis_notes",
    "make_plan",
    "plan_of",
    "read_sweep",
    "repeat_strike",
    "sweep",
    "sweep_table",
    "write_sweep",
]
