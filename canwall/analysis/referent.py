"""Continuous referent of a run: the same hand on the same handle, against an ideal wall.

The wall is the one at which a law aims: what was asked for, as it would be in force if the mass
were known. A stiffness may be capped, and a damping be given by a damping ratio; both belong to the
mass that really moves. What a law makes of the wall that takes it for another one shows as a
difference from the referent.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.felt import mean_hand_force
from canwall.compiled import Record, compiled
from canwall.physics import (
    Force,
    Grasp,
    HandBody,
    advance,
    advance_grasp,
    capped_stiffness,
    damping_of_ratio,
)

Array = NDArray[np.float64]

_NO_MOTOR = Force(0.0, 0.0, 0.0, 0.0)


class ReferentInputs(NamedTuple):
    """Hand and handle in the form that compiled code takes.

    Attributes:
        handle: Plant of the handle alone, shape (1,), dtype PLANT.
        joined: Plant of handle and hand moving as one, shape (1,), dtype PLANT.
        body: The hand as a body of its own.
        felt: The body on which the felt force acts, from `felt.felt_body`.
        grip: True if the hand cannot lose the handle.
        origin: Position of the wall in each cycle [rad], shape (n,).
        pull: Force of the hand's script at each SYNC [N·m], shape (n,).
        slope: Slope of that force over the cycle [N·m/s], shape (n,).
        period: Period of the SYNC [s].
        rest: Position at which the hand rests at the start [rad].
    """

    handle: NDArray[np.void]
    joined: NDArray[np.void]
    body: HandBody
    felt: HandBody
    grip: bool
    origin: Array
    pull: Array
    slope: Array
    period: float
    rest: float


class AskedWall(NamedTuple):
    """The wall that is asked for in each cycle; arrays of shape (n,).

    Attributes:
        stiffness: K [N·m/rad].
        damping: B [N·m·s/rad].
        damping_ratio: ζ of the damping, in place of B; 0: none.
        cap: c of the largest stiffness c·m/T², with T of the SYNC: for a law evaluated every n
            periods, that of `[wall]` over n²; 0: none.
    """

    stiffness: Array
    damping: Array
    damping_ratio: Array
    cap: Array


@compiled
def wall_aimed_at(asked: AskedWall, j: int, mass: float, period: float) -> tuple[float, float]:
    """Return stiffness and damping at which a law aims in cycle j.

    K_e = min(K, c·m/T²) where there is a cap, and B = 2·ζ·√(K_e·m) where there is a damping ratio
    (docs/laws.md).

    Args:
        asked: The wall that is asked for.
        j: Number of the cycle.
        mass: m, inertia of everything that moves [kg·m²].
        period: T [s].
    """
    stiffness = capped_stiffness(asked.stiffness[j], asked.cap[j], mass, period)
    return stiffness, damping_of_ratio(asked.damping[j], asked.damping_ratio[j], stiffness, mass)


@compiled
def follow_referent(inputs: ReferentInputs, asked: AskedWall, y: Array, felt: Array) -> None:
    """Follow the continuous referent from SYNC to SYNC.

    Args:
        inputs: Hand and handle.
        asked: The wall that is asked for in each cycle.
        y: Result: positions at each SYNC, relative to the wall [rad], shape (n,).
        felt: Result: mean force on the hand over the period from each SYNC on [N·m], shape (n,).
    """
    y[0] = inputs.rest - inputs.origin[0]
    mass = inputs.joined[0].mass
    stiffness, damping = np.empty(len(y)), np.empty(len(y))
    for j in range(len(y)):
        stiffness[j], damping[j] = wall_aimed_at(asked, j, mass, inputs.period)
    if inputs.grip:
        _follow_joined(inputs, stiffness, damping, y, felt)
    else:
        _follow_grasp(inputs, stiffness, damping, y, felt)
    felt[-1] = felt[-2] if len(felt) > 1 else 0.0


@compiled
def _set_wall(plant: Record, stiffness: float, damping: float, origin: float) -> None:
    """Set the wall of a plant whose position is measured from it."""
    plant.wall_stiffness = stiffness
    plant.wall_damping = damping
    plant.cog_origin = origin


@compiled
def _felt(
    inputs: ReferentInputs, j: int, y: float, v: float, y_next: float, v_next: float
) -> float:
    """Return the mean force on the hand over period j."""
    push = inputs.pull[j] + 0.5 * inputs.slope[j] * inputs.period
    return mean_hand_force(inputs.felt, y, v, y_next, v_next, push, inputs.period)


@compiled
def _follow_joined(
    inputs: ReferentInputs, stiffness: Array, damping: Array, y: Array, felt: Array
) -> None:
    """Fill y and felt from y[0] on, starting at rest, with a hand that cannot lose the handle."""
    plant: Record = inputs.joined[0]
    v = 0.0
    for j in range(len(y) - 1):
        _set_wall(plant, stiffness[j], damping[j], inputs.origin[j])
        before = v
        y_next, v, _ = advance(plant, y[j], v, inputs.pull[j], inputs.slope[j], inputs.period)
        felt[j] = _felt(inputs, j, y[j], before, y_next, v)
        y[j + 1] = y_next + inputs.origin[j] - inputs.origin[j + 1]


@compiled
def _follow_grasp(
    inputs: ReferentInputs, stiffness: Array, damping: Array, y: Array, felt: Array
) -> None:
    """Fill y and felt from y[0] on, starting at rest, with a hand that can lose the handle."""
    handle: Record = inputs.handle[0]
    joined: Record = inputs.joined[0]
    now = Grasp(y[0], 0.0, y[0], 0.0, True)
    for j in range(len(y) - 1):
        _set_wall(handle, stiffness[j], damping[j], inputs.origin[j])
        _set_wall(joined, stiffness[j], damping[j], inputs.origin[j])
        script = Force(inputs.pull[j], inputs.slope[j], 0.0, 0.0)
        hand_y, hand_v = now.hand_y, now.hand_v
        now = advance_grasp(handle, joined, inputs.body, now, _NO_MOTOR, script, inputs.period)
        felt[j] = _felt(inputs, j, hand_y, hand_v, now.hand_y, now.hand_v)
        shift = inputs.origin[j] - inputs.origin[j + 1]
        now = Grasp(now.y + shift, now.v, now.hand_y + shift, now.hand_v, now.touching)
        y[j + 1] = now.y
