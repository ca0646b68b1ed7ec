"""Continuous referent of a configuration (`analysis.referent`), with the simulated hand."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall import simdrive
from canwall.analysis import AskedWall, ReferentInputs, follow_referent
from canwall.analysis.felt import felt_body
from canwall.compiled import copied
from canwall.config import Settings, Simulation
from canwall.cycle import set_delay, stiffest_for
from canwall.physics import make_plant
from canwall.run.closed_loop import make_simulated_cycle

Array = NDArray[np.float64]


class ReferentMotion(NamedTuple):
    """Motion of the continuous referent at each SYNC.

    Attributes:
        y: Positions relative to the wall [rad], shape (n,).
        felt: Mean forces on the hand over the period from each SYNC on [N·m], shape (n,).
    """

    y: Array
    felt: Array


def referent_motion(
    settings: Settings, asked: AskedWall, wall_position: Array, delay: float | None = None
) -> ReferentMotion | None:
    """Return the motion of the continuous referent of a run.

    The referent is the same hand with the same script on the same handle, against the continuous
    wall at which the law aims in each cycle; one with a cap is no stiffer than shaft, delay and
    encoder bear (`stiffest_for`; on an elastic shaft with the law and damping of the first wall).

    Args:
        settings: Configuration of the run.
        asked: The wall that is asked for in each cycle.
        wall_position: Position of the wall in each cycle [rad], shape (n,).
        delay: Delay D that the laws were told [periods]. Default: as configured.

    Returns:
        The motion; None without `[simulation]`, as a person's hand is not known, and in measured
        time for a drive in a process of its own, whose hand has begun before the run.
    """
    if settings.simulation is None or (settings.real_time and not settings.embedded):
        return None
    if np.any(asked.cap > 0.0):
        stiffest = _stiffest(settings, settings.simulation, float(asked.cap.max()), delay)
        most = np.where(asked.cap > 0.0, stiffest, math.inf)
        asked = asked._replace(stiffness=np.minimum(asked.stiffness, most))
    referent = Referent(settings, settings.simulation, len(wall_position))
    return referent.motion(asked, wall_position)


def _stiffest(settings: Settings, simulation: Simulation, cap: float, delay: float | None) -> float:
    """Return the stiffness of the stiffest capped wall that shaft, delay and encoder bear."""
    capped = settings.wall.model_copy(update={"cap": cap})
    cycle = make_simulated_cycle(settings.model_copy(update={"wall": capped}))
    if delay is not None:
        set_delay(cycle, settings, delay)
    mass = simulation.inertia_kg_m2 + simulation.hand.inertia_kg_m2
    return stiffest_for(cycle, settings, mass)


class Referent:
    """Hand and handle of a configuration, to be simulated against one wall or several."""

    def __init__(self, settings: Settings, simulation: Simulation, cycles: int) -> None:
        self._period = settings.bus.cycle_s
        self._hand = simulation.hand
        self._side = settings.wall.orientation
        self._constant, slope = simdrive.hand_force(simulation.hand, self._period, cycles)
        self._slope = self._side * slope
        self._handle = make_plant(**simdrive.handle_plant(simulation))
        self._joined = make_plant(**simdrive.hand_plant(simulation))
        body = simdrive.hand_body(simulation)
        self._body = body._replace(side=self._side * body.side)
        self._felt = felt_body(self._body, simulation.handle_inertia_kg_m2)

    def motion(self, asked: AskedWall, wall_position: Array) -> ReferentMotion:
        """Return the same as `referent_motion`."""
        motion = ReferentMotion(np.empty(len(wall_position)), np.empty(len(wall_position)))
        follow_referent(self.inputs(wall_position), asked, *motion)
        return motion

    def inputs(self, wall_position: Array) -> ReferentInputs:
        """Return the inputs of `follow_referent`; wall_position [rad] has shape (n,)."""
        origin = self._side * wall_position
        return ReferentInputs(
            copied(self._handle),
            copied(self._joined),
            self._body,
            self._felt,
            self._hand.grip,
            origin,
            # The hand's spring in coordinates measured from the wall.
            self._side * self._constant - self._hand.stiffness_nm_per_rad * origin,
            self._slope,
            self._period,
            self._side * self._hand.rest_rad,
        )
