"""Pieces of a record in which the handle keeps its direction, and what acts on it in them.

Integrated twice, every term of the equation of motion but the torque is a known function of the
measured positions; the response to the torque is the exact one.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.ndimage import uniform_filter1d

from canwall.compiled import compiled

Array = NDArray[np.float64]

#: Samples of a piece: long enough for friction to move many counts, short enough for the residuals
#: of forces outside the model not to add up.
PIECE = 40
#: Slowest motion whose direction counts [rad/s], and samples over which a coarse encoder tells it.
_SLOWEST, _TOGETHER = 0.1, 4


def steady_pieces(position: Array, period: float, step: float) -> tuple[NDArray[np.int64], Array]:
    """Return first samples and directions of the pieces in which the handle does not reverse.

    Args:
        position: Positions at the SYNCs [rad], NaN where one is missing.
        period: SYNC period [s].
        step: Step of the encoder [rad].
    """
    # Of a coarse encoder, the velocity over some samples, as far as it can be told from none.
    n = min(math.ceil(2.0 * step / (_SLOWEST * period)), _TOGETHER)
    moved = (position[n:] - position[:-n]) / n
    jolts = moved[n:] - moved[:-n]
    # Between the samples the velocity differs from the mean by less than it changes over them.
    power = uniform_filter1d(np.nan_to_num(jolts) ** 2, 2 * PIECE, mode="nearest")
    jolt = np.sqrt(np.maximum(power, 0.0))
    least = np.maximum(np.pad(jolt, (0, n), "edge"), max(2.0 * step / n, _SLOWEST * period))
    found: list[int] = []
    signs: list[float] = []
    for sign in (1.0, -1.0):
        steady = np.nan_to_num(sign * moved, nan=-1.0) > least
        edges = np.flatnonzero(np.diff(np.concatenate([[0], steady.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            # `end` moves have n positions more.
            pieces = range(int(begin), int(end) + n + 1 - PIECE, PIECE)
            found += pieces
            signs += [sign] * len(pieces)
    order = np.argsort(found)
    return np.array(found, np.int64)[order], np.array(signs)[order]


def encoder_step(counts: NDArray[np.int64]) -> int:
    """Return the greatest common divisor of all changes of the position [counts]."""
    return int(np.gcd.reduce(np.abs(np.diff(counts)))) or 1


@compiled
def _respond(first: Array, second: Array, whole: int, torque: Array, response: Array) -> None:
    """Follow a linear system whose input changes within each period.

    first and second hold Φ and Γ, side by side, of the two parts of a period; row j of `response`
    gets the position without spring, and the resonance's, at SYNC j.
    """
    order = len(first)
    x, z = np.zeros(order), np.zeros(order)
    for j in range(len(torque)):
        response[j, 0] = x[1]
        response[j, 1] = x[3]
        before = torque[j - whole - 1] if j > whole else 0.0
        after = torque[j - whole] if j >= whole else 0.0
        for i in range(order):
            z[i] = first[i, order] * before
            for k in range(order):
                z[i] += first[i, k] * x[k]
        for i in range(order):
            x[i] = second[i, order] * after
            for k in range(order):
                x[i] += second[i, k] * z[k]


def torque_response(
    torque: Array, period: float, delay: float, lag: float, hz: float, damping_ratio: float
) -> Array:
    """Return the motion of a unit inertia, and of a resonance, under commanded torques.

    Args:
        torque: Torque commanded after each SYNC [N·m], shape (n,).
        period: SYNC period [s].
        delay: From the SYNC until the torque changes [periods].
        lag: Time constant of the current loop [s].
        hz: Natural frequency of the resonance q̈ + 2ζω·q̇ + ω²·q = u.
        damping_ratio: Its ζ.

    Returns:
        Positions at the SYNCs, shape (n, 2).
    """
    omega = 2.0 * math.pi * hz
    rate = 1.0 / max(lag, 1e-4 * period)
    # States: torque, position and velocity of the inertia, and of the resonance.
    a = np.zeros((6, 6))
    a[0, 0], a[0, 5] = -rate, rate
    a[1, 2], a[2, 0] = 1.0, 1.0
    a[3, 4] = 1.0
    a[4, 0], a[4, 3], a[4, 4] = 1.0, -(omega**2), -2.0 * damping_ratio * omega
    whole = math.floor(delay)
    share = delay - whole
    first, second = (
        np.ascontiguousarray(expm(a * part * period)[:5]) for part in (share, 1.0 - share)
    )
    response = np.empty((len(torque), 2))
    _respond(first, second, whole, torque, response)
    return response


class Pieces:
    """Regressors of the pieces: integrals of what acts, without what their beginnings explain.

    `ringing` is frequency [Hz] and damping ratio of a shaft: friction that reverses makes it ring.
    `viscous` is friction of its rotor [N·m·s/rad], which drives the resonance as the torque does.
    """

    def __init__(
        self,
        position: Array,
        torque: Array,
        period: float,
        first: NDArray[np.int64],
        ringing: tuple[float, float] | None,
        viscous: float,
    ) -> None:
        self.torque, self.period = torque, period
        velocity = np.nan_to_num(np.diff(position, append=position[-1])) / period
        self._braking = viscous * velocity
        self.at = first[:, None] + np.arange(PIECE)
        self._position = position[self.at]
        time = np.arange(PIECE) * period
        of_start = [np.ones(PIECE), time]
        if ringing is not None:
            hz, damping_ratio = ringing
            rate = 2.0 * math.pi * hz * complex(-damping_ratio, math.sqrt(1.0 - damping_ratio**2))
            swing = np.exp(rate * time)
            of_start += [swing.real, swing.imag]
        explained, _ = np.linalg.qr(np.stack(of_start, axis=1))
        self._without_start = np.eye(PIECE) - explained @ explained.T
        self.free = PIECE - len(of_start)
        # Exact for an integrand that is linear between two samples.
        once = np.tril(np.ones((PIECE, PIECE))) * period
        once[:, 0] -= 0.5 * period
        once -= np.eye(PIECE) * 0.5 * period
        once[0] = 0.0
        inner = np.zeros((PIECE, PIECE))
        for i in range(1, PIECE):
            inner[i] = inner[i - 1] + period * once[i - 1]
            inner[i, i - 1] += period**2 / 3.0
            inner[i, i] += period**2 / 6.0
        self._once, self._twice = self._without_start @ once, self._without_start @ inner
        self.time = time

    def flat(self, of_pieces: Array) -> Array:
        """Return what the pieces' beginnings do not explain, one value after another."""
        return np.asarray(of_pieces @ self._without_start.T).reshape(-1)

    def measured(self) -> Array:
        """Return the measured positions, from the first one of each piece on."""
        return self.flat(self._position - self._position[:, :1])

    def velocity(self) -> Array:
        """Return the regressor of b/m."""
        return -np.asarray((self._position - self._position[:, :1]) @ self._once.T).reshape(-1)

    def friction(self, here: NDArray[np.bool_], sign: float) -> Array:
        """Return the regressor of c/m in the pieces that go one way."""
        return self.flat(np.where(here[:, None], -0.5 * sign * self.time**2, 0.0))

    def cogging(self, grid: Array) -> Array:
        """Return the regressors of a torque that is linear between the points of a grid."""
        columns = np.empty((self.at.size, len(grid)))
        spacing = grid[1] - grid[0]
        for k, point in enumerate(grid):
            hat = np.maximum(1.0 - np.abs(self._position - point) / spacing, 0.0)
            columns[:, k] = -(hat @ self._twice.T).reshape(-1)
        return columns

    def driven(self, delay: float, lag: float, hz: float, damping_ratio: float) -> Array:
        """Return the regressors of 1/m and ρ/m, shape (samples, 2)."""
        motion = torque_response(self.torque, self.period, delay, lag, hz, damping_ratio)
        if self._braking.any():
            braked = torque_response(self._braking, self.period, 0.0, 0.0, hz, damping_ratio)
            motion[:, 1] -= braked[:, 1]
        motion = motion[self.at]
        return np.stack([self.flat(motion[:, :, k] - motion[:, :1, k]) for k in (0, 1)], axis=1)
