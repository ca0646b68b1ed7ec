"""Bounces of a ball: contacts, energies and the exact motion between samples."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from canwall.analysis import metrics
from canwall.physics import flow, zoh
from canwall.workbench.ball import CONTINUOUS, Ball, simulate_ball

Array = NDArray[np.float64]

_NO_OPTIONS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Bounces:
    """A simulated ball: state and held force at its samples, each of shape (periods + 1,)."""

    ball: Ball
    y: Array
    v: Array
    force: Array

    @classmethod
    def on(cls, ball: Ball, law: str, options: Mapping[str, float] = _NO_OPTIONS) -> "Bounces":
        """Simulate the ball on a floor rendered by a law. Raises UnknownLawError."""
        return cls(ball, *simulate_ball(ball, law, options=options))

    @property
    def t(self) -> Array:
        """Times of the samples."""
        return np.arange(len(self.y), dtype=np.float64) * self.ball.period

    @cached_property
    def contacts(self) -> list[slice]:
        """Contacts that have ended, as slices of samples (`metrics.contacts`).

        A contact that touches the last sample is left out: the force there is not known.
        """
        found = metrics.contacts(self.y, self.force)
        return [c for c in found if self.y[c.stop - 1] >= 0.0 and c.stop < len(self.y)]

    @property
    def energies(self) -> Array:
        """Energy before the first contact and in the flight after each contact [J]."""
        energy = self.ball.energy(self.y, self.v)
        return energy[[0, *(c.stop - 1 for c in self.contacts)]]

    @property
    def gains(self) -> Array:
        """Change of ln E in each contact."""
        return np.diff(np.log(self.energies))

    @property
    def heights(self) -> Array:
        """Height of an undamped flight before the first contact and after each contact [m]."""
        return self.energies / (self.ball.mass * self.ball.gravity)

    def between(self, points: int) -> tuple[Array, Array]:
        """Return (t, y) of the exact motion under the held forces, `points` times a period."""
        ball = self.ball
        u = self.force[:-1] - ball.mass * ball.gravity
        y = np.empty((len(u), points))
        for i in range(points):
            phi, gamma = zoh(ball.mass, ball.viscous, ball.spring, ball.period * i / points)
            y[:, i] = phi[0, 0] * self.y[:-1] + phi[0, 1] * self.v[:-1] + gamma[0] * u
        t = np.arange(y.size + 1, dtype=np.float64) * (ball.period / points)
        return t, np.append(y.ravel(), self.y[-1])

    def crossing(self, j: int, level: float = 0.0) -> float:
        """Return the time from sample j at which the ball crosses `level`, NaN if it does not."""
        ball = self.ball
        u = self.force[j] - ball.mass * ball.gravity

        def position(t: float) -> float:
            y, _ = flow(ball.mass, ball.viscous, ball.spring, self.y[j], self.v[j], u, 0.0, t)
            return y

        return crossing_time(position, level, 0.0, ball.period)


def crossing_time(
    position: Callable[[float], float], level: float, start: float, end: float
) -> float:
    """Return the time at which a position crosses `level` between start and end.

    NaN if it is on the same side of the level at both.
    """

    def height(t: float) -> float:
        return position(t) - level

    if height(start) * height(end) > 0.0:
        return nan
    return float(brentq(height, start, end))


def continuous_between(ball: Ball, points: int) -> Array:
    """Return y of the ball on the continuous floor, at the instants of `Bounces.between`."""
    fine = replace(ball, period=ball.period / points, periods=ball.periods * points)
    return simulate_ball(fine, CONTINUOUS)[0]


def entering(ball: Ball, speed: float, phase: float) -> Ball:
    """Return the ball `phase` periods before it meets the floor at this speed [m/s]."""
    before, weight = -phase * ball.period, -ball.mass * ball.gravity
    y, v = flow(ball.mass, ball.viscous, ball.spring, 0.0, -speed, weight, 0.0, before)
    return replace(ball, height=y, speed=v)


def over_phases(
    ball: Ball, law: str, speed: float, phases: int, options: Mapping[str, float] = _NO_OPTIONS
) -> Iterator[Bounces]:
    """Simulate the ball meeting the floor at this speed [m/s], at evenly spread phases."""
    for i in range(phases):
        yield Bounces.on(entering(ball, speed, (i + 0.5) / phases), law, options)
