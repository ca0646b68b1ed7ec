"""SYNC-driven loop: exchange of frames, one compiled step, timing, limits and trips."""

from canwall.cycle.axis import Offer, WallAxis, WallStage
from canwall.cycle.bus_monitor import BusMonitor
from canwall.cycle.exchange import Exchange, SyncLostError
from canwall.cycle.experiment import Experiment, ExperimentError, torques_in_force
from canwall.cycle.laws import law_of, named_law, run_laws, with_law
from canwall.cycle.loop import Loop, WallGivenUpError
from canwall.cycle.machine import real_time_machine
from canwall.cycle.python_can import PythonCanTransport
from canwall.cycle.sockets import SocketTransport
from canwall.cycle.state import (
    CYCLE,
    MAX_LAWS,
    fade_in,
    make_cycle,
    modelled_delay,
    set_delay,
    set_limits,
    set_wall,
    start_at,
    stiffest_for,
)
from canwall.cycle.step import step, step_address, step_at
from canwall.cycle.timing import observe_ns
from canwall.cycle.transport import CycleFrames, Transport
from canwall.cycle.trip_text import latest_emergency
from canwall.cycle.trips import Trip
from canwall.cycle.way_out import Outcome, run_loop
from canwall.realtime import Grant, real_time_priority
from canwall.record.histogram import HISTOGRAM, buckets_ns, percentile_ns, timing_summary

__all__ = [
    "CYCLE",
    "HISTOGRAM",
    "MAX_LAWS",
    "BusMonitor",
    "CycleFrames",
    "Exchange",
    "Experiment",
    "ExperimentError",
    "Grant",
    "Loop",
    "Offer",
    "Outcome",
    "PythonCanTransport",
    "SocketTransport",
    "SyncLostError",
    "Transport",
    "Trip",
    "WallAxis",
    "WallGivenUpError",
    "WallStage",
    "buckets_ns",
    "fade_in",
    "latest_emergency",
    "law_of",
    "make_cycle",
    "modelled_delay",
    "named_law",
    "observe_ns",
    "percentile_ns",
    "real_time_machine",
    "real_time_priority",
    "run_laws",
    "run_loop",
    "set_delay",
    "set_limits",
    "set_wall",
    "start_at",
    "step",
    "step_address",
    "step_at",
    "stiffest_for",
    "timing_summary",
    "torques_in_force",
    "with_law",
]
