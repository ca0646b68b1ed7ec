"""The SYNC-driven loop: exchange of frames, one compiled step, timing, limits and trips."""

from canwall.cycle.exchange import PythonCanExchange
from canwall.cycle.loop import Change, Outcome, run_loop
from canwall.cycle.step import CYCLE, MAX_LAWS, Trip, make_cycle, set_wall, step
from canwall.cycle.timing import HISTOGRAM, observe_ns, percentile_ns, timing_summary

__all__ = [
    "CYCLE",
    "HISTOGRAM",
    "MAX_LAWS",
    "Change",
    "Outcome",
    "PythonCanExchange",
    "Trip",
    "make_cycle",
    "observe_ns",
    "percentile_ns",
    "run_loop",
    "set_wall",
    "step",
    "timing_summary",
]
