"""Answers of a person as shares with their uncertainty, and the psychometric function of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Slope for a standard deviation of the ratios' logarithms that no person shows: its standard
#: error is sqrt(π/(2n)), 0.04 after 1000 trials.
_FLAT = 0.01
#: Quantile of the normal distribution at 75 %, half way between chance and certainty.
_Z_75 = 0.6744897501960817


class Share(NamedTuple):
    """Share of the trials in which a wall was chosen.

    Attributes:
        chosen: Trials in which it was.
        trials: All trials.
        share: Their ratio.
        low: Lower end of the 95 % interval of Wilson.
        high: Its upper end.
        p: Probability of a share as far from a half, or farther, by chance.
    """

    chosen: int
    trials: int
    share: float
    low: float
    high: float
    p: float


def share_of(chosen: int, trials: int) -> Share:
    """Return a share; `trials` is greater than 0."""
    from scipy.stats import binomtest

    test = binomtest(chosen, trials)
    interval = test.proportion_ci(0.95, method="wilson")
    low, high = float(interval.low), float(interval.high)
    return Share(chosen, trials, chosen / trials, low, high, float(test.pvalue))


class Psychometric(NamedTuple):
    """Cumulative normal distribution over the logarithm of a ratio.

    Attributes:
        equal: Ratio at which the wall is chosen in half of the trials.
        noticed: Factor from there to the ratio of 75 %; below 1 if larger ratios are chosen less.
    """

    equal: float
    noticed: float


def fit_psychometric(
    ratios: Sequence[float], chosen: Sequence[int], trials: Sequence[int]
) -> Psychometric | None:
    """Return the psychometric function of greatest likelihood.

    Args:
        ratios: Ratio of each wall to the reference, greater than 0, shape (n,).
        chosen: Trials in which it was chosen, shape (n,).
        trials: All its trials, shape (n,).

    Returns:
        The function; None if there is none, because the answers do not overlap (all ratios that
        were chosen are above or below all that were not), or do not depend on the ratio.
    """
    from scipy.optimize import minimize
    from scipy.special import log_ndtr

    x, yes = np.log(np.asarray(ratios, float)), np.asarray(chosen, float)
    no = np.asarray(trials, float) - yes
    # Albert and Anderson (1984): otherwise the likelihood grows without bound.
    if not (yes.any() and no.any()):
        return None
    if x[yes > 0].min() >= x[no > 0].max() or x[no > 0].min() >= x[yes > 0].max():
        return None
    centre, width = x.mean(), x.std()
    z = (x - centre) / width

    def unlikelihood(line: NDArray[np.float64]) -> float:
        at = line[0] + line[1] * z
        return -float(np.sum(yes * log_ndtr(at) + no * log_ndtr(-at)))

    offset, slope = minimize(unlikelihood, np.zeros(2), method="BFGS", tol=1e-9).x
    if abs(slope) < _FLAT:
        return None
    equal = centre - width * offset / slope
    return Psychometric(float(np.exp(equal)), float(np.exp(_Z_75 * width / slope)))
