"""The delay D of the loop, measured: from the sampling of a position to its torque taking effect.

A drive does not say it. So the motor is shaken by small torques in pairs, one way and back, of
random sign, and D is found in how the position follows: for a torque held over one period and
delayed by D = n + δ periods, the second difference of the position is, but for friction,

    y[j+1] − 2·y[j] + y[j−1] = T²/(2m) · Σᵢ cᵢ(δ) · u[j−n−i],
    c = ((1−δ)², 1 + 2δ − 2δ², δ²)

which is the zero-order hold of a mass sampled δ·T after the torque changes (theory, section 3).
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from canwall.cycle.axis import Axis
from canwall.walls import MAX_DELAY

Array = NDArray[np.float64]

#: The torques are random but the same in every run.
_SEED = 402
#: The share of the motion that the model has to explain, for a delay to be believed.
_EXPLAINED = 0.5


class DelayTest:
    """Shakes one axis and listens."""

    def __init__(self, axis: Axis) -> None:
        settings = axis.settings
        self.axis = axis
        self.cycles = settings.estimator.measure_cycles
        torque = min(settings.estimator.measure_torque_nm, settings.limits.torque_nm)
        per_mille = max(1, math.floor(torque / float(axis.cycle["nm_per_mille"][0])))
        self._torques = per_mille * excitation(self.cycles)
        self._positions: list[float] = []
        self._forces: list[float] = []

    def excite(self) -> None:
        """Set the torque of the coming cycle."""
        k = len(self._positions)
        self.axis.cycle["test_per_mille"] = self._torques[k] if k < self.cycles else 0

    def note(self) -> None:
        """Take note of the cycle that is over."""
        row = self.axis.row[0]
        self._positions.append(float(row["position_rad"]) if row["received"] else math.nan)
        self._forces.append(float(row["torque_cmd"]))

    def delay(self) -> float:
        """D in periods. Raises ValueError where the motion does not tell."""
        return measured_delay(np.array(self._positions), np.array(self._forces))


def excitation(cycles: int) -> NDArray[np.int64]:
    """Signs of the torque, shape (cycles,): pairs that give the handle no lasting speed."""
    signs = np.random.default_rng(_SEED).choice([-1, 1], size=(cycles + 1) // 2)
    pairs = np.stack([signs, -signs], axis=1)
    return np.asarray(pairs.reshape(-1)[:cycles], dtype=np.int64)


def measured_delay(position: Array, torque: Array) -> float:
    """D in periods from positions [rad] at each SYNC and the torques [N·m] commanded after it.

    Both of shape (n,). Beside inertia, the fit has viscous and Coulomb friction, a spring and a
    constant. Raises ValueError where the torques do not explain the motion.
    """

    def unexplained(delay: float) -> float:
        return _residual(position, torque, delay)

    coarse = np.arange(0.0, MAX_DELAY + 0.01, 0.25)
    best = coarse[int(np.argmin([unexplained(delay) for delay in coarse]))]
    low, high = max(0.0, best - 0.25), min(float(MAX_DELAY), best + 0.25)
    found = minimize_scalar(unexplained, bounds=(low, high), method="bounded")
    ends = {unexplained(end): end for end in (low, high)}
    delay = float(found.x) if found.fun <= min(ends) else ends[min(ends)]
    if not unexplained(delay) < 1.0 - _EXPLAINED:
        raise ValueError(
            "the delay cannot be measured: the handle does not follow small torques; let it go, "
            "give more estimator.measure_torque_nm, or set estimator.delay_cycles"
        )
    return delay


def _residual(position: Array, torque: Array, delay: float) -> float:
    """Share of the motion's variance that the best fit with this delay leaves unexplained."""
    n = min(math.floor(delay), MAX_DELAY)
    share = delay - n
    kernel = np.array([(1.0 - share) ** 2, 1.0 + 2.0 * share - 2.0 * share**2, share**2]) / 2.0
    held = np.concatenate([np.zeros(n), np.convolve(torque, kernel)])
    j = np.arange(MAX_DELAY + 3, len(position) - 1)
    acceleration = position[j + 1] - 2.0 * position[j] + position[j - 1]
    speed = position[j + 1] - position[j - 1]
    fit = np.stack([held[j], speed, np.sign(speed), position[j], np.ones(len(j))], axis=1)
    known = np.isfinite(acceleration)
    acceleration, fit = (
        acceleration[known],
        fit[known] / np.abs(fit[known]).max(axis=0).clip(1e-300),
    )
    if len(acceleration) <= fit.shape[1]:
        return 1.0
    coefficients = np.linalg.lstsq(fit, acceleration, rcond=None)[0]
    left = acceleration - fit @ coefficients
    if not coefficients[0] > 0.0:
        return 1.0
    return float(left @ left / (acceleration @ acceleration))
