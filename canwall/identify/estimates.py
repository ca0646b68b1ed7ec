"""Results of an identification: estimates with their intervals, and a servo made of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canwall.errors import RunFailedError

Array = NDArray[np.float64]

#: Parts of a record whose errors count as independent, and the factor from a standard error to half
#: a 95 % interval: Student's t with one degree of freedom fewer.
PARTS, T_95 = 16, 2.131


def covariance_by_parts(bread: NDArray[np.floating[Any]], scores: Array) -> Array:
    """Return the covariance of a least-squares fit whose errors are correlated within parts.

    The cluster-robust estimate, bread · Σ sₖ·sₖᵀ · bread, with sₖ the sum of a part's scores.

    Args:
        bread: Inverse of JᵀJ, shape (n, n).
        scores: Products Jᵀ·residual of some samples each, in the order of time, shape (m, n).

    Returns:
        Covariance, shape (n, n).
    """
    sums = np.stack([part.sum(axis=0) for part in np.array_split(scores, PARTS)])
    covariance: Array = bread @ (sums.T @ sums) @ bread * (PARTS / (PARTS - 1.0))
    return covariance


class UntellingDataError(RunFailedError):
    """Data that do not tell what was asked; the text gives the reason."""


@dataclass(frozen=True)
class Estimate:
    """A value and half of its 95 % interval."""

    value: float
    half: float

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half

    def contains(self, value: float) -> bool:
        """Return True for a value inside the interval."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Residuals:
    """Rest of the measured positions, without what the model explains.

    Attributes:
        rms: Root of their mean square [encoder steps]; 0.29 is that of quantisation alone.
        explained: Share of the motion in the pieces that the model explains.
        correlation: Autocorrelation at lags 1, 2, …, shape (5,); zero for white residuals.
        left_out: Share of the pieces that were left out as outliers.
    """

    rms: float
    explained: float
    correlation: Array
    left_out: float

    @property
    def white(self) -> bool:
        """True if the residuals have hardly any correlation."""
        return bool(np.abs(self.correlation).max() < 0.2)


@dataclass(frozen=True)
class Shaft:
    """Resonance of the shaft as the motor shows it: frequency [Hz], damping ratio, load/rotor."""

    hz: Estimate
    damping_ratio: Estimate
    ratio: Estimate


@dataclass(frozen=True)
class ServoFit:
    """A servo in SI units; torques are the commanded ones.

    Attributes:
        inertia: Of all that moves [kg·m²].
        viscous: Viscous friction [N·m·s/rad].
        forward: Coulomb friction, with any constant torque, of motion towards larger positions.
        backward: The same towards smaller ones.
        coulomb: Coulomb friction without the constant torque: mean of both.
        delay: Pure delay from sample to torque [periods], the drive's own cycle included.
        lag: Time constant of the current loop [s].
        total: Delay and lag together [periods].
        shaft: Resonance; None for a shaft that looks rigid.
        cogging: Map of the cogging torque, shape (2, n): position [rad] and torque [N·m].
        residuals: What is left.
        shown: A stretch of the motion, shape (3, n): time [s], measured and model [rad].
    """

    inertia: Estimate
    viscous: Estimate
    forward: Estimate
    backward: Estimate
    coulomb: Estimate
    delay: Estimate
    lag: Estimate
    total: Estimate
    shaft: Shaft | None
    cogging: Array
    residuals: Residuals
    shown: Array
