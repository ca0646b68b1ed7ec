"""The continuous referent of a configuration (`analysis.referent`), with the simulated hand."""

import numpy as np
from numpy.typing import NDArray

from canwall import simdrive
from canwall.analysis import ReferentInputs, follow_referent
from canwall.compiled import copied
from canwall.config import Settings, Simulation
from canwall.physics import make_plant

Array = NDArray[np.float64]


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
        follow_referent(self.inputs(wall_position), stiffness, damping, y)
        return y

    def inputs(self, wall_position: Array) -> ReferentInputs:
        """Inputs of `follow_referent`, for a wall at these positions [rad] in each cycle; (n,)."""
        origin = self._side * wall_position
        return ReferentInputs(
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
