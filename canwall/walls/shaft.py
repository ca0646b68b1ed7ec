"""The stiffest wall on an elastic shaft, from the closed loop of filter, law and two masses.

The model of the laws is one mass. Rotor and load on an elastic shaft are two, and what the filter
takes for a velocity at their resonance is multiplied by the wall's damper and turned by the delay:
the wall drives the resonance. Between entry and exit all of it is linear, so that the stiffness up
to which it is stable follows from eigenvalues, outside the cycle.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.physics import damping_of_ratio, shaft_spring, zoh

Array = NDArray[np.float64]

#: Errors of the resonance and of the mass that a wall has to bear.
_RESONANCES, _MASSES = (0.95, 1.0, 1.05), (0.6, 1.0, 1.7)
#: Part of the stiffness at the limit of stability, and of that of the shaft: what a contact excites
#: has to die away, and a heavy hand bounces on the shaft of a wall that is as stiff.
_MARGIN, _SHAFT_PART = 0.125, 0.25
#: Part of that for a hand that is identified: until it is, its wall has the damping of another one,
#: and the stiffness changes with the mass.
_IDENTIFIED = 0.5
#: Walls that are looked at, as K·T²/m.
_LOOKED_AT: Array = np.geomspace(1e-4, 1.25, 100)


class ElasticShaft(NamedTuple):
    """A rotor, and the shaft between it and the handle.

    Attributes:
        inertia: Inertia of rotor and handle together, without a hand [kg·m²].
        rotor: That of the rotor [kg·m²].
        resonance_hz: Resonance of one against the other [Hz].
        damping_ratio: Its damping ratio.
        viscous: Viscous damping of the rotor [N·m·s/rad].
    """

    inertia: float
    rotor: float
    resonance_hz: float
    damping_ratio: float
    viscous: float

    @property
    def spring(self) -> tuple[float, float]:
        """Stiffness [N·m/rad] and damping [N·m·s/rad] of the shaft."""
        return shaft_spring(self.inertia, self.rotor, self.resonance_hz, self.damping_ratio)

    @property
    def stiffness(self) -> float:
        """Stiffness of the shaft [N·m/rad]."""
        return self.spring[0]


class WallLoop(NamedTuple):
    """Filter, law and delay that close the loop over one hand.

    Attributes:
        mass: Inertia in the model of the laws [kg·m²].
        viscous: Viscous damping in it, that of the rotor included [N·m·s/rad].
        gain: Gain of its filter on [y, ẏ, d].
        sampled: True for a law that goes by the sampled position.
        damping: B that is asked for [N·m·s/rad].
        damping_ratio: ζ in place of it; 0: none.
        period: T [s].
        delay: D [periods].
    """

    mass: float
    viscous: float
    gain: tuple[float, float, float]
    sampled: bool
    damping: float
    damping_ratio: float
    period: float
    delay: float


@functools.lru_cache(maxsize=4096)
def stiffest_wall(shaft: ElasticShaft, loop: WallLoop, identified: bool = False) -> float:
    """Return the stiffness up to which a wall leaves the resonance of its shaft alone [N·m/rad].

    It is an eighth of that up to which the loop is stable, 1.25·m/T² at the most, with a resonance
    5 % off and a hand lighter or heavier than the model's, 0 where there is none, and at most a
    quarter of the shaft's; half of either for a hand that is identified.
    """
    walls: Array = _LOOKED_AT * loop.mass / loop.period**2
    stable = len(walls)
    for resonance in _RESONANCES:
        off = shaft._replace(resonance_hz=resonance * shaft.resonance_hz)
        for mass in _MASSES:
            load = max(mass * loop.mass, shaft.inertia) - shaft.rotor
            poles = np.linalg.eigvals(closed_loops(off, load, loop, walls[:stable]))
            unstable = np.flatnonzero(np.abs(poles).max(axis=1) >= 1.0)
            stable = int(unstable[0]) if len(unstable) else stable
            if not stable:
                return 0.0
    most = min(_MARGIN * float(walls[stable - 1]), _SHAFT_PART * shaft.stiffness)
    return _IDENTIFIED * most if identified else most


def closed_loops(shaft: ElasticShaft, load: float, loop: WallLoop, walls: Array) -> Array:
    """Return the transition over a period of two masses within a wall, for each of the walls.

    The state is that of rotor and load, the filter's before the sample, the forces in flight with
    the newest first, and the sample before. Laws with a model count as `mean_force`, sampled ones
    as spring and damper.

    Args:
        shaft: The shaft.
        load: Inertia of the load, the hand included [kg·m²].
        loop: What closes the loop.
        walls: Stiffnesses [N·m/rad], shape (n,).

    Returns:
        Transitions, shape (n, m, m).
    """
    whole = math.floor(loop.delay)
    share = loop.delay - whole
    size = 4 + 3 + whole + 1 + 1
    # Each quantity is a row that gives it from the state.
    state = np.eye(size)
    masses, known, flying, before = state[:4], state[4:7], state[7:-1], state[-1:]
    nothing = np.zeros(size)
    innovation = masses[0] - known[0]
    known = known + np.outer(loop.gain, innovation)
    older = flying[whole]
    newer = flying[whole - 1] if whole else nothing
    first = _two_masses(shaft, load, loop.viscous, share * loop.period)
    rest = _two_masses(shaft, load, loop.viscous, (1.0 - share) * loop.period)
    phi, gamma = _with_bias(loop, share)
    at_actuation = phi @ known + np.outer(gamma, older)
    phi_rest, gamma_rest = _with_bias(loop, 1.0 - share)
    next_known = phi_rest @ at_actuation + np.outer(gamma_rest, newer)
    phi, gamma = _with_bias(loop, 1.0)
    for force in flying[:whole][::-1]:
        at_actuation = phi @ at_actuation + np.outer(gamma, force)
    sampled = np.concatenate([masses[:1], before])
    seen = sampled if loop.sampled else at_actuation

    transitions = np.zeros((len(walls), size, size))
    transitions[:, :4] = rest[0] @ (first[0] @ masses + np.outer(first[1], older))
    transitions[:, :4] += np.outer(rest[1], newer)
    transitions[:, 4:7] = next_known
    transitions[:, 8:-1] = flying[:-1]
    transitions[:, -1] = masses[0]
    for transition, stiffness in zip(transitions, walls.tolist(), strict=True):
        force = _gain(loop, stiffness) @ seen
        transition[7] = force
        if whole == 0:
            transition[:4] += np.outer(rest[1], force)
            transition[4:7] += np.outer(gamma_rest, force)
    return transitions


def _gain(loop: WallLoop, stiffness: float) -> Array:
    """Return what a law makes of position, velocity and bias force, or of the last two samples."""
    mass, period = loop.mass, loop.period
    damping = damping_of_ratio(loop.damping, loop.damping_ratio, stiffness, mass)
    if loop.sampled:
        return np.array([-stiffness - damping / period, damping / period])
    free, gamma = zoh(mass, loop.viscous, 0.0, period)
    within, gamma_within = zoh(mass, loop.viscous + damping, stiffness, period)
    force = (within[1] - free[1]) / gamma[1]
    return np.array([*force, gamma_within[1] / gamma[1] - 1.0])


def _with_bias(loop: WallLoop, share: float) -> tuple[Array, Array]:
    """Return transition and effect of a force on [y, ẏ, d] over a share of a period."""
    phi, gamma = zoh(loop.mass, loop.viscous, 0.0, share * loop.period)
    with_bias = np.eye(3)
    with_bias[:2, :2], with_bias[:2, 2] = phi, gamma
    return with_bias, np.array([*gamma, 0.0])


def _two_masses(
    shaft: ElasticShaft, load: float, viscous: float, duration: float
) -> tuple[Array, Array]:
    """Return transition and effect of a torque on position and velocity of rotor and load."""
    from scipy.linalg import expm  # a tenth of a second: not for rigid shafts

    stiffness, damping = shaft.spring
    hand = viscous - shaft.viscous
    rates = np.zeros((5, 5))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, :5] = np.array([-stiffness, -damping - shaft.viscous, stiffness, damping, 1.0])
    rates[1] /= shaft.rotor
    rates[3, :4] = np.array([stiffness, damping, -stiffness, -damping - hand]) / load
    over = expm(rates * duration)
    return over[:4, :4], over[:4, 4]
