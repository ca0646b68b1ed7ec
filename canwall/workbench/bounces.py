"""A ball's motion between its samples, and what is counted of its bounces."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from canwall.analysis import metrics
from canwall.physics import flow, zoh
from canwall.workbench.ball import CONTINUOUS, Ball, bounced

Array = NDArray[np.float64]

_NO_OPTIONS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Bounces:
    """A ball that bounced: state and held force at its samples, each of shape (periods + 1,)."""

    ball: Ball
    y: Array
    v: Array
    force: Array

    @classmethod
    def on(cls, ball: Ball, law: str, options: Mapping[str, float] = _NO_OPTIONS) -> "Bounces":
        """On a floor rendered by the law of that name. Raises UnknownLawError."""
        return cls(ball, *bounced(ball, law, options=options))

    @property
    def t(self) -> Array:
        """Times of the samples."""
        return np.arange(len(self.y), dtype=np.float64) * self.ball.period

    @cached_property
    def contacts(self) -> list[slice]:
        """The contacts that ended, as slices of samples (`metrics.contacts`).

        At the last sample the force is not known, so neither is whether one ends there.
        """
        found = metrics.contacts(self.y, self.force)
        return [c for c in found if self.y[c.stop - 1] >= 0.0 and c.stop < len(self.y)]

    @property
    def energies(self) -> Array:
        """Energy before the first contact, and in the flight after each; in J."""
        energy = self.ball.energy(self.y, self.v)
        return energy[[0, *(c.stop - 1 for c in self.contacts)]]

    @property
    def gains(self) -> Array:
        """Change of ln E by each contact."""
        return np.diff(np.log(self.energies))

    @property
    def heights(self) -> Array:
        """Height of the free flight before the first contact and after each, without damping."""
        return self.energies / (self.ball.mass * self.ball.gravity)

    def between(self, points: int) -> tuple[Array, Array]:
        """(t, y) at `points` instants to the period: the exact motion under the held forces."""
        ball = self.ball
        u = self.force[:-1] - ball.mass * ball.gravity
        y = np.empty((len(u), points))
        for i in range(points):
            phi, gamma = zoh(ball.mass, ball.viscous, ball.spring, ball.period * i / points)
            y[:, i] = phi[0, 0] * self.y[:-1] + phi[0, 1] * self.v[:-1] + gamma[0] * u
        t = np.arange(y.size + 1, dtype=np.float64) * (ball.period / points)
        return t, np.append(y.ravel(), self.y[-1])

    def passing(self, j: int, level: float = 0.0) -> float:
        """Time from sample j to the instant at which the ball passes `level`.

        NaN where it is on the same side of it at sample j and at the next.
        """
        ball = self.ball
        u = self.force[j] - ball.mass * ball.gravity

        def above(t: float) -> float:
            y, _ = flow(ball.mass, ball.viscous, ball.spring, self.y[j], self.v[j], u, 0.0, t)
            return y - level

        if above(0.0) * above(ball.period) > 0.0:
            return float("nan")
        return float(brentq(above, 0.0, ball.period))


def continuous_between(ball: Ball, points: int) -> Array:
    """Y of the ball on the continuous floor, at the instants of `Bounces.between`."""
    fine = replace(ball, period=ball.period / points, periods=ball.periods * points)
    return bounced(fine, CONTINUOUS)[0]


def entering(ball: Ball, speed: float, phase: float) -> Ball:
    """The ball `phase` periods before it meets the floor with that speed [m/s]."""
    before, weight = -phase * ball.period, -ball.mass * ball.gravity
    y, v = flow(ball.mass, ball.viscous, ball.spring, 0.0, -speed, weight, 0.0, before)
    return replace(ball, height=y, speed=v)


def over_phases(
    ball: Ball, law: str, speed: float, phases: int, options: Mapping[str, float] = _NO_OPTIONS
) -> Iterator[Bounces]:
    """The ball entering with that speed [m/s] at evenly spread instants of a period."""
    for i in range(phases):
        yield Bounces.on(entering(ball, speed, (i + 0.5) / phases), law, options)
