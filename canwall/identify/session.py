"""Identification of a servo on its bus: excitation, record, fit, report."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canwall.config import ConfigError, Settings
from canwall.cycle import ExperimentError, WallAxis, torques_in_force
from canwall.identify.break_away import break_away
from canwall.identify.estimates import Estimate, ServoFit, UntellingDataError
from canwall.identify.excitation import SLOWEST_SYNC_S, Excitation, HandExcitation
from canwall.identify.fit import fit_servo
from canwall.identify.hand import HandFit, fit_hand
from canwall.identify.pieces import encoder_step
from canwall.run import RunResult, run

Array = NDArray[np.float64]

#: Ramps in which the handle has to break loose.
_FEWEST_RAMPS = 4


@dataclass(frozen=True)
class Measured:
    """Notes of the cycle, one value per SYNC.

    Attributes:
        position: Positions [rad], NaN where a TPDO was missing.
        torque: Commanded torques [N·m].
        torque_actual: 0x6077 [N·m]; the commanded torque where the drive has none.
        counts: Positions [counts].
        period: SYNC period [s].
        step: Step of the encoder [rad].
    """

    position: Array
    torque: Array
    torque_actual: Array
    counts: NDArray[np.int64]
    period: float
    step: float


@dataclass(frozen=True)
class Identified:
    """A servo that was identified.

    Attributes:
        result: The run and its folder.
        measured: Positions and torques; None if it was stopped or tripped.
        servo: The fit; None if it was stopped, or with a hand on the handle.
        stiction: Torque that holds the handle at rest [N·m]; None if it hardly broke loose.
        hand: The operator, if he held the handle.
    """

    result: RunResult
    measured: Measured | None = None
    servo: ServoFit | None = None
    stiction: Estimate | None = None
    hand: HandFit | None = None


class Identification:
    """The excitation as an experiment on one axis."""

    def __init__(self, axis: WallAxis, excitation: Excitation | HandExcitation) -> None:
        self._axis, self._excitation = axis, excitation
        self._position = 0.0
        self._rows: list[tuple[float, float, float, int]] = []
        #: Periods since the last TPDO, and SYNCs left out so far.
        self._periods, self._skipped = 1, int(axis.cycle["skipped_sync"][0])

    def excite(self) -> bool:
        """Set the torque of the next cycle; return False at the end."""
        axis = self._axis
        row = axis.row[0]
        periods = 0
        if row["received"]:
            self._position = float(row["position_rad"])
            periods, self._periods = self._periods, 0
        try:
            torque = self._excitation.next(self._position, periods)
        except UntellingDataError as error:
            raise ExperimentError(axis, str(error)) from None
        nm_per_mille = float(axis.cycle["nm_per_mille"][0])
        axis.cycle["test_per_mille"] = 0 if torque is None else round(torque / nm_per_mille)
        return torque is not None

    def note(self) -> None:
        """Note position and torques of the last cycle."""
        row = self._axis.row[0]
        left_out = int(self._axis.cycle["skipped_sync"][0]) - self._skipped
        self._skipped += left_out
        self._periods += 1 + left_out
        if left_out and self._rows:
            self._stand_still(left_out)
        position = float(row["position_rad"]) if row["received"] else np.nan
        self._rows.append(
            (position, float(row["torque_cmd"]), float(row["torque_actual"]), int(row["counts"]))
        )

    def _stand_still(self, cycles: int) -> None:
        """Insert SYNCs that the master left out."""
        commanded = [row[1] for row in self._rows[-2:]]
        first, *others = torques_in_force(commanded, cycles, self._axis.setup.synchronous)
        position, _, actual, counts = self._rows[-1]
        self._rows[-1] = (position, first, actual, counts)
        self._rows += [(np.nan, torque, actual, counts) for torque in others]

    def conclude(self) -> None:
        """Leave the fit to the time when the drive is disabled."""

    def measured(self) -> Measured:
        """Return what was noted. Raises UntellingDataError if the encoder did not move."""
        columns = list(zip(*self._rows, strict=True)) or [(), (), (), ()]
        position, torque, actual = (np.array(column, float) for column in columns[:3])
        counts = np.array(columns[3], np.int64)
        if len(counts) < 2 or not np.any(np.diff(counts)):
            raise UntellingDataError(
                "the position did not change by a single count: let the handle go, allow more "
                "torque (limits.torque_nm), or look to the encoder"
            )
        axis = self._axis
        step = encoder_step(counts) * float(axis.cycle["rad_per_count"][0])
        return Measured(position, torque, actual, counts, axis.settings.bus.cycle_s, step)


def identify(
    settings: Settings,
    output: Path | None,
    with_hand: bool = False,
    report: Callable[[str], None] = lambda what: None,
    progress: Callable[[float, float | None], None] = lambda now_s, end_s: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Identified:
    """Excite the servo of a configuration and fit it (`canwall identify`).

    Args:
        settings: Configuration of the bench; its `[mechanics]` need to be right only roughly.
        output: Folder of the record; None: a new folder below `runs`.
        with_hand: An operator holds the handle, and he is what is identified; `[mechanics]` are
            those of the free handle.
        report: Called with each step.
        progress: Called with the bus time done and its end [s].
        stopped: Asked whether to end, in addition to signals.

    Raises:
        UntellingDataError: If the data do not tell.
        ConfigError: For a SYNC too slow for it, or a hand to be found with an unknown delay.
        Exception: What `run` raises.
    """
    _refuse(settings, with_hand)
    made: list[Identification] = []

    def experiment(axis: WallAxis) -> Identification:
        kind = HandExcitation if with_hand else Excitation
        excitation = kind(axis.settings, axis.setup.torque_limit_nm)
        made.append(Identification(axis, excitation))
        return made[0]

    duration_s = HandExcitation.duration_s if with_hand else Excitation.duration_s
    result = run(
        _without_wall(settings, duration_s),
        output,
        report,
        progress,
        stopped,
        experiment,
    )
    outcome = result.outcome
    if outcome.trips or outcome.interrupted:
        return Identified(result)
    measured = made[0].measured()
    report("fitting")
    if with_hand:
        hand = fit_hand(measured.position, measured.torque, measured.period, settings)
        return Identified(result, measured, hand=hand)
    servo = fit_servo(measured.position, measured.torque, measured.period, measured.step)
    return Identified(result, measured, servo, stiction(measured, servo))


def with_simulated_hand_still(settings: Settings, holding: bool) -> Settings:
    """Return settings whose simulated hand holds the handle still, or has let it go.

    Raises ConfigError if it is to hold the handle and is none.
    """
    if settings.simulation is None:
        return settings
    hand = settings.simulation.hand
    if holding and not hand.inertia_kg_m2 and not hand.stiffness_nm_per_rad:
        raise ConfigError(
            "[simulation.hand] is nobody, without inertia and stiffness: give it some, or leave "
            "--hand out"
        )
    update: dict[str, Any] = {"strikes": 0, "script": (), "random": None}
    if not holding:
        nobody = dict.fromkeys(
            ("inertia_kg_m2", "damping_nm_s_per_rad", "stiffness_nm_per_rad"), 0.0
        )
        update |= nobody | {"grip": True}
    still = hand.model_copy(update=update)
    simulation = settings.simulation.model_copy(update={"hand": still})
    return settings.model_copy(update={"simulation": simulation})


def stiction(measured: Measured, servo: ServoFit) -> Estimate | None:
    """Return the torque that holds the handle at rest, None if it hardly ever broke loose."""
    delay = servo.delay.value
    place, torque, error = break_away(
        measured.position,
        measured.torque,
        measured.period,
        measured.step,
        servo.inertia.value,
        delay,
    )
    if len(place) < _FEWEST_RAMPS:
        return None
    # Cogging helps or hinders: what holds is the rest.
    holds = np.abs(torque) - np.sign(torque) * np.interp(place, *servo.cogging)
    # A constant torque helps one way as much as it hinders the other.
    ways = [holds[torque > 0.0], holds[torque < 0.0]]
    value = float(np.mean([way.mean() for way in ways if len(way)]))
    scatter = 2.0 * float(holds.std(ddof=1)) / np.sqrt(len(holds))
    return Estimate(value, float(np.hypot(scatter, error.mean())))


def _refuse(settings: Settings, with_hand: bool) -> None:
    """Raise ConfigError for a configuration with which nothing can be identified."""
    if settings.bus.cycle_s > SLOWEST_SYNC_S:
        raise ConfigError(
            f"bus.cycle_s: has to be at most {SLOWEST_SYNC_S:g} to identify anything, "
            f"not {settings.bus.cycle_s:g}"
        )
    known = settings.drive.torque_pdo == "sync" or settings.estimator.delay_cycles is not None
    if with_hand and not known:
        raise ConfigError(
            "estimator.delay_cycles: needed for --hand where a torque acts on reception; "
            "`canwall identify` without a hand finds it"
        )


def _without_wall(settings: Settings, duration_s: float) -> Settings:
    """Return settings of a run in which the wall has no part."""
    delay = settings.estimator.delay_cycles
    estimator = {"measure_delay": False, "delay_cycles": 1.0 if delay is None else delay}
    return settings.model_copy(
        update={
            "schedule": (),
            "wall": settings.wall.model_copy(update={"alternate": ()}),
            "estimator": settings.estimator.model_copy(update=estimator),
            # The excitation puts energy in all the time.
            "limits": settings.limits.model_copy(update={"energy_j": None}),
            "run": settings.run.model_copy(update={"duration_s": duration_s}),
        }
    )
