"""The continuous referent of a run: the same hand on the same handle, against an ideal wall."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.physics import Force, Grasp, HandBody, advance, advance_grasp

Array = NDArray[np.float64]

_NO_MOTOR = Force(0.0, 0.0, 0.0, 0.0)


class ReferentInputs(NamedTuple):
    """Hand and handle as compiled code takes them; origin, pull and slope for each cycle, (n,)."""

    handle: NDArray[np.void]
    joined: NDArray[np.void]
    body: HandBody
    grip: bool
    origin: Array
    pull: Array
    slope: Array
    period: float
    rest: float


@compiled
def follow_referent(of: ReferentInputs, stiffness: Array, damping: Array, y: Array) -> None:
    """Fill y, shape (n,), with the referent's positions relative to the wall, as at each SYNC."""
    y[0] = of.rest - of.origin[0]
    if of.grip:
        _follow(of, stiffness, damping, y)
    else:
        _follow_apart(of, stiffness, damping, y)


@compiled
def _meet(plant: Record, stiffness: float, damping: float, origin: float) -> None:
    """Set the wall that a plant meets, its position measured from there."""
    plant.wall_stiffness = stiffness
    plant.wall_damping = damping
    plant.cog_origin = origin


@compiled
def _follow(of: ReferentInputs, stiffness: Array, damping: Array, y: Array) -> None:
    """Fill y from its first value on, starting at rest."""
    plant: Record = of.joined[0]
    v = 0.0
    for j in range(len(y) - 1):
        _meet(plant, stiffness[j], damping[j], of.origin[j])
        y_next, v, _ = advance(plant, y[j], v, of.pull[j], of.slope[j], of.period)
        y[j + 1] = y_next + of.origin[j] - of.origin[j + 1]


@compiled
def _follow_apart(of: ReferentInputs, stiffness: Array, damping: Array, y: Array) -> None:
    """Fill y from its first value on, starting at rest, with a hand that can lose the handle."""
    handle: Record = of.handle[0]
    joined: Record = of.joined[0]
    now = Grasp(y[0], 0.0, y[0], 0.0, True)
    for j in range(len(y) - 1):
        _meet(handle, stiffness[j], damping[j], of.origin[j])
        _meet(joined, stiffness[j], damping[j], of.origin[j])
        script = Force(of.pull[j], of.slope[j], 0.0, 0.0)
        now = advance_grasp(handle, joined, of.body, now, _NO_MOTOR, script, of.period)
        shift = of.origin[j] - of.origin[j + 1]
        now = Grasp(now.y + shift, now.v, now.hand_y + shift, now.hand_v, now.touching)
        y[j + 1] = now.y
