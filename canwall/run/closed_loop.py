"""Closed loop in memory: the compiled cycle and the simulated servo, without a bus between them.

The effects of the bus on the loop are reproduced exactly: positions in counts, torques in per
mille, and the delay D from a sample to its torque. Frames, the drive's state machine and I²t are
not simulated.
"""

import functools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.felt import felt_body, mean_hand_force
from canwall.compiled import Record, compiled, copied
from canwall.config import ConfigError, Settings
from canwall.cycle import Trip, fade_in, make_cycle, run_laws, start_at, step_address, step_at
from canwall.drive import DriveSetup, DriveState, Field, PdoLayout
from canwall.drive import objects as od
from canwall.physics import HandBody
from canwall.record import ROW, Phase
from canwall.simdrive import (
    ServoScales,
    hand_body,
    hand_force,
    make_servo,
    move_servo,
    servo_scales,
    shows_its_torque,
)
from canwall.units import DriveUnits
from canwall.walls import MAX_DELAY

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

#: PDOs from which the cycle reads position, statusword and torque, and to which it writes.
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
_RENDERING = int(Phase.RENDERING)
#: N·m per mN·m and per mille.
_PER_MILLE_MILLI = 1e-6

#: Signals of a loop in memory, see `simulate_loop`.
SIGNALS = 6

#: SYNCs from the first one to OPERATION ENABLED with the drive of config/sim.toml.
ENABLING_CYCLES = 7


@dataclass(frozen=True)
class SimulatedRun:
    """Result of a closed loop: a row (dtype ROW) per cycle up to the trip, if there is one.

    `positions` are those at the SYNCs relative to the wall [rad], also of TPDOs that are lost.
    `lag` is the number of cycles by which the TPDOs were found to be late in the end.
    """

    rows: NDArray[np.void]
    units: DriveUnits
    trip: Trip
    positions: Array
    lag: int


@dataclass(frozen=True)
class Disturbances:
    """Faults of bus and master in TPDOs and SYNCs; each of shape (cycles,).

    Attributes:
        lost: True for each SYNC whose TPDO is lost.
        late: True for each SYNC that gets the TPDO of the one before.
        skipped: SYNCs that the master skips after each one.
        strays: Time by which each SYNC is later than its grid [s].
    """

    lost: NDArray[np.bool_]
    late: NDArray[np.bool_]
    skipped: NDArray[np.int64]
    strays: Array

    @classmethod
    def none(cls, cycles: int) -> "Disturbances":
        """Return those of a bus and a master without faults, to be changed in place."""
        return cls(
            np.zeros(cycles, bool),
            np.zeros(cycles, bool),
            np.zeros(cycles, np.int64),
            np.zeros(cycles),
        )

    @classmethod
    def jitter(cls, cycles: int, deviation_s: float, period_s: float, seed: int) -> "Disturbances":
        """Return those of a master whose SYNCs are normally distributed about their grid.

        Args:
            cycles: Number of SYNCs.
            deviation_s: Standard deviation of a SYNC [s].
            period_s: Period of the grid [s]; a SYNC deviates by 0.45 of it at most.
            seed: Seed of the random numbers.
        """
        drawn = np.random.default_rng(seed).normal(0.0, deviation_s, cycles)
        strays = np.clip(drawn, -0.45 * period_s, 0.45 * period_s)
        return replace(cls.none(cycles), strays=strays)


class LoopRecords(NamedTuple):
    """A closed loop in the form that compiled code takes; it can be simulated repeatedly.

    Attributes:
        step: Address of the compiled step.
        cycle: Record of the cycle, shape (1,).
        servo: Record of the servo, shape (1,).
        cycle_bytes: The memory of `cycle` as bytes.
        servo_bytes: The memory of `servo` as bytes.
        cycle_before: Bytes of `cycle` at the start.
        servo_before: Bytes of `servo` at the start.
        push: Force of the hand at the SYNC of each cycle [N·m], shape (cycles,).
        slope: Its slope over the cycle [N·m/s], shape (cycles,).
        felt: The body on which the felt force acts, from `felt_body`.
        nm_per_mille: Torque of one per mille at the shaft [N·m].
        whole: Whole periods of the delay D.
        share: Rest of the delay D [periods].
        enabling: Cycles before the wall is rendered.
        lost: See `Disturbances`, as the following.
        late: TPDOs of the SYNC before.
        skipped: SYNCs skipped.
        strays: SYNCs that are late.
    """

    step: int
    cycle: NDArray[np.void]
    servo: NDArray[np.void]
    cycle_bytes: Bytes
    servo_bytes: Bytes
    cycle_before: Bytes
    servo_before: Bytes
    push: Array
    slope: Array
    felt: HandBody
    nm_per_mille: float
    whole: int
    share: float
    enabling: int
    lost: NDArray[np.bool_]
    late: NDArray[np.bool_]
    skipped: NDArray[np.int64]
    strays: Array


def simulate(
    settings: Settings,
    cycles: int,
    disturbances: Disturbances | None = None,
) -> SimulatedRun:
    """Render the wall of a configuration in memory.

    The delay of the loop is one period for a synchronous RPDO, none for one that acts on reception,
    plus `simulation.torque_delay_cycles`.

    Args:
        settings: Configuration with `[simulation]`, without changes of the wall.
        cycles: Number of SYNCs.
        disturbances: What bus and master do. Default: nothing.

    Raises:
        ConfigError: If only a run can render the configuration.
    """
    loop = ClosedLoop(settings, cycles, disturbances=disturbances)
    records, rows, signals = loop.records(), np.zeros(cycles, ROW), np.empty((SIGNALS, cycles))
    done = simulate_loop(records, rows, signals)
    trip = Trip(int(records.cycle["trip"][0]))
    lag = int(records.cycle["lag"][0])
    return SimulatedRun(rows[:done], loop.units, trip, signals[0, :done], lag)


def make_simulated_cycle(settings: Settings) -> NDArray[np.void]:
    """Return the record of the wall of a configuration on its simulated drive (`make_cycle`)."""
    units = simulated_units(settings)
    limit_nm = cached_servo_scales(settings).torque_limit_per_mille * units.nm_per_mille
    setup = DriveSetup(units, 0, _TPDO, _RPDO, torque_limit_nm=limit_nm)
    return make_cycle(settings, setup, run_laws(settings))


class ClosedLoop:
    """Cycle, servo and hand of a configuration, to be simulated with one wall or several."""

    def __init__(
        self,
        settings: Settings,
        cycles: int,
        enabling: int = ENABLING_CYCLES,
        disturbances: Disturbances | None = None,
    ) -> None:
        """Prepare a loop as `simulate` does, with `enabling` SYNCs without torque at the start."""
        simulation = settings.simulation
        if simulation is None:
            raise ConfigError("[simulation] is missing: there is no drive to simulate")
        if settings.schedule or settings.wall.alternate:
            raise ConfigError("schedule, wall.alternate: only a run can change its wall")
        scales = cached_servo_scales(settings)
        self.units = simulated_units(settings)
        self._cycle = make_simulated_cycle(settings)
        self._servo = make_servo(simulation, scales.counts_per_rev)
        start_at(self._cycle, int(self._servo["latched_counts"][0]))
        self._cycle["phase"] = Phase.ENABLING
        fade_in(self._cycle, round(settings.run.ramp_in_s / settings.bus.cycle_s))
        delay = loop_delay(settings)
        if delay > MAX_DELAY:
            raise ConfigError(
                f"simulation.torque_delay_cycles: the delay is {delay:g} cycles in all; the laws "
                f"compensate for {MAX_DELAY} at most"
            )
        self._push, self._slope = hand_force(simulation.hand, settings.bus.cycle_s, cycles)
        self._felt = felt_body(hand_body(simulation), simulation.handle_inertia_kg_m2)
        self._nm_per_mille = scales.rated_torque_mnm * _PER_MILLE_MILLI * scales.gear_ratio
        self._whole = math.floor(delay)
        self._share = delay - self._whole
        self._enabling = enabling
        self._disturbances = disturbances or Disturbances.none(cycles)

    def records(self) -> LoopRecords:
        """Return records for a thread of its own; several may simulate the loop at a time."""
        cycle, servo = copied(self._cycle), copied(self._servo)
        return LoopRecords(
            step_address(),
            cycle,
            servo,
            cycle.view(np.uint8),
            servo.view(np.uint8),
            self._cycle.view(np.uint8),
            self._servo.view(np.uint8),
            self._push,
            self._slope,
            self._felt,
            self._nm_per_mille,
            self._whole,
            self._share,
            self._enabling,
            self._disturbances.lost,
            self._disturbances.late,
            self._disturbances.skipped,
            self._disturbances.strays,
        )


def loop_delay(settings: Settings) -> float:
    """Return D of the simulated drive, the cycles from sample to torque (docs/laws.md)."""
    assert settings.simulation is not None
    synchronous = settings.drive.torque_pdo != "immediate"
    return settings.simulation.torque_delay_cycles + (1.0 if synchronous else 0.0)


def simulated_units(settings: Settings) -> DriveUnits:
    """Return the units of the simulated drive at the shaft."""
    scales = cached_servo_scales(settings)
    return DriveUnits.behind_gear(
        scales.counts_per_rev / scales.gear_ratio,
        scales.rated_torque_mnm / 1000.0,
        scales.gear_ratio,
    )


def cached_servo_scales(settings: Settings) -> ServoScales:
    """Return `servo_scales`, reading each dictionary only once."""
    drive, simulation = settings.drive, settings.simulation
    assert simulation is not None
    # Reading a dictionary takes as long as a hundred strikes. The key contains everything that the
    # scales depend on.
    known = simulation.model_dump(
        mode="json", include={"objects", "counts_per_rev", "rated_torque_nm"}
    )
    try:
        written = drive.eds.stat().st_mtime_ns
    except OSError:
        written = 0
    told = (drive.node_id, drive.rated_torque_unit_nm, drive.gear_ratio)
    key = (str(drive.eds), written, *told, str(known))
    return _read_scales(_KeyedSettings(settings, key))


class _KeyedSettings:
    """Settings that compare equal if the scales of their drives do."""

    def __init__(self, settings: Settings, key: tuple[object, ...]) -> None:
        self.settings, self.key = settings, key

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _KeyedSettings) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@functools.lru_cache(maxsize=256)
def _read_scales(keyed: _KeyedSettings) -> ServoScales:
    assert keyed.settings.simulation is not None
    return servo_scales(keyed.settings.drive, keyed.settings.simulation)


@compiled
def simulate_loop(loop: LoopRecords, rows: NDArray[np.void], signals: Array) -> int:
    """Simulate the loop from its start on the configuration's wall.

    `loop.cycle` keeps its final state, including the trip.

    Args:
        loop: The loop.
        rows: Rows of the last cycles, shape (n,), dtype ROW: cycle j is in j modulo n.
        signals: Result, shape (SIGNALS, cycles): position relative to the wall [rad]; force held
            from each SYNC on, out of the wall [N·m]; commanded torque [N·m]; mean force on the hand
            over the cycle [N·m]; stiffness in force [N·m/rad]; mass in the laws' model [kg·m²].

    Returns:
        Number of cycles, up to a trip.
    """
    _restore_initial_state(loop)
    return _run_cycles(loop, rows, signals)


@compiled
def simulate_wall(
    loop: LoopRecords, stiffness: float, damping: float, rows: NDArray[np.void], signals: Array
) -> int:
    """Call `simulate_loop` on a wall of this stiffness [N·m/rad] and damping [N·m·s/rad]."""
    _restore_initial_state(loop)
    cycle: Record = loop.cycle[0]
    # The fields that `set_wall` sets.
    wall = cycle.rendered[0].wall[0]
    wall.stiffness = wall.asked_stiffness = stiffness
    wall.damping = wall.asked_damping = damping
    wall.referent[0].wall_stiffness = stiffness
    wall.referent[0].wall_damping = damping
    return _run_cycles(loop, rows, signals)


@compiled
def _restore_initial_state(loop: LoopRecords) -> None:
    loop.cycle_bytes[:] = loop.cycle_before
    loop.servo_bytes[:] = loop.servo_before


@compiled
def _run_cycles(loop: LoopRecords, rows: NDArray[np.void], signals: Array) -> int:
    """Fill the signals and return the number of cycles.

    The torque of sample j acts from the time j + whole + share on.
    """
    cycles, servos, push, slope = loop.cycle, loop.servo, loop.push, loop.slope
    nm_per_mille, whole, share = loop.nm_per_mille, loop.whole, loop.share
    cycle: Record = cycles[0]
    servo: Record = servos[0]
    period, counts = cycle.period, servo.latched_counts
    late, skipped, strays = loop.late, loop.skipped, loop.strays
    data = data_before = 0
    # Torques in per mille that are on their way: sent[k] was computed k samples ago.
    sent = np.zeros(MAX_DELAY + 2, np.int64)
    at = 0
    for j in range(len(push)):
        if j == loop.enabling:
            cycle.phase = _RENDERING
        # The drive shows the torque that acts at the SYNC, not the one that is still on its way.
        shown = sent[whole] if share > 0.0 or whole == 0 else sent[whole - 1]
        if shows_its_torque(servos):
            shown = int(np.rint(servo.latched_torque / nm_per_mille))
        data_before = data
        data = (counts & 0xFFFFFFFF) | (_ENABLED << 32) | ((shown & 0xFFFF) << 48)
        taken = data_before if late[j] else data
        step_at(loop.step, cycles, rows[at : at + 1], taken, not loop.lost[j])
        # Two TPDOs come in the cycle in which they are late for the last time.
        cycle.overtaken = late[j] and not (j + 1 < len(push) and late[j + 1])
        row: Record = rows[at]
        oriented = cycle.orientation * counts * cycle.rad_per_count
        signals[0, j] = oriented - cycle.orientation * cycle.rendered[0].position
        signals[1, j], signals[2, j] = row.force_applied, row.torque_cmd
        signals[4, j], signals[5, j] = row.stiffness_in_force, row.mass_est
        at = at + 1 if at + 1 < len(rows) else 0
        for k in range(MAX_DELAY + 1, 0, -1):
            sent[k] = sent[k - 1]
        sent[0] = cycle.torque_per_mille
        hand_y, hand_v = servo.hand_y, servo.hand_v
        # The hand's script is one of time, wherever the SYNCs are.
        at_sync = push[j] + slope[j] * strays[j]
        length = period + (strays[j + 1] - strays[j] if j + 1 < len(push) else 0.0)
        before = share * period
        if share > 0.0:
            move_servo(servos, sent[whole + 1] * nm_per_mille, at_sync, slope[j], before)
        after = at_sync + slope[j] * before if share > 0.0 else at_sync
        torque = sent[whole] * nm_per_mille
        counts = move_servo(servos, torque, after, slope[j], length - before)
        mean_push = at_sync + 0.5 * slope[j] * length
        signals[3, j] = mean_hand_force(
            loop.felt, hand_y, hand_v, servo.hand_y, servo.hand_v, mean_push, length
        )
        if skipped[j]:
            # The hand, whose script is one of SYNCs, waits.
            after = push[j] + slope[j] * period
            counts = move_servo(servos, torque, after, 0.0, skipped[j] * period)
            cycle.skipped = skipped[j]
        if cycle.trip != 0:
            return j + 1
    return len(push)
