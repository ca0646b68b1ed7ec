"""One strike of an operator on a wall: as settings of a run, rendered, and judged."""

import math
import threading
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from canwall.analysis import AskedWall, ReferentInputs, follow_referent
from canwall.analysis.felt import HANDLE_RADIUS_M, FeltBand, felt_band, handle_radius
from canwall.analysis.restitution import swing_samples
from canwall.analysis.strike import MEASURES, keeps_limits, measure_strike
from canwall.compiled import Record, compiled
from canwall.config import ConfigError, Hand, Mechanics, Settings, Simulation
from canwall.cycle import Trip, named_law, run_laws, stiffest_for
from canwall.errors import InputError, RunFailedError
from canwall.record import ROW, Phase, Ring
from canwall.run import drive_dictionary, make_axis, make_exchange, on_the_bus, render
from canwall.run.closed_loop import (
    ENABLING_CYCLES,
    SIGNALS,
    ClosedLoop,
    Disturbances,
    LoopRecords,
    simulate_wall,
)
from canwall.run.referent import Referent
from canwall.supervised import given_up
from canwall.walls import failed_how

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Operator:
    """Impedance of an operator at the handle, in shaft coordinates.

    Attributes:
        name: Name on the axis `operator`.
        inertia_kg_m2: Inertia [kg·m²].
        damping_nm_s_per_rad: Damping [N·m·s/rad].
        stiffness_nm_per_rad: Stiffness [N·m/rad].
    """

    name: str
    inertia_kg_m2: float
    damping_nm_s_per_rad: float
    stiffness_nm_per_rad: float

    @property
    def keys(self) -> dict[str, float]:
        """Values of the keys of a configuration."""
        return {
            f"simulation.hand.{key}": value for key, value in vars(self).items() if key != "name"
        }


def _at_radius(name: str, mass_kg: float, damping: float, stiffness: float) -> Operator:
    """Convert mass [kg], damping [N·s/m] and stiffness [N/m] at a handle of 80 mm."""
    square = HANDLE_RADIUS_M**2
    return Operator(name, mass_kg * square, damping * square, stiffness * square)


#: Operators within the ranges of docs/results.md, from nobody to a hand with its arm.
OPERATORS = {
    operator.name: operator
    for operator in (
        Operator("none", 0.0, 0.0, 0.0),
        _at_radius("fingertip", 0.004, 2.0, 300.0),
        _at_radius("finger", 0.020, 4.0, 500.0),
        _at_radius("grip", 0.050, 6.0, 800.0),
        _at_radius("hand", 0.200, 6.5, 400.0),
        _at_radius("arm", 0.550, 6.5, 135.0),
    )
}


@dataclass(frozen=True)
class Servo:
    """Lag and cycle of a servo (docs/laws.md), known to the model of the laws.

    Attributes:
        name: Name on the axis `servo`.
        current_bandwidth_hz: Bandwidth of its current loop [Hz].
        drive_cycle_s: Period of its own cycle [s].
    """

    name: str
    current_bandwidth_hz: float
    drive_cycle_s: float

    @property
    def keys(self) -> dict[str, float]:
        """Values of the keys of a configuration; its crystal is off by some tens of ppm."""
        known = {key: value for key, value in vars(self).items() if key != "name"}
        simulated = known | {"clock_ppm": 50.0, "ideal": False}
        return {f"drive.{key}": value for key, value in known.items()} | {
            f"simulation.{key}": value for key, value in simulated.items()
        }


SERVOS = {
    servo.name: servo for servo in (Servo("1600Hz", 1600.0, 0.00025), Servo("800Hz", 800.0, 0.0004))
}
_FIRST_STRIKE_S = 0.05
_AFTERWARDS_S = 0.25
#: Part of the way from the wall to a limit of position up to which a wall holds the hand.
_HELD_WITHIN = 0.25
#: Cycles of rest between enabling and the strike: at 100 Hz _FIRST_STRIKE_S is too short for it.
_AT_REST_CYCLES = 3
#: Longest strike: 100 MB of signals.
_MOST_CYCLES = 2_000_000


def law_model(settings: Settings, knows: str, error: float) -> Mechanics:
    """Return the model that the laws use.

    The hand's spring is never part of it: its rest position moves, so it is left to the estimated
    force.

    Args:
        settings: Configuration with `[simulation]`.
        knows: "matched": drive and hand; "drive": the drive alone; "file": `[mechanics]`.
        error: Relative error of the inertia.

    Raises:
        ConfigError: If that leaves less than the rotor of an elastic shaft.
    """
    simulation = settings.simulation
    assert simulation is not None
    if knows == "file":
        model = settings.mechanics
    else:
        hand = (
            simulation.hand
            if knows == "matched"
            else Hand(inertia_kg_m2=0.0, damping_nm_s_per_rad=0.0)
        )
        model = Mechanics(
            inertia_kg_m2=simulation.inertia_kg_m2 + hand.inertia_kg_m2,
            viscous_nm_s_per_rad=simulation.viscous_nm_s_per_rad + hand.damping_nm_s_per_rad,
            coulomb_nm=simulation.coulomb_nm,
            handle_radius_m=settings.mechanics.handle_radius_m,
        )
        if simulation.shaft_hz:
            model = model.model_copy(update=_known_shaft(simulation, model.inertia_kg_m2))
    inertia = model.inertia_kg_m2 * (1.0 + error)
    if model.shaft_hz and model.rotor_inertia_kg_m2 and inertia <= model.rotor_inertia_kg_m2:
        raise ConfigError(
            f"sweep axis model_error: with {error:g} the model's inertia is {inertia:.3g} kg·m², "
            f"and its rotor alone has {model.rotor_inertia_kg_m2:.3g} kg·m²"
        )
    return model.model_copy(update={"inertia_kg_m2": inertia})


def _known_shaft(simulation: Simulation, inertia: float) -> dict[str, float]:
    """Return the keys of the shaft in a model of this inertia [kg·m²], with a hand or without."""
    rotor = simulation.rotor_inertia_kg_m2
    alone = simulation.inertia_kg_m2
    # The same spring and damper between other masses.
    slower = math.sqrt((1.0 - rotor / alone) / (1.0 - rotor / inertia))
    return {
        "shaft_hz": simulation.shaft_hz * slower,
        "shaft_damping_ratio": simulation.shaft_damping_ratio * slower,
        "rotor_inertia_kg_m2": rotor,
    }


def strike_settings(
    settings: Settings,
    speed_rad_s: float,
    phase: float,
    start_rad: float,
    press_s: float,
    press_nm: float,
) -> Settings:
    """Return settings with which the operator strikes the wall once and presses.

    Args:
        settings: Configuration with `[simulation]`; its hand is the operator.
        speed_rad_s: Mean speed of the hand's approach [rad/s].
        phase: Phase of the contact relative to the SYNC, 0 … 1: shifts the start by this share of
            the way of one period.
        start_rad: Distance from the wall at which the approach starts [rad].
        press_s: Time for which the hand presses [s].
        press_nm: Torque with which it presses [N·m].

    Raises:
        ConfigError: If the strike has too many cycles.
    """
    simulation, period = settings.simulation, settings.bus.cycle_s
    assert simulation is not None
    sign = settings.wall.orientation
    wall = settings.wall.position_rad
    start = start_rad + phase * speed_rad_s * period
    stiffness = simulation.hand.stiffness_nm_per_rad
    # A hand with a spring presses through it, one without by its muscle torque alone.
    depth = press_nm / stiffness if stiffness > 0.0 else 0.0
    travel_s = (start + depth) / speed_rad_s
    first_s = max(_FIRST_STRIKE_S, (ENABLING_CYCLES + _AT_REST_CYCLES) * period)
    hand = simulation.hand.model_copy(
        update={
            "strikes": 1,
            "first_strike_s": first_s,
            "rest_rad": wall + sign * start,
            "press_rad": wall - sign * depth,
            "press_torque_nm": 0.0 if stiffness > 0.0 else -sign * press_nm,
            "approach_s": travel_s,
            "press_s": press_s,
            "withdraw_s": travel_s,
            "script": (),
            "random": None,
        }
    )
    duration = first_s + 2.0 * travel_s + press_s + _AFTERWARDS_S
    if duration > _MOST_CYCLES * period:
        raise ConfigError(
            f"sweep axes speed, start, press, rate: a strike of {duration:.4g} s has "
            f"{duration / period:.3g} cycles; {_MOST_CYCLES} at most"
        )
    return settings.model_copy(
        update={
            "simulation": simulation.model_copy(update={"hand": hand}),
            "schedule": (),
            "run": settings.run.model_copy(update={"duration_s": duration}),
        }
    )


@dataclass(frozen=True)
class StrikeMotion:
    """One strike from SYNC to SYNC.

    Attributes:
        rows: Its cycles, dtype ROW, shape (n,).
        felt: Mean forces on the hand over the period from each SYNC on [N·m], shape (n,).
        referent: Positions of the continuous referent relative to the wall [rad], shape (n,).
        referent_felt: The same forces of the referent [N·m], shape (n,).
        measures: Measures of the strike, dtype MEASURES.
    """

    rows: NDArray[np.void]
    felt: Array
    referent: Array
    referent_felt: Array
    measures: np.void


class PreparedStrike:
    """One strike, prepared once, to be rendered on one wall after another and judged."""

    def __init__(
        self, settings: Settings, through: str = "sim", sync_jitter_s: float = 0.0
    ) -> None:
        """Prepare a strike.

        Args:
            settings: Settings from `strike_settings`.
            through: "sim": in memory; "bus": by frames.
            sync_jitter_s: Standard deviation of a SYNC from its grid [s], in memory only.

        Raises:
            InputError: For jitter by frames, whose simulated time has none.
        """
        if through == "bus" and sync_jitter_s > 0.0:
            raise InputError("sweep axis sync_jitter: has to be 0 with --through bus")
        assert settings.run.duration_s is not None
        assert settings.simulation is not None
        self._settings = settings
        self._cycles = round(settings.run.duration_s / settings.bus.cycle_s)
        self._disturbances = Disturbances.jitter(
            self._cycles, sync_jitter_s, settings.bus.cycle_s, settings.simulation.seed
        )
        self._prepare(settings.wall.damping_nm_s_per_rad)
        referent = Referent(settings, settings.simulation, self._cycles)
        self._referent = referent.inputs(np.full(self._cycles, settings.wall.position_rad))
        # Each wall fills in its own stiffness and damping.
        wall = settings.wall
        cap = wall.cap / wall.divider**2
        self._asked = AskedWall(
            *(np.full(self._cycles, value) for value in (0.0, 0.0, wall.damping_ratio, cap))
        )
        self._band = felt_band(settings.bus.cycle_s)
        self._radius = handle_radius(settings.mechanics.handle_radius_m)
        self._swing_samples = swing_samples(settings.simulation.shaft_hz, settings.bus.cycle_s)
        self._by_frames = through == "bus"
        self.law = named_law(settings)

    def _prepare(self, damping: float) -> None:
        """Prepare the loop for walls of this damping, which bounds the stiffness on a shaft."""
        wall = self._settings.wall.model_copy(update={"damping_nm_s_per_rad": damping})
        settings = self._settings.model_copy(update={"wall": wall})
        self._damping = damping
        self._loop = ClosedLoop(settings, self._cycles, disturbances=self._disturbances).records()
        #: The referent is no stiffer than shaft, delay and encoder bear.
        self._stiffest = stiffest_for(self._loop.cycle, settings, self.mass)

    def _prepare_for(self, damping: float) -> None:
        """Prepare the loop anew if it is one for walls of another damping."""
        if damping != self._damping and self._settings.mechanics.shaft_hz:
            self._prepare(damping)

    @property
    def mass(self) -> float:
        """Inertia of drive, handle and hand together [kg·m²]."""
        assert self._settings.simulation is not None
        simulation = self._settings.simulation
        return simulation.inertia_kg_m2 + simulation.hand.inertia_kg_m2

    @property
    def period(self) -> float:
        """Period T of the SYNC [s]."""
        return self._settings.bus.cycle_s

    @property
    def softest(self) -> float:
        """Stiffness that holds the pressing hand within _HELD_WITHIN of the way [N·m/rad]."""
        assert self._settings.simulation is not None
        hand, wall = self._settings.simulation.hand, self._settings.wall.position_rad
        press = abs(hand.press_torque_nm) + hand.stiffness_nm_per_rad * abs(hand.press_rad - wall)
        way = min(abs(limit - wall) for limit in self._settings.limits.position_rad)
        return press / (_HELD_WITHIN * way)

    @property
    def progress(self) -> int:
        """A value that changes as long as a strike in memory gets on."""
        return int(self._loop.cycle["j"][0])

    @property
    def evaluating(self) -> str:
        """Wall and cycle whose law is being evaluated in memory; empty if none is."""
        cycle = self._loop.cycle[0]
        if not cycle["evaluated"]:
            return ""
        wall = cycle["rendered"][0]["wall"][0]
        stiffness, damping = float(wall["asked_stiffness"]), float(wall["asked_damping"])
        return f"{_shown(stiffness, damping)}: cycle {self.progress}: law {self.law}"

    def on(self, stiffness: float, damping: float) -> np.void:
        """Strike a wall of this stiffness [N·m/rad] and damping [N·m·s/rad]; dtype MEASURES."""
        return self.on_all(np.array([[stiffness, damping]]))[0]

    def on_all(self, walls: Array) -> NDArray[np.void]:
        """Strike several walls.

        Args:
            walls: Stiffness [N·m/rad] and damping [N·m·s/rad] of each wall, shape (n, 2).

        Returns:
            Measures of each strike, shape (n,), dtype MEASURES.

        Raises:
            RunFailedError: If the law raises, or returns no finite number.
        """
        measures = np.zeros(len(walls), MEASURES)
        if self._by_frames:
            for i, (stiffness, damping) in enumerate(walls.tolist()):
                measures[i] = self._strike_over_bus(stiffness, damping)
        else:
            # One call for all that it can be for: between calls, the threads of a sweep would
            # contend for the interpreter's lock.
            for damping, some in self._bounded_alike(walls):
                self._prepare_for(damping)
                struck = measures[some]
                _strike_all(
                    self._loop,
                    self._referent,
                    AskedWall(*(values.copy() for values in self._asked)),
                    self._band,
                    self._radius,
                    self._swing_samples,
                    self._stiffest,
                    walls[some],
                    np.zeros(1, ROW),
                    struck,
                )
                measures[some] = struck
        for wall in walls[measures["trip"] == Trip.NOT_A_NUMBER][:1]:
            self._refuse_failed_law(*wall.tolist())
        return measures

    def _bounded_alike(self, walls: Array) -> list[tuple[float, NDArray[np.bool_]]]:
        """Return walls whose stiffness has one bound: on a shaft, a damping and which have it."""
        if not self._settings.mechanics.shaft_hz:
            return [(self._damping, np.ones(len(walls), bool))]
        return [(damping, walls[:, 1] == damping) for damping in np.unique(walls[:, 1]).tolist()]

    def _refuse_failed_law(self, stiffness: float, damping: float) -> NoReturn:
        """Raise RunFailedError for a law that failed on this wall: that is no limit of it."""
        self._repeat(stiffness, damping)
        law = run_laws(self._settings)[0]
        failure = law.failure(self._loop.cycle["rendered"]["wall"].reshape(1))
        raise RunFailedError(
            f"{_shown(stiffness, damping)}: cycle {self.progress}: law {law.name} "
            f"{failed_how(failure)}"
        )

    def motion(self, stiffness: float, damping: float) -> StrikeMotion:
        """Strike a wall of this stiffness [N·m/rad] and damping [N·m·s/rad], in memory."""
        self._prepare_for(damping)
        rows, measures = np.zeros(self._cycles, ROW), np.zeros(1, MEASURES)
        signals = np.empty((SIGNALS, self._cycles))
        done = simulate_wall(self._loop, stiffness, damping, rows, signals)
        judged = np.ascontiguousarray(signals[:, self._loop.enabling : done])
        trip = int(self._loop.cycle["trip"][0])
        y, felt = self._judged(stiffness, damping, judged, trip, measures)
        return StrikeMotion(rows[:done], signals[3, :done], y[:done], felt[:done], measures[0])

    def _strike_over_bus(self, stiffness: float, damping: float) -> np.void:
        wall = {"stiffness_nm_per_rad": stiffness, "damping_nm_s_per_rad": damping}
        signals, trip = signals_over_bus(
            self._settings.model_copy(update={"wall": self._settings.wall.model_copy(update=wall)})
        )
        felt = self._felt_under(signals[2], stiffness, damping)
        signals = np.concatenate([signals[:3], felt[None, :], signals[3:]])
        measures = np.zeros(1, MEASURES)
        self._judged(stiffness, damping, signals, trip, measures)
        return measures[0]

    def _judged(
        self,
        stiffness: float,
        damping: float,
        signals: Array,
        trip: int,
        measures: NDArray[np.void],
    ) -> tuple[Array, Array]:
        """Judge a strike into measures, shape (1,); return the referent's y and its felt force."""
        referent, referent_felt = np.empty(self._cycles), np.empty(self._cycles)
        asked = self._asked._replace(
            stiffness=np.full(self._cycles, min(stiffness, self._stiffest)),
            damping=np.full(self._cycles, damping),
        )
        follow_referent(self._referent, asked, referent, referent_felt)
        _judge(
            self._loop,
            self._band,
            self._radius,
            self._swing_samples,
            signals,
            trip,
            referent,
            referent_felt,
            stiffness,
            measures,
        )
        return referent, referent_felt

    def _felt_under(self, torque: Array, stiffness: float, damping: float) -> Array:
        """Return the forces on the hand, which no frame tells, under the torques of a strike.

        They are those of the loop in memory, as long as it commands the same torques; NaN after.
        """
        again = self._repeat(stiffness, damping)
        shared = min(len(torque), again.shape[1])
        differs = np.flatnonzero(torque[:shared] != again[2, :shared])
        felt = np.full(len(torque), np.nan)
        same = differs[0] if len(differs) else shared
        felt[:same] = again[3, :same]
        return felt

    def _repeat(self, stiffness: float, damping: float) -> Array:
        """Strike a wall in memory; return the signals from the end of enabling on."""
        self._prepare_for(damping)
        signals = np.empty((SIGNALS, self._cycles))
        done = simulate_wall(self._loop, stiffness, damping, np.zeros(1, ROW), signals)
        return signals[:, self._loop.enabling : done]


def _shown(stiffness: float, damping: float) -> str:
    return f"stiffness {stiffness:.6g}, damping {damping:.6g}"


@compiled
def _strike_all(
    loop: LoopRecords,
    hand: ReferentInputs,
    asked: AskedWall,
    band: FeltBand,
    radius: float,
    swing: int,
    stiffest: float,
    walls: Array,
    rows: NDArray[np.void],
    measures: NDArray[np.void],
) -> None:
    """Strike and judge every wall; rows, shape (1,) and dtype ROW, and asked are scratch memory."""
    cycles = len(loop.push)
    signals = np.empty((SIGNALS, cycles))
    referent, referent_felt = np.empty(cycles), np.empty(cycles)
    for i in range(len(walls)):
        asked.stiffness[:], asked.damping[:] = min(walls[i, 0], stiffest), walls[i, 1]
        done = simulate_wall(loop, walls[i, 0], walls[i, 1], rows, signals)
        cycle: Record = loop.cycle[0]
        follow_referent(hand, asked, referent, referent_felt)
        _judge(
            loop,
            band,
            radius,
            swing,
            signals[:, loop.enabling : done],
            cycle.trip,
            referent,
            referent_felt,
            walls[i, 0],
            measures[i : i + 1],
        )


@compiled
def _judge(
    loop: LoopRecords,
    band: FeltBand,
    radius: float,
    swing: int,
    signals: Array,
    trip: int,
    referent: Array,
    referent_felt: Array,
    stiffness: float,
    measures: NDArray[np.void],
) -> None:
    """Judge one strike into measures, shape (1,).

    signals, shape (SIGNALS, n), are those of `simulate_loop` from the end of enabling on.
    """
    cycle: Record = loop.cycle[0]
    rendered = slice(loop.enabling, loop.enabling + signals.shape[1])
    measure_strike(
        signals[0],
        signals[1],
        signals[2],
        trip,
        trip != 0
        and keeps_limits(
            cycle.rendered[0].position + cycle.orientation * referent,
            (cycle.position_low, cycle.position_high),
            cycle.speed_limit,
            cycle.period,
        ),
        cycle.guard[0].alarms,
        signals[3],
        signals[4:],
        referent[rendered],
        referent_felt[rendered],
        cycle.period,
        band,
        radius,
        cycle.rad_per_count,
        cycle.nm_per_mille,
        stiffness,
        swing,
        measures,
    )


def signals_over_bus(settings: Settings) -> tuple[Array, int]:
    """Render the wall of a strike by frames, on an embedded bus.

    Returns:
        The signals of `simulate_loop` from the end of enabling on, without the force on the hand,
        shape (SIGNALS - 1, n), and the trip.

    Raises:
        RunFailedError: If the law does not return.
    """
    # Each thread has a bus: others may strike at the same time.
    channel = f"{settings.bus.channel}-{threading.get_ident()}"
    bus = settings.bus.model_copy(update={"interface": "virtual", "channel": channel})
    settings = settings.model_copy(update={"bus": bus})
    laws = run_laws(settings)
    ring = Ring.create()
    pieces: list[NDArray[np.void]] = []

    def collect(now_s: float) -> None:
        pieces.append(ring.take_rows())
        ring.take_frames()

    try:
        with on_the_bus(settings) as link:
            axis = make_axis(link, settings, drive_dictionary(settings), laws, ring)
            left_behind = len(given_up)
            outcome = render(make_exchange(link, [axis]), lambda: False, collect)
            if len(given_up) > left_behind:
                shown = _shown(
                    settings.wall.stiffness_nm_per_rad, settings.wall.damping_nm_s_per_rad
                )
                raise RunFailedError(f"{shown}: {'; '.join(outcome.trips)}")
        collect(0.0)
    finally:
        ring.close()
    rows = np.concatenate(pieces)
    rows = rows[rows["phase"] == Phase.RENDERING]
    names = ("y", "force_applied", "torque_cmd", "stiffness_in_force", "mass_est")
    return np.array([rows[name] for name in names]), int(axis.cycle["trip"][0])
