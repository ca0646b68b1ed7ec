"""The closed loop in memory: the same compiled cycle and the same servo, without a bus between.

What the bus does to the loop is kept to the bit: positions in counts, torques in per mille, and
the delay D from a sample to its torque. What it is not: frames, the drive's state machine, I²t.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled, copied
from canwall.config import ConfigError, Settings
from canwall.cycle import Trip, fade_in, make_cycle, run_laws, start_at, step
from canwall.drive import DriveSetup, DriveState, Field, PdoLayout
from canwall.drive import objects as od
from canwall.record import ROW, Phase
from canwall.simdrive import (
    ServoScales,
    encoder_counts,
    hand_force,
    make_servo,
    move_servo,
    servo_scales,
)
from canwall.units import DriveUnits
from canwall.walls import MAX_DELAY

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

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
_ENABLED = DriveState.OPERATION_ENABLED.value[1]
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


class LoopRecords(NamedTuple):
    """A closed loop as compiled code takes it, to be closed as often as wanted.

    The records of cycle and servo, the same memory as bytes, and their bytes at the beginning;
    push and slope of the hand's force in each cycle; and what `ClosedLoop` knows.
    """

    cycle: NDArray[np.void]
    servo: NDArray[np.void]
    cycle_bytes: Bytes
    servo_bytes: Bytes
    cycle_before: Bytes
    servo_before: Bytes
    push: Array
    slope: Array
    nm_per_mille: float
    whole: int
    share: float
    enabling: int


def simulate(settings: Settings, cycles: int, enabling: int = ENABLING_CYCLES) -> Simulated:
    """Render the wall of a configuration for `cycles` SYNCs, the first `enabling` without torque.

    The delay of the loop is that of a synchronous RPDO, or of none at all (`torque_pdo` =
    "immediate"), and `simulation.torque_delay_cycles` beyond. Raises ConfigError for what only a
    run has: changes of the wall, a person at the handle.
    """
    loop = ClosedLoop(settings, cycles, enabling)
    ready, rows = loop.records(), np.zeros(cycles, ROW)
    done = simulate_loop(ready, rows, np.empty((3, cycles)))
    return Simulated(rows[:done], loop.units, Trip(int(ready.cycle["trip"][0])))


class ClosedLoop:
    """Cycle, servo and hand of a configuration, ready to be closed with one wall or several."""

    def __init__(self, settings: Settings, cycles: int, enabling: int = ENABLING_CYCLES) -> None:
        """Raise ConfigError as `simulate` does."""
        simulation = settings.simulation
        if simulation is None:
            raise ConfigError("[simulation] is missing: there is no drive to simulate")
        if settings.schedule or settings.wall.alternate:
            raise ConfigError("schedule, wall.alternate: only a run changes its wall")
        scales = known_scales(settings)
        motor_nm = scales.rated_torque_mnm / 1000.0
        self.units = DriveUnits.behind_gear(
            scales.counts_per_rev / scales.gear_ratio, motor_nm, scales.gear_ratio
        )
        limit_nm = scales.torque_limit_per_mille * self.units.nm_per_mille
        setup = DriveSetup(self.units, 0, _TPDO, _RPDO, torque_limit_nm=limit_nm)
        self._cycle = make_cycle(settings, setup, run_laws(settings))
        self._servo = make_servo(simulation, scales.counts_per_rev)
        start_at(self._cycle, encoder_counts(self._servo))
        self._cycle["phase"] = Phase.ENABLING
        fade_in(self._cycle, round(settings.run.ramp_in_s / settings.bus.cycle_s))
        delay = loop_delay(settings)
        if delay > MAX_DELAY:
            raise ConfigError(
                f"simulation.torque_delay_cycles: a delay of {delay:g} cycles in all is more than "
                f"{MAX_DELAY}, which is what the laws can reckon with"
            )
        self._push, self._slope = hand_force(simulation.hand, settings.bus.cycle_s, cycles)
        self._nm_per_mille = scales.rated_torque_mnm * _PER_MILLE_MILLI * scales.gear_ratio
        self._whole = math.floor(delay)
        self._share = delay - self._whole
        self._enabling = enabling

    def records(self) -> LoopRecords:
        """Records of its own for whoever closes it: several threads may."""
        cycle, servo = copied(self._cycle), copied(self._servo)
        return LoopRecords(
            cycle,
            servo,
            cycle.view(np.uint8),
            servo.view(np.uint8),
            self._cycle.view(np.uint8),
            self._servo.view(np.uint8),
            self._push,
            self._slope,
            self._nm_per_mille,
            self._whole,
            self._share,
            self._enabling,
        )


def loop_delay(settings: Settings) -> float:
    """D of the simulated drive: from a sample to its torque, in cycles (theory, section 3)."""
    assert settings.simulation is not None
    synchronous = settings.drive.torque_pdo != "immediate"
    return settings.simulation.torque_delay_cycles + (1.0 if synchronous else 0.0)


def known_scales(settings: Settings) -> ServoScales:
    """`servo_scales`, each dictionary read once."""
    drive, simulation = settings.drive, settings.simulation
    assert simulation is not None
    # Reading a dictionary costs as much as a hundred strikes: kept by all that it depends on.
    known = simulation.model_dump(
        mode="json", include={"objects", "counts_per_rev", "rated_torque_nm"}
    )
    try:
        written = drive.eds.stat().st_mtime_ns
    except OSError:
        written = 0
    return _scales(_Scaled(settings, (str(drive.eds), written, drive.node_id, str(known))))


class _Scaled:
    """Settings that are alike in what the scales depend on."""

    def __init__(self, settings: Settings, key: tuple[object, ...]) -> None:
        self.settings, self.key = settings, key

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Scaled) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@functools.lru_cache(maxsize=256)
def _scales(scaled: _Scaled) -> ServoScales:
    assert scaled.settings.simulation is not None
    return servo_scales(scaled.settings.drive, scaled.settings.simulation)


@compiled
def simulate_loop(loop: LoopRecords, rows: NDArray[np.void], signals: Array) -> int:
    """Run from the beginning on the configuration's wall; how many cycles there were.

    rows has dtype ROW and as many elements as are to be kept: cycle j goes into j modulo their
    number. signals has shape (3, cycles): position relative to the wall; force held from each SYNC
    on, out of the wall; torque commanded. `loop.cycle` is left as it is at the end, with the trip.
    """
    _restore_initial_state(loop)
    return _run_cycles(loop, rows, signals)


@compiled
def simulate_wall(
    loop: LoopRecords, stiffness: float, damping: float, rows: NDArray[np.void], signals: Array
) -> int:
    """`simulate_loop` on a wall of another stiffness and damping."""
    _restore_initial_state(loop)
    cycle: Record = loop.cycle[0]
    # Where `set_wall` writes them.
    wall = cycle.rendered[0].wall[0]
    wall.stiffness = stiffness
    wall.damping = damping
    wall.referent[0].wall_stiffness = stiffness
    wall.referent[0].wall_damping = damping
    return _run_cycles(loop, rows, signals)


@compiled
def _restore_initial_state(loop: LoopRecords) -> None:
    loop.cycle_bytes[:] = loop.cycle_before
    loop.servo_bytes[:] = loop.servo_before


@compiled
def _run_cycles(loop: LoopRecords, rows: NDArray[np.void], signals: Array) -> int:
    """Fill the signals; how many cycles. The torque of sample j acts from j + whole + share on."""
    cycles, servos, push, slope = loop.cycle, loop.servo, loop.push, loop.slope
    nm_per_mille, whole, share = loop.nm_per_mille, loop.whole, loop.share
    cycle: Record = cycles[0]
    period, counts = cycle.period, encoder_counts(servos)
    # Torques on their way in per mille: sent[k] was computed k samples ago.
    sent = np.zeros(MAX_DELAY + 2, np.int64)
    at = 0
    for j in range(len(push)):
        if j == loop.enabling:
            cycle.phase = _RENDERING
        # What the drive shows acts at the instant of the SYNC; one that is on its way does not.
        shown = sent[whole] if share > 0.0 or whole == 0 else sent[whole - 1]
        data = (counts & 0xFFFFFFFF) | (_ENABLED << 32) | ((shown & 0xFFFF) << 48)
        step(cycles, rows[at : at + 1], data, True)
        row: Record = rows[at]
        signals[0, j], signals[1, j], signals[2, j] = row.y, row.force_applied, row.torque_cmd
        at = at + 1 if at + 1 < len(rows) else 0
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
    return len(push)
