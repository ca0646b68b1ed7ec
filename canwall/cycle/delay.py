"""Measurement of the delay D of the loop, from the sample of a position to its torque.

Drives do not report it. Pairs of small opposite torques of random sign excite the motor; D, mass,
friction and spring are fitted so that the exact motion under these torques comes closest to the
measured one. Positions are compared after subtraction of their moving average, which removes the
slow motion of a hand. What a hand does faster than that shows in the residuals, and in two
measurements that differ; then nothing is concluded.

A law pays for too little delay in its model with several times the stiffness that too much costs
(docs/laws.md): the upper end of the 95 % interval is what the axis gets.
"""

import math
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares

from canwall.compiled import Record, compiled
from canwall.config import Mechanics
from canwall.cycle.axis import WallAxis
from canwall.cycle.experiment import ExperimentError, torques_in_force
from canwall.cycle.state import set_delay
from canwall.physics import advance, make_plant
from canwall.walls import MAX_DELAY

Array = NDArray[np.float64]

#: The torques are random but the same in every run.
_SEED = 402
#: Share of the motion that the model has to explain for a delay to be accepted.
_EXPLAINED = 0.8
#: Parts of a measurement whose errors count as independent, and Student's t for 95 %.
_BLOCKS, _T_95 = 8, 2.365
#: Largest half of the interval, and difference of two measurements beyond their intervals
#: [periods].
_UNCERTAIN, _DIFFERENCE = 0.1, 0.02
#: Share of what a fit leaves unexplained below which the same from there on shows that it stopped.
_STOPPED = 0.1
#: Initial values of the delay in the fit [periods].
_GUESSES = np.arange(0.0, MAX_DELAY + 0.1, 0.5)
#: Travel of the handle under a pair of torques [rad]: many counts, yet hardly felt by a hand.
_TRAVEL_RAD = 0.01
#: Longest torque, and length of the moving average [cycles].
_LONGEST, _AVERAGED = 8, 33


@dataclass(frozen=True)
class Delay:
    """A measured delay D and half of its 95 % interval [periods]."""

    value: float
    half: float


class DelayTest:
    """Excitation of one axis, and its response, repeated after a rest."""

    def __init__(self, axis: WallAxis) -> None:
        settings = axis.settings
        self.axis = axis
        cycles = settings.estimator.measure_cycles
        torque = min(settings.estimator.measure_torque_nm, settings.limits.torque_nm)
        # A torque f for n periods, then -f for n periods, moves the handle by f·(nT)²/m.
        farthest = _TRAVEL_RAD * settings.mechanics.inertia_kg_m2 / settings.bus.cycle_s**2
        length = min(max(1, math.floor(math.sqrt(farthest / torque))), _LONGEST)
        per_mille = min(torque, farthest) / float(axis.cycle["nm_per_mille"][0])
        amplitude = max(1, math.floor(per_mille))
        self._parts = settings.estimator.measurements
        # None of its torques is in flight any more when the wall begins.
        self.cycles = self._parts[-1].stop + MAX_DELAY + 1
        self._torques = np.zeros(self.cycles, np.int64)
        for k, part in enumerate(self._parts):
            self._torques[part] = amplitude * excitation(cycles, length, _SEED + k)
        self._positions: list[float] = []
        self._forces: list[float] = []
        self._skipped = int(axis.cycle["skipped_sync"][0])
        self._fit: Future[Delay] | None = None
        if settings.real_time:
            self._thread = ThreadPoolExecutor(1)
            # The first fit takes several times as long, and a drive's watchdog may not wait for it.
            unit, push = Mechanics(inertia_kg_m2=1.0), np.ones(_LONGEST)
            motion = _motion(_scales(1.0, unit, 1.0), 0.0, push, 1.0)
            measured_delay(motion, push, 1.0, unit)

    def excite(self) -> bool:
        """Set the torque of the next cycle; return False at the end.

        SYNCs with zero torque go on during the fit if the drive's watchdog goes by the clock.
        """
        k = len(self._positions)
        self.axis.cycle["test_per_mille"] = self._torques[k] if k < self.cycles else 0
        if k < self.cycles or not self.axis.settings.real_time:
            return k < self.cycles
        if self._fit is None:
            self._fit = self._thread.submit(self._prepared)
            self._thread.shutdown(wait=False)
        return not self._fit.done()

    def note(self) -> None:
        """Store position and torque of the last cycle."""
        left_out = int(self.axis.cycle["skipped_sync"][0]) - self._skipped
        self._skipped += left_out
        if len(self._positions) >= self.cycles:
            return
        if left_out and self._forces:
            synchronous = self.axis.setup.synchronous
            self._forces[-1:] = torques_in_force(self._forces, left_out, synchronous)
            self._positions += [math.nan] * left_out
        row = self.axis.row[0]
        self._positions.append(float(row["position_rad"]) if row["received"] else math.nan)
        self._forces.append(float(row["torque_cmd"]))

    def conclude(self) -> None:
        """Set D of the axis, at the upper end of its interval. Raises ExperimentError."""
        axis = self.axis
        try:
            delay = self._fit.result() if self._fit else self.measured()
        except ValueError as error:
            raise ExperimentError(axis, f"{error}{self._strike()}") from None
        axis.delay = _upper_end(delay)
        set_delay(axis.cycle, axis.settings, axis.delay)

    def _strike(self) -> str:
        """Say that a simulated hand has struck before the end of the measurement; else empty."""
        settings = self.axis.settings
        hand = settings.simulation and settings.simulation.hand
        if not hand or not hand.strikes or hand.script or hand.random:
            return ""
        if hand.first_strike_s > int(self.axis.cycle["j"][0]) * settings.bus.cycle_s:
            return ""
        return (
            f"; the simulated hand struck meanwhile, at {hand.first_strike_s:g} s: without "
            f"simulation.hand.first_strike_s it waits for the measurement"
        )

    def _prepared(self) -> Delay:
        """Return D, with the gains for it computed and kept.

        They take a tenth of a second, and most of one on an elastic shaft.
        """
        delay = self.measured()
        set_delay(self.axis.cycle.copy(), self.axis.settings, _upper_end(delay))
        return delay

    def measured(self) -> Delay:
        """Return D. Raises ValueError if the motion does not tell it."""
        settings = self.axis.settings
        position, force = np.array(self._positions), np.array(self._forces)
        period = settings.bus.cycle_s
        found = [
            measured_delay(position[part], force[part], period, settings.mechanics)
            for part in self._parts
        ]
        return agreed_delay(found)


def _upper_end(delay: Delay) -> float:
    return min(delay.value + delay.half, float(MAX_DELAY))


def agreed_delay(found: Sequence[Delay]) -> Delay:
    """Return the mean of delays that agree. Raises ValueError if they do not."""
    values = [delay.value for delay in found]
    apart = max(values) - min(values)
    if apart > sum(delay.half for delay in found) + _DIFFERENCE:
        shown = " and ".join(f"{value:.3f}" for value in values)
        raise ValueError(
            f"the delay cannot be measured: {shown} cycles were found one after the other; let "
            f"the handle go, or set estimator.delay_cycles"
        )
    half = math.sqrt(sum(delay.half**2 for delay in found)) / len(found)
    return Delay(sum(values) / len(values), max(half, 0.5 * apart))


def excitation(cycles: int, length: int, seed: int = _SEED) -> NDArray[np.int64]:
    """Return signs of the torque, shape (cycles,), in pairs that leave the handle at rest.

    Each torque of a pair lasts for `length` cycles. Before some of the pairs there is a cycle
    without torque: otherwise a drive whose own cycle goes 2½ times into that of the SYNC would take
    over all torques at the same phase, and the delay would be that of this phase.
    """
    draw = np.random.default_rng(seed)
    signs = draw.choice([-1, 1], size=cycles // (2 * length + 1))
    pairs = np.stack([signs, -signs], axis=1).reshape(-1).repeat(length)
    pauses = 2 * length * np.flatnonzero(draw.integers(2, size=len(signs)))
    pairs = np.insert(pairs, pauses, 0)
    return np.concatenate([pairs, np.zeros(cycles - len(pairs))]).astype(np.int64)


def measured_delay(position: Array, torque: Array, period: float, mechanics: Mechanics) -> Delay:
    """Return D from positions [rad] at each SYNC and torques [N·m] commanded after it.

    Both have shape (n,); a missing position is NaN. The fit starts from `mechanics`, at rest in the
    first position. Raises ValueError if the torques do not explain the motion.
    """
    known = np.isfinite(position)
    j = np.arange(len(position))
    start = float(position[known][0]) if known.any() else 0.0
    size = _rms(_fast(np.interp(j, j[known], position[known]))) if known.any() else 0.0
    scales = _scales(period, mechanics, float(np.abs(torque).max(initial=0.0)))

    def misses(parameters: Array) -> Array:
        miss = _motion(parameters * scales, start, torque, period) - position
        return _fast(np.interp(j, j[known], miss[known])) / size

    if size > 0.0:
        guesses = [np.array([1.0, 1.0, 0.0, 0.1, 0.0, delay]) for delay in _GUESSES]
        guess = min(guesses, key=lambda parameters: float(np.sum(misses(parameters) ** 2)))
        low = np.array([1e-3, 0.0, 0.0, 0.0, -1.0, 0.0])
        high = np.array([1e3, 1e3, 1e3, 1.0, 1.0, float(MAX_DELAY)])

        def fitted(x: Array, friction: float) -> Any:
            x = np.clip(np.where(np.arange(6) == 3, friction, x), low + 1e-6, high - 1e-6)
            return least_squares(misses, x, bounds=(low, high), x_scale=0.1)

        # A handle that sticks makes minima of its own: from some friction, and from none.
        fit = min(fitted(guess, guess[3]), fitted(guess, 0.0), key=lambda fit: float(fit.cost))
        if _rms(fit.fun) ** 2 < 1.0 - _EXPLAINED:
            # It may have stopped where sticking begins. Of a disturbed motion nothing tells more.
            further = fitted(fit.x, 0.0)
            if further.cost < _STOPPED * fit.cost:
                fit = further
            delay = Delay(float(fit.x[-1]), _half_interval(np.asarray(fit.jac), fit.fun))
            if delay.half <= _UNCERTAIN:
                return delay
            raise ValueError(
                f"the delay cannot be measured: {delay.value:.2f} ± {delay.half:.2f} cycles are "
                f"too uncertain; let the handle go, give more estimator.measure_torque_nm, or "
                f"set estimator.delay_cycles"
            )
    raise ValueError(
        "the delay cannot be measured: the handle does not follow small torques; let it go, "
        "give more estimator.measure_torque_nm, or set estimator.delay_cycles"
    )


def _half_interval(slopes: Array, left: Array) -> float:
    """Return half of the 95 % interval of the last parameter.

    Residuals may be correlated in any way within each of _BLOCKS parts (a cluster-robust estimate,
    Liang and Zeger 1986).
    """
    # A parameter at its bound is not uncertain.
    free = np.linalg.norm(slopes, axis=0) > 0.0
    free[-1] = True
    slopes = slopes[:, free]
    inverse = np.linalg.pinv(slopes)[-1]
    parts = np.array([part.sum() for part in np.array_split(inverse * left, _BLOCKS)])
    return _T_95 * math.sqrt(float(np.sum(parts**2)) * _BLOCKS / (_BLOCKS - 1.0))


def _fast(signal: Array) -> Array:
    """Return a signal minus its moving average."""
    return np.asarray(signal - uniform_filter1d(signal, _AVERAGED, mode="nearest"))


def _rms(signal: Array) -> float:
    return float(np.sqrt(np.mean(signal**2)))


def _scales(period: float, mechanics: Mechanics, torque: float) -> Array:
    """Return the units of mass, viscous friction, spring, Coulomb friction, bias and delay."""
    mass = mechanics.inertia_kg_m2
    viscous = max(mechanics.viscous_nm_s_per_rad, 1e-3 * mass / period)
    spring = 0.01 * mass / period**2
    return np.array([mass, viscous, spring, torque, torque, 1.0])


def _motion(parameters: Array, start: float, torque: Array, period: float) -> Array:
    mass, viscous, spring, coulomb, bias, delay = parameters
    whole = min(math.floor(delay), MAX_DELAY)
    held = np.concatenate([np.zeros(whole + 1), torque]) + bias + spring * start
    position = np.empty(len(torque))
    plant = make_plant(mass, viscous, spring, coulomb)
    _follow(plant, start, held, (delay - whole) * period, period, position)
    return position


@compiled
def _follow(
    plants: NDArray[np.void], start: float, held: Array, late: float, period: float, position: Array
) -> None:
    """Compute positions at each SYNC under forces that change `late` after it."""
    plant: Record = plants[0]
    y, v = start, 0.0
    for j in range(len(position)):
        position[j] = y
        y, v, _ = advance(plant, y, v, held[j], 0.0, late)
        y, v, _ = advance(plant, y, v, held[j + 1], 0.0, period - late)
