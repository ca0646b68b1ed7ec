"""Delay from a sample to its torque, as the record of a wall shows it.

A torque that always takes effect a cycle late (an RPDO that misses its SYNC) is in no frame. It is
in the motion: for a mass m the second difference of the positions over s periods is
y[j+s] − 2y[j] + y[j−s] = (sT)²/m·Σ β_k(D)·u[j−k], with weights β that follow from the delay D. It
is the one that leaves the least squares; mass, damping and spring of handle and hand are fitted
with it, and the difference to the same s periods before leaves out what pulls slowly. The longer s,
the less the counts of the encoder matter, and the more the hand does: the first s is taken for
which the torques explain what damping and spring leave of the motion.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Spacings s of the differences [periods], and the share that the torques have to explain.
_SPACINGS, _EXPLAINED = (1, 2, 4, 8), 0.9
#: Latest cycles with a torque that are looked at, and the fewest that tell anything.
_MOST, _FEWEST = 2_000, 200
#: Delays that are compared [periods].
_DELAYS = np.arange(0.0, 4.01, 0.05)
#: Parts of the record that count as independent, and Student's t for 95 %.
_PARTS, _T_95 = 10, 2.262


def delay_in_record(position: Array, torque: Array) -> tuple[float, float] | None:
    """Return D and half of its 95 % interval in periods, None if the motion does not tell it.

    Args:
        position: Positions at the SYNCs [rad], NaN where a TPDO was missing, shape (n,).
        torque: Torques commanded after them [N·m], shape (n,).
    """
    for spacing in _SPACINGS:
        lags = np.arange(1 - spacing, spacing + 5)
        data = _regression(position, torque, spacing, lags)
        if len(data) < _FEWEST:
            continue
        weights = [_weights(delay, spacing, lags) for delay in _DELAYS]
        moments = np.array([part.T @ part for part in np.array_split(data, _PARTS)])
        whole = moments.sum(axis=0)
        delay, explained = _best_delay(whole, weights)
        if explained < _EXPLAINED:
            continue
        others = np.array([_best_delay(whole - part, weights)[0] for part in moments])
        spread = np.sqrt((_PARTS - 1) / _PARTS * np.sum((others - others.mean()) ** 2))
        return delay, _T_95 * float(spread)
    return None


def _regression(position: Array, torque: Array, spacing: int, lags: NDArray[np.int64]) -> Array:
    """Return what is explained (first column) and by what: torques, damping, spring.

    Only the latest cycles, of those in which one of these torques has changed; shape (n, k + 3).
    """
    y, u, s = position, torque, spacing
    j = np.arange(int(lags[-1]) + 2 * s, len(y) - s)
    changes = np.stack([u[j - k] - u[j - k - s] for k in lags], axis=1)
    bends = (y[j + s] - 2.0 * y[j] + y[j - s]) - (y[j] - 2.0 * y[j - s] + y[j - 2 * s])
    speeds = (y[j] - y[j - s]) - (y[j - s] - y[j - 2 * s])
    data = np.column_stack([bends, changes, speeds, y[j] - y[j - s]])
    known = np.isfinite(data).all(axis=1) & np.any(changes != 0.0, axis=1)
    return np.asarray(data[known][-_MOST:])


def _weights(delay: float, spacing: int, lags: NDArray[np.int64]) -> Array:
    """Return β_k(D): the area, under u[j−k], of the triangle from s periods before to s after."""
    begin = (delay - lags) / spacing
    return np.asarray(_area(begin + 1.0 / spacing) - _area(begin))


def _area(end: Array) -> Array:
    """Return the area of the triangle on [−1, 1] up to an abscissa."""
    x = np.clip(end, -1.0, 1.0)
    return np.where(x < 0.0, 0.5 * (1.0 + x) ** 2, 1.0 - 0.5 * (1.0 - x) ** 2)


def _best_delay(moments: Array, weights: list[Array]) -> tuple[float, float]:
    """Return the delay whose torques explain the most, and their share of what is left to explain.

    The steps of a position that a drive latches at ticks of its own look like damping, which leaves
    hardly anything of them. The delay lies between the compared ones, by a parabola; at their ends
    there is none, which explains nothing.
    """
    explained = np.array([_explained(moments, each) for each in weights])
    k = int(np.argmax(explained))
    if k in (0, len(_DELAYS) - 1):
        return float(_DELAYS[k]), 0.0
    before, best, after = explained[k - 1 : k + 2]
    shift = 0.5 * (before - after) / (before - 2.0 * best + after)
    right = moments[-2:, 0]
    by_others = right @ np.linalg.lstsq(moments[-2:, -2:], right, rcond=None)[0]
    share = (best - by_others) / (moments[0, 0] - by_others)
    return float(_DELAYS[k] + shift * (_DELAYS[1] - _DELAYS[0])), float(share)


def _explained(moments: Array, weights: Array) -> float:
    """Return the sum of squares that a regression explains; 0 where the torque pulls backwards."""
    chosen = np.zeros((len(moments), 3))
    chosen[1 : 1 + len(weights), 0] = weights
    chosen[-2, 1] = chosen[-1, 2] = 1.0
    right = chosen.T @ moments[:, 0]
    found = np.linalg.lstsq(chosen.T @ moments @ chosen, right, rcond=None)[0]
    return float(found @ right) if found[0] > 0.0 else 0.0
