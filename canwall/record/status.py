"""State of a run in progress, as it is published some 30 times a second."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.record.columns import Phase
from canwall.record.histogram import HISTOGRAM, percentile_ns

#: What ended a run that published no end.
KILLED = "the process of the run is dead: the drive's watchdog has to disable the drive"

#: Lengths of texts [bytes].
TRIP, STATE, EMCY = 600, 160, 160

#: What the run publishes. Readers compute the percentiles, which the run has no time for.
STATUS = np.dtype(
    [
        ("cycle", "i8"),
        ("cycle_s", "f8"),
        ("phase", "u1"),
        ("ended", "?"),
        ("real_time", "?"),
        ("trip", f"S{TRIP}"),
        ("drive_state", f"S{STATE}"),
        ("emcy_code", "i4"),  # -1: none so far
        ("emcy", f"S{EMCY}"),
        ("mass_kg_m2", "f8"),
        ("mass_spread", "f8"),
        ("hand_damping_nm_s_per_rad", "f8"),
        ("hand_stiffness_nm_per_rad", "f8"),
        ("delay_cycles", "f8"),
        ("guard_factor", "f8"),
        ("guard_alarms", "i8"),
        ("guard_lowest", "f8"),
        ("energy_j", "f8"),
        ("missed_tpdo", "i8"),
        ("late_rpdo", "i8"),
        ("rows_lost", "i8"),
        ("frames_lost", "i8"),
        ("revision", "i8"),
        ("beat_timeout_s", "f8"),
        ("sync_interval_max_s", "f8"),
        ("latency", HISTOGRAM, (1,)),
        ("sync_to_rpdo", HISTOGRAM, (1,)),
    ],
    align=True,
)


class Status(NamedTuple):
    """State of a run; NaN where nothing is known.

    Attributes:
        cycle: SYNC count.
        t_s: Its nominal time [s].
        phase: enabling, rendering, leaving or measuring.
        ended: True once the run is over, or its process has gone.
        trip: What ended the wall, in one line; empty if nothing has.
        drive_state: Text for the drive's statusword.
        emcy_code: Code of the drive's latest EMCY, None if there was none.
        emcy: Text for it.
        mass_kg_m2: Mass in force in the model: drive, handle and hand.
        mass_spread: Its standard deviation, relative; 0: nothing learned.
        hand_damping_nm_s_per_rad: What the model reckons with for a hand of this mass.
        hand_stiffness_nm_per_rad: That of the hand; the cycle does not identify it.
        delay_cycles: Delay of the loop that the laws are told.
        guard_factor: Factor of the guard on the force of the law.
        guard_alarms: Its alarms so far.
        guard_lowest: Its least factor so far.
        energy_j: Energy that the wall has put out in this contact [J].
        missed_tpdo: TPDOs that were missing.
        late_rpdo: RPDOs that were sent after the next SYNC was due.
        latency_p50_s: Median of the time from a TPDO to its RPDO [s], and so on.
        sync_interval_max_s: Longest time between two SYNCs [s].
        margin_s: Time from the RPDO to the next SYNC that 99.9 % of the cycles have had [s], in
            real time.
        rows_lost: Rows that are missing in the record because the disk was too slow.
        frames_lost: Frames that are.
        revision: Number of changes of the wall so far.
        real_time: True if SYNCs follow the clock.
        beat_timeout_s: Time without a beat after which the wall is ramped down [s]; 0: none.
    """

    cycle: int
    t_s: float
    phase: str
    ended: bool
    trip: str
    drive_state: str
    emcy_code: int | None
    emcy: str
    mass_kg_m2: float
    mass_spread: float
    hand_damping_nm_s_per_rad: float
    hand_stiffness_nm_per_rad: float
    delay_cycles: float
    guard_factor: float
    guard_alarms: int
    guard_lowest: float
    energy_j: float
    missed_tpdo: int
    late_rpdo: int
    latency_p50_s: float
    latency_p99_s: float
    latency_p999_s: float
    latency_max_s: float
    sync_interval_max_s: float
    margin_s: float
    rows_lost: int
    frames_lost: int
    revision: int
    real_time: bool
    beat_timeout_s: float


def to_status(record: NDArray[np.void]) -> Status:
    """Convert a record STATUS, shape (1,)."""
    found = record[0]
    same = {name: found[name].item() for name in STATUS.names or () if name in Status._fields}
    texts = {n: same[n].decode(errors="replace") for n in ("trip", "drive_state", "emcy")}
    latency, since_due = found["latency"], found["sync_to_rpdo"]
    values = same | texts
    values |= {
        "t_s": found["cycle"].item() * found["cycle_s"].item(),
        "phase": Phase(found["phase"].item()).name.lower(),
        "ended": bool(found["ended"]),
        "emcy_code": found["emcy_code"].item() if found["emcy_code"] >= 0 else None,
        "latency_p50_s": percentile_ns(latency, 50.0) * 1e-9,
        "latency_p99_s": percentile_ns(latency, 99.0) * 1e-9,
        "latency_p999_s": percentile_ns(latency, 99.9) * 1e-9,
        "latency_max_s": latency["largest_ns"][0].item() * 1e-9,
        "margin_s": math.nan,
    }
    if found["real_time"] and since_due["counts"].any():
        values["margin_s"] = found["cycle_s"].item() - percentile_ns(since_due, 99.9) * 1e-9
    return Status(**values)
