"""Fit of the operator who holds the handle: inertia, damping, stiffness.

The equation of motion is integrated twice over pieces of a fifth of a second,

    m·(y − y₀ − v₀·t) = ∬u − b·∫y − k·∬y − c·∬sign(ẏ) + polynomial,

where the polynomial takes the beginning and the slow wandering of the hand. The measured position
stands on the right; it is large against the encoder's step.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.config import Settings
from canwall.cycle import modelled_delay
from canwall.identify.estimates import (
    PARTS,
    T_95,
    Estimate,
    UntellingDataError,
    covariance_by_parts,
)
from canwall.identify.pieces import torque_response

Array = NDArray[np.float64]

#: Length of a piece [s], and order of its polynomial: constant, line, and the hand's drift.
_PIECE_S, _ORDER = 0.2, 3
#: Share of the motion that has to be explained.
_EXPLAINED = 0.5


@dataclass(frozen=True)
class HandFit:
    """The operator at the handle, SI units, and the share of the motion that is explained."""

    inertia: Estimate
    damping: Estimate
    stiffness: Estimate
    explained: float


def fit_hand(position: Array, torque: Array, period: float, settings: Settings) -> HandFit:
    """Fit the operator to the motion of a handle that he holds.

    Args:
        position: Positions at the SYNCs [rad], NaN where one is missing.
        torque: Torques commanded after them [N·m].
        period: SYNC period [s].
        settings: Configuration with the `[mechanics]` of the free handle.

    Raises:
        UntellingDataError: If the data do not tell.
    """
    j = np.arange(len(position))
    known = np.isfinite(position)
    y = np.interp(j, j[known], position[known])
    driven = torque_response(torque, period, modelled_delay(settings), 0.0, 1.0, 1.0)[:, 0]
    speed = np.gradient(y, period)
    friction = np.sign(speed)

    def integral(of: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(0.5 * (of[1:] + of[:-1]))]) * period

    once = integral(y)
    mechanics = settings.mechanics
    columns = np.stack([y, once, integral(once)], axis=1)
    target = driven - mechanics.coulomb_nm * integral(integral(friction))
    length = round(_PIECE_S / period)
    pieces = len(y) // length
    time = np.linspace(-1.0, 1.0, length)
    basis, _ = np.linalg.qr(np.vander(time, _ORDER + 1))
    if pieces < 2 * PARTS:
        raise UntellingDataError("the record is too short to tell who holds the handle")

    def cut(signal: Array) -> Array:
        of_pieces = signal[: pieces * length].reshape(pieces, length)
        return of_pieces - (of_pieces @ basis) @ basis.T

    x = np.stack([cut(column).reshape(-1) for column in columns.T], axis=1)
    scale = np.linalg.norm(x, axis=0)
    x /= scale
    wanted = cut(target).reshape(-1)
    solved = np.linalg.lstsq(x, wanted, rcond=None)[0]
    left = wanted - x @ solved
    explained = 1.0 - float(left @ left) / max(float(wanted @ wanted), 1e-300)
    if explained < _EXPLAINED:
        raise UntellingDataError(
            f"mass, damping and stiffness explain {explained:.0%} of the motion only: hold the "
            f"handle still and evenly, or give more estimator.measure_torque_nm"
        )
    bread = np.linalg.inv(x.T @ x)
    scores = (x * left[:, None]).reshape(pieces, length, 3).sum(axis=1)
    covariance = covariance_by_parts(bread, scores)
    values = solved / scale
    halves = T_95 * np.sqrt(np.diag(covariance)) / scale
    free = (
        mechanics.inertia_kg_m2,
        mechanics.viscous_nm_s_per_rad,
        mechanics.spring_nm_per_rad,
    )
    inertia, damping, stiffness = (
        Estimate(float(value) - part, math.hypot(half, 0.02 * float(value)))
        for value, part, half in zip(values, free, halves, strict=True)
    )
    for name, found in (("inertia", inertia), ("damping", damping), ("stiffness", stiffness)):
        # Little damping or stiffness is an operator's, no inertia is nobody's.
        if (found.low if name == "inertia" else found.high) < 0.0:
            raise UntellingDataError(
                f"the data do not tell the operator's {name}, which cannot be negative: "
                f"{found.value:.3g} [{found.low:.3g}, {found.high:.3g}]; hold the handle still, "
                f"give more estimator.measure_torque_nm, and [mechanics] of the free handle"
            )
    return HandFit(inertia, damping, stiffness, explained)
