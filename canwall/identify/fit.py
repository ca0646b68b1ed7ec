"""Fit of a servo to its motion: pure functions of positions and torques at the SYNCs.

The record is cut into short pieces in which the handle keeps its direction. In a piece friction is
linear,

    m·ÿ = u_δ − b·ẏ ∓ c± − g(y),

where u_δ is the torque that was commanded, held, delayed by δ and passed through the current loop,
and g the cogging. Integrated twice, every term but u_δ is a known function of the measured
positions, and position and velocity at the beginning of each piece are projected out. What remains
is linear in (1, ρ, b, c₊, c₋, g)/m and non-linear in delay, lag and the resonance of the shaft
alone, which are found by variable projection. The response to the torque is the exact one.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from canwall.identify.estimates import (
    T_95,
    Estimate,
    Residuals,
    ServoFit,
    Shaft,
    UntellingDataError,
    covariance_by_parts,
)
from canwall.identify.pieces import PIECE, Pieces, steady_pieces

Array = NDArray[np.float64]

#: Fewest pieces from which anything is concluded, and fewest in one direction.
_FEWEST, _FEWEST_ONE_WAY = 60, 15
#: Distance of two points of the cogging's map [rad], and how large an amplitude may be before the
#: fit resists, as a part of the largest torque.
_COG_GRID_RAD, _COG_PRIOR = 0.025, 0.02
#: Pieces whose residuals are this many times the median are left out: the drive's clock slips by a
#: tick of its own now and then, and nothing in the model does.
_OUTLIER = 5.0
#: Share of the residuals that a shaft has to explain, and its coefficient in standard errors.
_SHAFT_EXPLAINS, _SHAFT_SIGNIFICANCE = 0.03, 6.0
#: Share of the motion that may be neither explained nor the encoder's noise, and largest relative
#: half of the interval of the inertia.
_DISTURBED, _UNCERTAIN = 0.02, 0.1
#: Power of an encoder's noise [steps²]: that of quantisation, and as much again.
_NOISE = 2.0 / 12.0
#: Largest delay and lag together in a fit [periods].
_MOST_DELAY = 4.0
#: Errors of the model that no residual shows: of the delay [periods], of the lag (relative) and of
#: their sum [periods]; a shaft makes it harder to tell them apart.
_APART, _APART_ELASTIC = (0.008, 0.05, 0.003), (0.02, 0.12, 0.006)
#: First values of delay and lag together behind a soft shaft [periods], and how many guesses of a
#: resonance are refined.
_TOTALS: tuple[float, ...] = (0.35, 0.85, 1.35, 1.85, 2.35, 2.85)
_REFINED = 3
#: Lags over which the residuals' autocorrelation is reported.
_CORRELATED = 5


def fit_servo(position: Array, torque: Array, period: float, step: float) -> ServoFit:
    """Fit a servo to the motion of its free handle.

    Args:
        position: Positions at the SYNCs [rad], shape (n,), NaN where one is missing.
        torque: Torques commanded after each of them [N·m], shape (n,).
        period: SYNC period [s].
        step: Step of the encoder [rad].

    Raises:
        UntellingDataError: If the data do not tell.
    """
    first, sign = steady_pieces(position, period, step)
    _check_amount(first, sign)

    ringing: tuple[float, float] | None = None
    viscous = 0.0

    def fit(some: slice | NDArray[np.bool_]) -> _Fit:
        return _Fit(position, torque, period, step, first[some], sign[some], ringing, viscous)

    # A part of the pieces is enough for first values.
    part = fit(slice(None, None, 3))
    x = part.rigid()
    shaft = part.elastic(x)
    if shaft is not None:
        x, ringing = shaft, (float(shaft[2]), float(shaft[3]))
        viscous = part.viscous(x)
    whole = fit(slice(None))
    x = whole.refined(x)
    sound = whole.sound(x)
    if not sound.all():
        _check_amount(first[sound], sign[sound])
        whole = fit(sound)
        x = whole.refined(x)
    found = whole.result(x, 1.0 - float(np.mean(sound)))
    _check_told(found)
    return found


def _check_told(found: ServoFit) -> None:
    residuals, uncertain = found.residuals, found.inertia.half / found.inertia.value
    # A coarse encoder leaves much of a small motion unexplained, which nobody has disturbed.
    disturbed = (1.0 - residuals.explained) * max(0.0, 1.0 - _NOISE / residuals.rms**2)
    if disturbed > _DISTURBED or uncertain > _UNCERTAIN:
        raise UntellingDataError(
            f"a free handle does not move like this: {residuals.explained:.1%} of the motion is "
            f"explained, the residuals are {residuals.rms:.2g} steps of the encoder, "
            f"the inertia is known to {uncertain:.0%}; let it go, see that nothing pulls at it, "
            f"and that the drive does not derate its torque meanwhile"
        )


def _check_amount(first: NDArray[np.int64], sign: Array) -> None:
    ways = (int(np.sum(sign > 0.0)), int(np.sum(sign < 0.0)))
    if len(first) < _FEWEST or min(ways) < _FEWEST_ONE_WAY:
        raise UntellingDataError(
            f"the handle moved too little to tell: {ways[0]} stretches of {PIECE} cycles one way, "
            f"{ways[1]} the other; let it go, or allow more travel, speed or torque"
        )


class _Fit:
    """Variable projection over delay, lag and resonance."""

    def __init__(
        self,
        position: Array,
        torque: Array,
        period: float,
        step: float,
        first: NDArray[np.int64],
        sign: Array,
        ringing: tuple[float, float] | None,
        viscous: float,
    ) -> None:
        self._pieces = Pieces(position, torque, period, first, ringing, viscous)
        self._position, self._period, self._step = position, period, step
        self._first = first
        pieces = self._pieces
        self._measured = pieces.measured()
        seen = position[pieces.at]
        low, high = float(seen.min()), float(seen.max())
        points = max(3, math.ceil((high - low) / _COG_GRID_RAD) + 1)
        self._grid = np.linspace(low, high, points)
        cogging = pieces.cogging(self._grid)
        self._friction = np.stack(
            [
                pieces.velocity(),
                pieces.friction(sign > 0.0, 1.0),
                pieces.friction(sign < 0.0, -1.0),
            ],
            axis=1,
        )
        # Cogging far above what servos have is resisted, which also settles where its mean goes.
        rough = np.linalg.lstsq(
            np.column_stack([pieces.driven(1.0, 0.0, 0.25 / period, 0.5)[:, 0], self._friction]),
            self._measured,
            rcond=None,
        )[0]
        accelerated = _COG_PRIOR * float(np.abs(torque).max()) * max(float(rough[0]), 0.0)
        if accelerated == 0.0:
            raise UntellingDataError(
                "the handle does not follow the torques: something holds it, or the sign is wrong"
            )
        ridge = 0.3 * step / accelerated
        self._points = points
        # Cogging first, so that the leading part of the basis is that of the cogging alone.
        self._cogging = cogging
        fixed = np.vstack([cogging, ridge * np.eye(points)])
        fixed = np.column_stack([fixed, self._padded(self._friction)])
        self._basis, self._triangle = np.linalg.qr(fixed)
        self._target = self._without(self._basis, self._measured)

    def _padded(self, columns: Array) -> Array:
        """Append the rows of the cogging's prior."""
        return np.concatenate([columns, np.zeros((self._points, *columns.shape[1:]))])

    def _without(self, basis: Array, columns: Array) -> Array:
        """Return columns without what an orthonormal basis explains."""
        padded = self._padded(columns)
        return padded - basis @ (basis.T @ padded)

    def _driven(self, x: Array) -> Array:
        """Return the regressors of 1/m and, with a resonance in x, of ρ/m."""
        delay, lag, hz, ratio = self._physical(x)
        driven = self._pieces.driven(delay, lag, hz, ratio)
        return driven if len(x) > 2 else driven[:, :1]

    def _physical(self, x: Array) -> tuple[float, float, float, float]:
        """Return delay [periods], lag [s], frequency [Hz] and damping ratio."""
        total, share = float(x[0]), float(x[1])
        hz, ratio = (float(x[2]), float(x[3])) if len(x) > 2 else (0.25 / self._period, 0.5)
        return (1.0 - share) * total, share * total * self._period, hz, ratio

    def _solved(self, x: Array) -> tuple[Array, Array]:
        """Return the parameters of the driven motion, and the residuals [steps]."""
        columns = self._without(self._basis, self._driven(x))
        normal, right = columns.T @ columns, columns.T @ self._target
        linear = np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], float)
        return linear, (self._target - columns @ linear) / self._step

    def _misses(self, x: Array) -> Array:
        return self._solved(x)[1]

    def _cost(self, x: Array) -> float:
        left = self._misses(x)
        return float(left @ left)

    def refined(self, x: Array) -> Array:
        """Return the parameters that explain the motion best, from first ones."""
        low, high = np.zeros(2), np.array([_MOST_DELAY, 1.0])
        if len(x) > 2:
            low = np.array([*low, 0.9 * x[2], 1e-3])
            high = np.array([*high, 1.1 * x[2], 0.7])
        inside = np.clip(x, low + 1e-3, high - 1e-3)
        found = least_squares(
            self._misses,
            inside,
            bounds=(low, high),
            x_scale=np.maximum(np.abs(inside), 0.05),
            diff_step=[1e-4],
            xtol=1e-7,
            max_nfev=20,
        )
        return np.asarray(found.x)

    def rigid(self) -> Array:
        """Return delay plus lag [periods], and the lag's share of it, of a rigid shaft."""
        totals = np.arange(0.1, 4.1, 0.25)
        guesses = [np.array([total, min(0.1 / total, 0.5)]) for total in totals]
        best = min(guesses, key=self._cost)
        return self.refined(best)

    def sound(self, x: Array) -> NDArray[np.bool_]:
        """Return which pieces are no outliers."""
        left = self._misses(x)[: self._measured.size].reshape(-1, PIECE)
        sizes = np.sqrt(np.mean(left**2, axis=1))
        return np.asarray(sizes <= max(_OUTLIER * float(np.median(sizes)), 1.0))

    def elastic(self, rigid: Array) -> Array | None:
        """Return the parameters with a resonance, None if the shaft looks rigid."""
        nyquist = 0.5 / self._period
        before = self._cost(rigid)
        lag = min(rigid[0] * rigid[1], 0.15)
        # A soft shaft leaves nothing to a rigid fit, and its delay is no guess.
        totals = [*(max(rigid[0] - late, 0.05) for late in (0.0, 0.15)), *_TOTALS]
        frequencies = np.geomspace(0.08 * nyquist, 1.6 * nyquist, 40)
        guesses = [
            [np.array([total, min(lag / total, 1.0), hz, 0.03]) for total in totals]
            for hz in frequencies
        ]
        costs = np.array([[self._cost(guess) for guess in of_hz] for of_hz in guesses])
        if costs.min() > (1.0 - _SHAFT_EXPLAINS) * before:
            return None
        # A resonance and its image beyond the Nyquist frequency look alike on a coarse grid.
        best = [(k, int(costs[k].argmin())) for k in np.argsort(costs.min(axis=1))[:_REFINED]]
        x = min((self.refined(guesses[k][total]) for k, total in best), key=self._cost)
        linear, covariance, _ = self._everything(x)
        ratio = linear[1] / linear[0]
        significant = linear[1] > _SHAFT_SIGNIFICANCE * math.sqrt(covariance[5, 5])
        explains = self._cost(x) < (1.0 - _SHAFT_EXPLAINS) * before
        return x if ratio > 0.0 and significant and explains else None

    def _everything(self, x: Array) -> tuple[Array, Array, Array]:
        """Return linear parameters, covariance of (non-linear, linear) ones, residuals [steps].

        The linear ones are (1, ρ, b, c₊, c₋)/m, without ρ for a rigid shaft. Residuals may be
        correlated in any way within each of PARTS parts of the record, which differ in speed and
        signal (a cluster-robust estimate, Liang and Zeger 1986).
        """
        basis = self._basis[:, : self._points]
        columns = np.column_stack([self._driven(x), self._friction])
        reduced = self._without(basis, columns)
        target = self._without(basis, self._measured)
        linear = np.asarray(np.linalg.lstsq(reduced, target, rcond=None)[0], float)
        left = (target - reduced @ linear) / self._step
        slopes = []
        for i in range(len(x)):
            h = max(1e-4 * abs(x[i]), 1e-5)
            up, down = x.copy(), x.copy()
            up[i] += h
            down[i] -= h
            change = self._driven(up) - self._driven(down)
            slopes.append(self._without(basis, change @ linear[: change.shape[1]] / (2.0 * h)))
        jacobian = np.column_stack([*slopes, reduced]) / self._step
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-100)
        jacobian /= scale
        bread = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-13, hermitian=True)
        samples = self._measured.size
        scores = (jacobian[:samples] * left[:samples, None]).reshape(-1, PIECE, jacobian.shape[1])
        covariance = covariance_by_parts(bread, scores.sum(axis=1))
        return linear, covariance / np.outer(scale, scale), left[:samples]

    def viscous(self, x: Array) -> float:
        """Return the viscous friction on an elastic shaft [N·m·s/rad]."""
        linear = self._everything(x)[0]
        return max(float(linear[2] / linear[0]), 0.0)

    def result(self, x: Array, left_out: float) -> ServoFit:
        """Return the fit in physical units."""
        linear, covariance, left = self._everything(x)
        if linear[0] <= 0.0:
            raise UntellingDataError(
                "the handle accelerates against the torques: something else drives it"
            )
        everything = np.concatenate([x, linear])
        n = len(x)
        at = n + (2 if n > 2 else 1)
        cogging, constant = self._map(x, linear)

        def estimate(
            of: Callable[[Array], float], unmodelled: float, least: float = 0.0
        ) -> Estimate:
            """Return a function of the parameters; errors of the model are relative or absolute."""
            slope = np.empty(len(everything))
            for i, value in enumerate(everything):
                h = max(abs(value) * 1e-6, 1e-12)
                up, down = everything.copy(), everything.copy()
                up[i], down[i] = value + h, value - h
                slope[i] = (of(up) - of(down)) / (2.0 * h)
            value = of(everything)
            statistical = T_95 * math.sqrt(max(float(slope @ covariance @ slope), 0.0))
            return Estimate(value, math.hypot(statistical, unmodelled * value, least))

        shaft = None
        if n > 2:
            shaft = Shaft(
                estimate(lambda p: float(p[2]), 0.005),
                estimate(lambda p: float(p[3]), 0.1),
                estimate(lambda p: float(p[n + 1] / p[n]), 0.02),
            )
        force = 1e-4 * float(np.abs(self._pieces.torque).max())
        apart = _APART if shaft is None else _APART_ELASTIC
        one_way = math.hypot(force, 0.03 * float(np.ptp(cogging[1])))
        return ServoFit(
            estimate(lambda p: 1.0 / float(p[n]), 0.002),
            estimate(lambda p: float(p[at] / p[n]), 0.02),
            estimate(lambda p: float(p[at + 1] / p[n]) + constant, 0.005, one_way),
            estimate(lambda p: float(p[at + 2] / p[n]) - constant, 0.005, one_way),
            estimate(lambda p: 0.5 * float((p[at + 1] + p[at + 2]) / p[n]), 0.005, force),
            estimate(lambda p: float(p[0] * (1.0 - p[1])), 0.0, apart[0]),
            estimate(lambda p: float(p[0] * p[1]) * self._period, apart[1], 0.002 * self._period),
            estimate(lambda p: float(p[0]), 0.0, apart[2]),
            shaft,
            cogging,
            self._residuals(left, left_out),
            self._shown(left),
        )

    def _map(self, x: Array, linear: Array) -> tuple[Array, float]:
        """Return the map without its mean, and the mean, which is a constant torque [N·m]."""
        driven = self._driven(x)
        rest = self._padded(self._measured - driven @ linear[: driven.shape[1]])
        solved = np.linalg.solve(self._triangle, self._basis.T @ rest)
        torque = solved[: self._points] / linear[0]
        # What was hardly visited is not known.
        weight = np.sum(self._cogging**2, axis=0)
        known = weight > 0.2 * float(np.median(weight))
        place, torque = self._grid[known], torque[known]
        # A Hann window: the map ends within a cog.
        window = np.hanning(len(torque) + 2)[1:-1]
        mean = float(np.average(torque, weights=window))
        return np.stack([place, torque - mean]), mean

    def _residuals(self, left: Array, left_out: float) -> Residuals:
        by_piece = left.reshape(-1, PIECE)
        power = float(np.mean(left**2))
        # Degrees of freedom went into the beginnings.
        rms = math.sqrt(power * PIECE / self._pieces.free)
        correlation = np.array(
            [
                float(np.mean(by_piece[:, lag:] * by_piece[:, :-lag])) / max(power, 1e-30)
                for lag in range(1, _CORRELATED + 1)
            ]
        )
        whole = float(np.mean((self._measured / self._step) ** 2))
        return Residuals(rms, 1.0 - power / whole, correlation, left_out)

    def _shown(self, left: Array) -> Array:
        """Return the longest stretch without a gap, at most some tenths of a second."""
        follows = np.diff(self._first) == PIECE
        best = begin = 0
        longest = 0
        for k in range(len(self._first)):
            if k and not follows[k - 1]:
                begin = k
            if k - begin + 1 > longest:
                best, longest = begin, k - begin + 1
        some = slice(best, best + min(longest, 8))
        at = self._pieces.at[some].reshape(-1)
        measured = self._position[at]
        model = measured - left.reshape(-1, PIECE)[some].reshape(-1) * self._step
        return np.stack([at * self._period, measured, model])
