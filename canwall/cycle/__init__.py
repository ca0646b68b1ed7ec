"""The SYNC-driven loop: exchange of frames, one compiled step, timing, limits and trips."""

from canwall.cycle.axis import WallAxis, WallStage
from canwall.cycle.bus_monitor import BusMonitor
from canwall.cycle.exchange import Exchange, PythonCanExchange
from canwall.cycle.laws import named_law, run_laws, with_law
from canwall.cycle.loop import Outcome, run_loop
from canwall.cycle.machine import real_time_machine
from canwall.cycle.native import NativeExchange
from canwall.cycle.realtime import Grant, real_time_priority
from canwall.cycle.state import CYCLE, MAX_LAWS, fade_in, make_cycle, set_wall, start_at
from canwall.cycle.step import step
from canwall.cycle.sync import ExternalSync, ProducedSync
from canwall.cycle.timing import HISTOGRAM, buckets_ns, observe_ns, percentile_ns, timing_summary
from canwall.cycle.trips import Trip

__all__ = [
    "CYCLE",
    "HISTOGRAM",
    "MAX_LAWS",
    "BusMonitor",
    "Exchange",
    "ExternalSync",
    "Grant",
    "NativeExchange",
    "Outcome",
    "ProducedSync",
    "PythonCanExchange",
    "Trip",
    "WallAxis",
    "WallStage",
    "buckets_ns",
    "fade_in",
    "make_cycle",
    "named_law",
    "observe_ns",
    "percentile_ns",
    "real_time_machine",
    "real_time_priority",
    "run_laws",
    "run_loop",
    "set_wall",
    "start_at",
    "step",
    "timing_summary",
    "with_law",
]
