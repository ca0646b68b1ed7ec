"""The closed loop in memory: the same compiled cycle and the same servo, without a bus between.

What the bus does to the loop is kept to the bit: positions in counts, torques in per mille, and
the delay D from a sample to its torque. What it is not: frames, the drive's state machine, what
the drive itself holds the torque to (I²t, its own limits).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.config import ConfigError, Settings
from canwall.cycle import Trip, fade_in, make_cycle, run_laws, start_at, step
from canwall.drive import DriveSetup, Field, PdoLayout, State
from canwall.drive import objects as od
from canwall.record import ROW, Phase
from canwall.simdrive import encoder_counts, hand_force, make_servo, move_servo, servo_scales
from canwall.units import DriveUnits
from canwall.walls import MAX_DELAY

Array = NDArray[np.float64]

#: Where the cycle finds position, statusword and torque, and puts its torque.
_TPDO = PdoLayout(
    0,
    (
        Field(od.POSITION_ACTUAL_VALUE, 0, 0, 32),
        Field(od.STATUSWORD, 0, 32, 16),
        Field(od.TORQUE_ACTUAL_VALUE, 0, 48, 16),
    ),
)
_RPDO = PdoLayout(0, (Field(od.TARGET_TORQUE, 0, 0, 16),))
_ENABLED = State.OPERATION_ENABLED.value[1]
_ENABLING, _RENDERING = int(Phase.ENABLING), int(Phase.RENDERING)
#: Per mille of a rated torque in mN·m, to N·m.
_PER_MILLE_MILLI = 1e-6

#: SYNCs that the drive of config/sim.toml takes from the first one to OPERATION ENABLED.
ENABLING_CYCLES = 7


@dataclass(frozen=True)
class Simulated:
    """What a closed loop came to: one row (dtype ROW) per cycle, up to a trip if there is one."""

    rows: NDArray[np.void]
    units: DriveUnits
    trip: Trip


def simulate(settings: Settings, cycles: int, enabling: int = ENABLING_CYCLES) -> Simulated:
    """Render the wall of a configuration for `cycles` SYNCs, the first `enabling` without torque.

    The delay of the loop is that of a synchronous RPDO, or of none at all (`torque_pdo` =
    "immediate"), and `simulation.torque_delay_cycles` beyond. Raises ConfigError for what only a
    run has: changes of the wall, a person at the handle.
    """
    simulation = settings.simulation
    if simulation is None:
        raise ConfigError("[simulation] is missing: there is no drive to simulate")
    if settings.schedule or settings.wall.alternate:
        raise ConfigError("schedule, wall.alternate: only a run changes its wall")
    laws = run_laws(settings)
    counts_per_rev, rated_mnm = servo_scales(settings.drive, simulation)
    units = DriveUnits(counts_per_rev, rated_mnm / 1000.0)
    cycle = make_cycle(settings, DriveSetup(units, 0, _TPDO, _RPDO), laws)
    servo = make_servo(simulation, counts_per_rev)
    start_at(cycle, encoder_counts(servo))
    cycle["phase"] = Phase.ENABLING
    fade_in(cycle, round(settings.run.ramp_in_s / settings.bus.cycle_s))
    delay = simulation.torque_delay_cycles
    delay += 0.0 if settings.drive.torque_pdo == "immediate" else 1.0
    if delay > MAX_DELAY:
        raise ConfigError(
            f"simulation.torque_delay_cycles: a delay of {delay:g} cycles in all is more than "
            f"{MAX_DELAY}, which is what the laws can reckon with"
        )
    push, slope = hand_force(simulation.hand, settings.bus.cycle_s, cycles)
    rows = np.zeros(cycles, ROW)
    whole = math.floor(delay)
    done = _close(
        cycle,
        servo,
        push,
        slope,
        rated_mnm * _PER_MILLE_MILLI,
        whole,
        delay - whole,
        settings.bus.cycle_s,
        enabling,
        rows,
    )
    return Simulated(rows[:done], units, Trip(int(cycle["trip"][0])))


@compiled
def _close(
    cycles: NDArray[np.void],
    servos: NDArray[np.void],
    push: Array,
    slope: Array,
    nm_per_mille: float,
    whole: int,
    share: float,
    period: float,
    enabling: int,
    rows: NDArray[np.void],
) -> int:
    """Fill the rows; how many there are. The torque of sample j acts from j + whole + share on."""
    cycle: Record = cycles[0]
    counts = encoder_counts(servos)
    # Torques on their way in per mille: sent[k] was computed k samples ago.
    sent = np.zeros(MAX_DELAY + 2, np.int64)
    for j in range(len(rows)):
        if j == enabling:
            cycle.phase = _RENDERING
        # What the drive shows acts at the instant of the SYNC; one that is on its way does not.
        shown = sent[whole] if share > 0.0 or whole == 0 else sent[whole - 1]
        data = (counts & 0xFFFFFFFF) | (_ENABLED << 32) | ((shown & 0xFFFF) << 48)
        step(cycles, rows[j : j + 1], data, True)
        for k in range(MAX_DELAY + 1, 0, -1):
            sent[k] = sent[k - 1]
        sent[0] = cycle.torque_per_mille
        late = share * period
        if share > 0.0:
            move_servo(servos, sent[whole + 1] * nm_per_mille, push[j], slope[j], late)
        after = push[j] + slope[j] * late if share > 0.0 else push[j]
        counts = move_servo(servos, sent[whole] * nm_per_mille, after, slope[j], period - late)
        if cycle.trip != 0:
            return j + 1
    return len(rows)
