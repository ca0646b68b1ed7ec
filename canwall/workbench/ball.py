"""Bouncing ball under held forces (Table 5.2), and on the continuous floor (Table 5.3).

m·ÿ + b·ẏ + k_h·y = f − m·g, with the floor at y = 0. The law gets the exact state and the exact
bias force, and its force acts at once: D = 0.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.errors import InputError, RunFailedError, did_you_mean
from canwall.physics import advance, make_plant
from canwall.record.folder import RecordError, whole_file
from canwall.supervised import interruptible
from canwall.walls import (
    TENSION,
    WALL,
    Law,
    failed_how,
    find_law,
    set_applied_force,
    set_plant,
    set_referent,
    wall_force,
)
from canwall.walls.interface import free_step

Array = NDArray[np.float64]

#: Name that stands for the continuous referent in the place of a law's.
CONTINUOUS = "continuous"
#: Largest number of samples.
MAX_PERIODS = 100_000_000
#: Largest θ: the referent is computed in steps of a quarter of its oscillation.
MAX_THETA = 1e4


@dataclass(frozen=True)
class Ball:
    """A ball, its floor, its initial state, and the sampling.

    Units are SI, or any other consistent set.

    Attributes:
        stiffness: Stiffness K of the floor [N/m].
        damping: Damping B of the floor [N·s/m].
        mass: Mass m of the ball [kg].
        viscous: Viscous damping b of the ball [N·s/m].
        spring: Spring k_h on the ball, with its rest at the floor [N/m].
        gravity: Gravity g [m/s²].
        height: Height at the start [m].
        speed: Velocity at the start, upwards [m/s].
        period: Sampling period T [s].
        periods: Number of periods.
        tension: Policy for pulling forces, a key of TENSION.
        passivity: Damping of the passivity controller.

    Raises:
        InputError: If a value is out of range.
    """

    stiffness: float = 1.0
    damping: float = 0.0
    mass: float = 1.0
    viscous: float = 0.0
    spring: float = 0.0
    gravity: float = 1.0
    height: float = 1.0
    speed: float = 0.0
    period: float = 0.1
    periods: int = 3000
    tension: str = "allow"
    passivity: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "tension" and not isinstance(value, Real):
                raise InputError(f"{name} has to be a number, not {value!r}")
        for name in ("mass", "period"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(f"{name} has to be a number above 0, not {getattr(self, name):g}")
        for name in ("stiffness", "damping", "viscous", "spring", "passivity"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise InputError(f"{name} has to be 0 or above, not {getattr(self, name):g}")
        for name in ("gravity", "height", "speed"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"{name} has to be a number, not {getattr(self, name):g}")
        if not (isinstance(self.periods, int | np.integer) and 0 <= self.periods <= MAX_PERIODS):
            raise InputError(
                f"periods has to be a whole number, 0 … {MAX_PERIODS}, not {self.periods}"
            )
        hardest = self.period * math.sqrt((self.stiffness + self.spring) / self.mass)
        if not hardest <= MAX_THETA:
            raise InputError(f"T·√(K/m) has to be {MAX_THETA:g} or below, not {hardest:g}")
        if self.tension not in TENSION:
            hint = did_you_mean(self.tension, TENSION)
            raise InputError(
                f"tension has to be one of {', '.join(TENSION)}, not {self.tension!r}{hint}"
            )

    @property
    def theta(self) -> float:
        """θ = T·√(K/m), the stiffness of the floor relative to the sample rate."""
        return self.period * math.sqrt(self.stiffness / self.mass)

    def energy(self, y: Array, v: Array) -> Array:
        """Return the energy of the ball and of the floor's spring [J], in the shape of y and v."""
        floor = np.where(y < 0.0, self.stiffness, 0.0)
        potential = self.mass * self.gravity * y + 0.5 * (self.spring + floor) * y * y
        return np.asarray(0.5 * self.mass * v * v + potential)


def simulate_ball(
    ball: Ball, law: str, deadbeat: bool = False, options: Mapping[str, float] | None = None
) -> tuple[Array, Array, Array]:
    """Simulate the ball on a floor rendered by a law, or on the continuous floor.

    Args:
        ball: Ball and floor.
        law: Name of a law, or CONTINUOUS.
        deadbeat: Add the deadbeat compensation.
        options: Options of the law.

    Returns:
        (y, ẏ, f) as from `sampled_ball` or `continuous_ball`.

    Raises:
        UnknownLawError: If the law or an option does not exist.
        RunFailedError: If the law's force is not a number, or the trajectory or its energy
            overflows.
    """
    found = None if law == CONTINUOUS else find_law(law, deadbeat)
    trajectory = sampled_ball(ball, found, options or {}) if found else continuous_ball(ball)
    y, v, force = trajectory
    with np.errstate(all="ignore"):  # what overflows is told below
        lost = ~np.isfinite(np.sum(trajectory, axis=0) + ball.energy(y, v))
    if lost.any():
        j = int(lost.argmax())
        what = "the trajectory overflows"
        if found and math.isfinite(y[j]) and math.isnan(force[j]):
            what = failed_how(found.failure())
        raise RunFailedError(f"{law}: {what} at t = {j * ball.period:g}")
    return trajectory


def write_ball(path: Path, ball: Ball, y: Array, v: Array, force: Array) -> None:
    """Write a CSV file with columns t, y, v, f in full precision, whole or not at all.

    Raises InputError if it cannot be written.
    """
    table = np.column_stack([np.arange(len(y)) * ball.period, y, v, force])
    try:
        with whole_file(path) as file:
            np.savetxt(file, table, fmt="%.17g", delimiter=",", header="t,y,v,f", comments="")
    except RecordError as error:
        raise InputError(str(error)) from None


def sampled_ball(
    ball: Ball, law: Law, options: Mapping[str, float] = MappingProxyType({})
) -> tuple[Array, Array, Array]:
    """Simulate the ball on a floor rendered by a law.

    Args:
        ball: Ball and floor.
        law: Law of the floor.
        options: Options of the law.

    Returns:
        (y, ẏ, f) at the samples 0 … periods, each of shape (periods + 1,). f[j] is held from
        sample j to the next; the last f is 0.

    Raises:
        UnknownLawError: If the law does not have an option.
    """
    wall = np.zeros(1, WALL)
    set_plant(wall, ball.mass, ball.viscous, ball.spring, ball.period)
    set_referent(wall, ball.stiffness, ball.damping, law.option_values(options))
    wall["tension"] = TENSION[ball.tension]
    wall["passivity_damping"] = ball.passivity
    wall["d"] = -ball.mass * ball.gravity
    trajectory = np.zeros((3, ball.periods + 1))
    # A law of the user's may not return.
    interruptible(lambda: bounce(wall, law.address, ball.height, ball.speed, trajectory))
    return trajectory[0], trajectory[1], trajectory[2]


@compiled
def bounce(walls: NDArray[np.void], address: int, y: float, v: float, trajectory: Array) -> None:
    """Fill the trajectory (y, ẏ, f), shape (3, n + 1), starting at the state (y, v).

    walls has shape (1,) and dtype WALL; address is the law's.
    """
    wall: Record = walls[0]
    periods = trajectory.shape[1] - 1
    y_before = y
    for j in range(periods):
        wall.y = wall.y_sample = y
        # The backward difference; at the first sample there is none.
        wall.v = v
        wall.v_sample = v if j == 0 else (y - y_before) / wall.period
        force = wall_force(address, wall)
        set_applied_force(wall, force)
        trajectory[0, j] = y
        trajectory[1, j] = v
        trajectory[2, j] = force
        if math.isnan(force):  # what the law's last call raised is asked for
            trajectory[:, j + 1 :] = math.nan
            return
        y_before = y
        y, v = free_step(wall, y, v, force)
    trajectory[0, periods] = y
    trajectory[1, periods] = v


def continuous_ball(ball: Ball) -> tuple[Array, Array, Array]:
    """Simulate the ball on the continuous floor.

    Returns:
        (y, ẏ, f) at the samples 0 … periods, each of shape (periods + 1,). f is the force of the
        floor at the sample; the last is 0, as in `sampled_ball`.
    """
    plant = make_plant(ball.mass, ball.viscous, ball.spring, 0.0, ball.stiffness, ball.damping)
    y, v = np.zeros(ball.periods + 1), np.zeros(ball.periods + 1)
    y[0], v[0] = ball.height, ball.speed
    _advance_samples(plant, -ball.mass * ball.gravity, ball.period, y, v)
    force = np.where(y < 0.0, -ball.stiffness * y - ball.damping * v, 0.0)
    force[-1] = 0.0
    return y, v, force


@compiled
def _advance_samples(
    plants: NDArray[np.void], bias: float, period: float, y: Array, v: Array
) -> None:
    for j in range(len(y) - 1):
        y[j + 1], v[j + 1], _ = advance(plants[0], y[j], v[j], bias, 0.0, period)
