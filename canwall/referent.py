"""The continuous referent of a run: the same hand on the same handle, against an ideal wall."""

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
        origin = self._side * wall_position
        # Measured from the wall, the hand's spring pulls from another place.
        pull = self._side * self._constant - self._hand.stiffness_nm_per_rad * origin
        y = np.empty(len(stiffness))
        y[0] = self._side * self._hand.rest_rad - origin[0]
        wall = (stiffness, damping, origin)
        joined = copied(self._joined)
        if self._hand.grip:
            _follow(joined, *wall, pull, self._slope, self._period, y)
        else:
            handle = copied(self._handle)
            _follow_apart(handle, joined, self._body, *wall, pull, self._slope, self._period, y)
        return y


@compiled
def _meet(plant: Record, stiffness: float, damping: float, origin: float) -> None:
    """Set the wall that a plant meets, its position measured from there."""
    plant.wall_stiffness = stiffness
    plant.wall_damping = damping
    plant.cog_origin = origin


@compiled
def _follow(
    plants: NDArray[np.void],
    stiffness: Array,
    damping: Array,
    origin: Array,
    constant: Array,
    slope: Array,
    period: float,
    y: Array,
) -> None:
    """Fill y from its first value on, starting at rest."""
    plant: Record = plants[0]
    v = 0.0
    for j in range(len(y) - 1):
        _meet(plant, stiffness[j], damping[j], origin[j])
        y_next, v, _ = advance(plant, y[j], v, constant[j], slope[j], period)
        y[j + 1] = y_next + origin[j] - origin[j + 1]


@compiled
def _follow_apart(
    handles: NDArray[np.void],
    both: NDArray[np.void],
    hand: Hand,
    stiffness: Array,
    damping: Array,
    origin: Array,
    constant: Array,
    slope: Array,
    period: float,
    y: Array,
) -> None:
    """Fill y from its first value on, starting at rest, with a hand that can lose the handle."""
    handle: Record = handles[0]
    joined: Record = both[0]
    now = Grasp(y[0], 0.0, y[0], 0.0, True)
    for j in range(len(y) - 1):
        _meet(handle, stiffness[j], damping[j], origin[j])
        _meet(joined, stiffness[j], damping[j], origin[j])
        script = Force(constant[j], slope[j], 0.0, 0.0)
        now = advance_grasp(handle, joined, hand, now, _NO_MOTOR, script, period)
        shift = origin[j] - origin[j + 1]
        now = Grasp(now.y + shift, now.v, now.hand_y + shift, now.hand_v, now.touching)
        y[j + 1] = now.y
