"""The continuous referent of a run: the same hand on the same handle, against an ideal wall."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall import simdrive
from canwall.compiled import Record, compiled, copied
from canwall.config import Settings, Simulation
from canwall.physics import Force, Grasp, Hand, advance, advance_grasp, make_plant

Array = NDArray[np.float64]

_NO_MOTOR = Force(0.0, 0.0, 0.0, 0.0)


def referent_positions(
    settings: Settings, stiffness: Array, damping: Array, wall_position: Array
) -> Array | None:
    """Positions relative to the wall, at each SYNC of a run, of the continuous referent; (n,).

    The referent is the same hand with the same script on the same handle, against the continuous
    wall that each cycle asked for: stiffness [N·m/rad], damping [N·m·s/rad] and position [rad],
    each of shape (n,). None where the hand is a person's.
    """
    if settings.simulation is None:
        return None
    return Referent(settings, settings.simulation, len(stiffness)).positions(
        stiffness, damping, wall_position
    )


class Referent:
    """The hand and the handle of a configuration, to be followed against one wall or several."""

    def __init__(self, settings: Settings, simulation: Simulation, cycles: int) -> None:
        self._period = settings.bus.cycle_s
        self._hand = simulation.hand
        self._side = 1.0 if settings.wall.side == "below" else -1.0
        self._constant, slope = simdrive.hand_force(simulation.hand, self._period, cycles)
        self._slope = self._side * slope
        self._handle = make_plant(**simdrive.handle_plant(simulation))
        self._joined = make_plant(**simdrive.hand_plant(simulation))
        body = simdrive.hand_body(simulation)
        self._body = body._replace(side=self._side * body.side)

    def positions(self, stiffness: Array, damping: Array, wall_position: Array) -> Array:
        """As `referent_positions`."""
        y = np.empty(len(stiffness))
        follow(self.following(wall_position), stiffness, damping, y)
        return y

    def following(self, wall_position: Array) -> "Following":
        """What `follow` needs, for a wall at these positions [rad] in each cycle; shape (n,)."""
        origin = self._side * wall_position
        return Following(
            copied(self._handle),
            copied(self._joined),
            self._body,
            self._hand.grip,
            origin,
            # Measured from the wall, the hand's spring pulls from another place.
            self._side * self._constant - self._hand.stiffness_nm_per_rad * origin,
            self._slope,
            self._period,
            self._side * self._hand.rest_rad,
        )


class Following(NamedTuple):
    """Hand and handle as compiled code takes them; origin, pull and slope for each cycle, (n,)."""

    handle: NDArray[np.void]
    joined: NDArray[np.void]
    body: Hand
    grip: bool
    origin: Array
    pull: Array
    slope: Array
    period: float
    rest: float


@compiled
def follow(of: Following, stiffness: Array, damping: Array, y: Array) -> None:
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
def _follow(of: Following, stiffness: Array, damping: Array, y: Array) -> None:
    """Fill y from its first value on, starting at rest."""
    plant: Record = of.joined[0]
    v = 0.0
    for j in range(len(y) - 1):
        _meet(plant, stiffness[j], damping[j], of.origin[j])
        y_next, v, _ = advance(plant, y[j], v, of.pull[j], of.slope[j], of.period)
        y[j + 1] = y_next + of.origin[j] - of.origin[j + 1]


@compiled
def _follow_apart(of: Following, stiffness: Array, damping: Array, y: Array) -> None:
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
