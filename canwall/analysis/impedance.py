"""Effective impedance of a rendered wall: what the operator feels, over frequency.

G(ω) = F_h/Y of the operator's force on the position while he stays in contact (docs/results.md;
J. E. Colgate and J. M. Brown, IEEE ICRA 1994). An ideal wall with an inertia M has
G = K − M·ω² + j·ω·B.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EffectiveImpedance:
    """Effective impedance at some frequencies; all arrays of shape (n,).

    Attributes:
        frequency: Frequencies [Hz].
        impedance: G, complex [N·m/rad].
        coherence: Share of the position's power that the force explains, 0 … 1.
    """

    frequency: Array
    impedance: NDArray[np.complex128]
    coherence: Array

    @property
    def stiffness(self) -> Array:
        """K_eff = max(Re G, 0) [N·m/rad]."""
        return np.maximum(self.impedance.real, 0.0)

    @property
    def damping(self) -> Array:
        """B_eff = Im G/ω [N·m·s/rad]; negative where the wall gives off energy."""
        return np.asarray(self.impedance.imag / (2.0 * np.pi * self.frequency))

    @property
    def mass(self) -> Array:
        """M_eff = max(−Re G, 0)/ω² [kg·m²]."""
        return np.maximum(-self.impedance.real, 0.0) / (2.0 * np.pi * self.frequency) ** 2


def effective_impedance(push: Array, y: Array, cycle_s: float, segment: int) -> EffectiveImpedance:
    """Estimate G from signals in contact, averaged over segments (Welch).

    G = S_ff/S_fy: the force is the input, and what the position has of its own, as the steps of the
    encoder, averages out.

    Args:
        push: Force of the operator at each SYNC, positive out of the wall [N·m], shape (n,).
        y: Position [rad], shape (n,).
        cycle_s: Period of the SYNC [s].
        segment: Length of a segment [cycles]; the spacing of the frequencies is its inverse.

    Raises:
        ValueError: If the signals are shorter than two segments.
    """
    from scipy.signal import csd, welch

    if len(push) < 2 * segment:
        raise ValueError(f"{len(push)} cycles are less than two segments of {segment}")
    rate = 1.0 / cycle_s
    frequency, of_force = welch(push, rate, nperseg=segment)
    _, of_position = welch(y, rate, nperseg=segment)
    _, cross = csd(push, y, rate, nperseg=segment)
    coherence = np.abs(cross) ** 2 / (of_force * of_position)
    # Without the mean, which the segments do not contain.
    return EffectiveImpedance(frequency[1:], (of_force / cross)[1:], coherence[1:])


def impedance_at_lines(
    push: Array, y: Array, cycle_s: float, lines: NDArray[np.int64]
) -> EffectiveImpedance:
    """Compute G at the lines of a periodic push, as of `multisine`, over whole periods.

    Args:
        push: Force of the operator at each SYNC [N·m], shape (periods, n).
        y: Position [rad], shape (periods, n).
        cycle_s: Period of the SYNC [s].
        lines: Lines of the spectrum, in periods of the push.
    """
    force = np.fft.rfft(push, axis=1)[:, lines]
    position = np.fft.rfft(y, axis=1)[:, lines]
    mean = position.mean(axis=0)
    power = (np.abs(position) ** 2).mean(axis=0)
    frequency = lines / (push.shape[1] * cycle_s)
    coherence = np.abs(mean) ** 2 / power
    return EffectiveImpedance(frequency, force.mean(axis=0) / mean, coherence)


def multisine(lines: NDArray[np.int64], samples: int, periods: int) -> Array:
    """Return a periodic sum of cosines at these lines, scaled to a largest value of 1.

    The phases are Schroeder's, −π·i·(i − 1)/n, which keep the peaks low (M. R. Schroeder, IEEE
    Trans. Information Theory 16(1), 1970).

    Args:
        lines: Cosines per period.
        samples: Samples of one period.
        periods: Number of periods.
    """
    i = np.arange(1, len(lines) + 1)
    phases = -math.pi * i * (i - 1) / len(lines)
    t = np.arange(samples) / samples
    one = np.cos(2.0 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
    return np.tile(one / np.abs(one).max(), periods)
