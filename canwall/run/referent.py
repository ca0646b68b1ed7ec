"""Continuous referent of a configuration (`analysis.referent`), with the simulated hand."""

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
    """Return the positions of the continuous referent at each SYNC of a run, relative to the wall.

    The referent is the same hand with the same script on the same handle, against the continuous
    wall of each cycle.

    Args:
        settings: Configuration of the run.
        stiffness: Stiffness of the wall in each cycle [N·m/rad], shape (n,).
        damping: Damping of the wall in each cycle [N·m·s/rad], shape (n,).
        wall_position: Position of the wall in each cycle [rad], shape (n,).

    Returns:
        Positions [rad], shape (n,); None without `[simulation]`, as a person's hand is not known.
    """
    if settings.simulation is None:
        return None
    return Referent(settings, settings.simulation, len(stiffness)).positions(
        stiffness, damping, wall_position
    )


class Referent:
    """Hand and handle of a configuration, to be simulated against one wall or several."""

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
        """Return the same as `referent_positions`."""
        y = np.empty(len(stiffness))
        follow_referent(self.inputs(wall_position), stiffness, damping, y)
        return y

    def inputs(self, wall_position: Array) -> ReferentInputs:
        """Return the inputs of `follow_referent`; wall_position [rad] has shape (n,)."""
        origin = self._side * wall_position
        return ReferentInputs(
            copied(self._handle),
            copied(self._joined),
            self._body,
            self._hand.grip,
            origin,
            # The hand's spring in coordinates measured from the wall.
            self._side * self._constant - self._hand.stiffness_nm_per_rad * origin,
            self._slope,
            self._period,
            self._side * self._hand.rest_rad,
        )
