"""The probe: torques to and fro, shortly before a contact, that show who is at the handle.

They push the handle by a few counts, so that a light hand is told from a heavy one before the wall
acts. They begin with what moves the lightest hand by as much, and grow with the mass that is found,
and with the speed of a hand that is not known.
"""

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.walls.estimator import FORCES_KEPT, MAX_DELAY, put_in_flight

#: A probe.
PROBE = np.dtype(
    [
        ("resolution", "f8"),  # one count [rad]
        ("lightest", "f8"),  # smallest mass that there may be
        ("torque", "f8"),  # for the lightest hand [N·m]
        ("half", "i8"),  # half its period [samples]
        ("stronger", "f8"),  # torque of the present probe, as a multiple of that
        ("samples", "i8"),  # of the present probe up to now
        ("begun", "i8"),  # samples for which it goes on once it has begun, up to a contact
        ("acts", "?"),  # the force of this cycle is a probe's
        ("in_flight", "f8", (FORCES_KEPT,)),  # torques of probes, newest first
    ],
    align=True,
)

#: Time before a contact from which on the handle is probed, half the period of the probe, as slow
#: as what observes its answer lets through [s], and its least samples.
_BEFORE_S, _HALF_S, _SAMPLES = 0.06, 0.004, 2
#: Motion of a hand under the probe, from end to end [counts], and the strongest torque of a probe
#: for any but the lightest one [N·m].
_COUNTS, _STRONGEST = 4.0, 0.04
#: Way of a sample [counts] from which on the probe of a hand that is not known grows with it: the
#: lightest handle moves by 4/3 of it.
_WAY = 3.0


def set_probe(
    probe: np.void, lightest: float, period: float, count: float, slower: int = 1
) -> None:
    """Write a probe's settings.

    Args:
        probe: A record PROBE.
        lightest: Smallest mass that there may be, all that moves.
        period: T [s].
        count: One count of the encoder [rad].
        slower: Multiple of the usual period and motion, for an observer that is as much slower
            behind an elastic shaft.
    """
    probe["resolution"], probe["lightest"] = count, lightest
    probe["half"] = half = slower * max(round(_HALF_S / period), _SAMPLES)
    quarter = 0.5 * half * period
    probe["torque"] = slower * _COUNTS * count * lightest / quarter**2
    # Behind a shaft that swings the velocity comes and goes; a probe that did so would drive it.
    probe["begun"] = round(_BEFORE_S / period) if slower > 1 else 0


def reset_probe(probe: np.void) -> None:
    """Begin without a probe, and none in flight."""
    probe["samples"], probe["acts"], probe["in_flight"] = 0, False, 0.0


@compiled
def probe_torque(
    probe: Record, wall: Record, way: float, comes: bool, mass: float, known: bool
) -> float:
    """Return a torque to and fro if the handle is about to come into contact, else zero.

    To be called while the wall gives no force. way: that of a sample [rad]. comes: True if the
    handle goes that way faster than the encoder's steps hide. mass: the one in force. known: True
    if it was found with little doubt; of a stranger that comes fast there is little time to learn.
    """
    goes_on = 0 < probe.samples < probe.begun and wall.y > 0.0
    if not goes_on and not (comes and 0.0 < wall.y <= -wall.v * _BEFORE_S):
        probe.samples = 0
        return 0.0
    # The first half is half as long: the handle is pushed about its own path. It stays about it if
    # the torque changes where the probe adds nothing to its velocity, half-way.
    swing = (probe.samples + probe.half // 2) // probe.half
    if probe.samples % probe.half == 0:
        faster = 0.0 if known else -way / (_WAY * probe.resolution)
        most = _STRONGEST / probe.torque
        probe.stronger = max(min(max(mass / probe.lightest, faster), most), 1.0)
    probe.samples += 1
    probe.acts = True
    torque = probe.stronger * probe.torque
    return torque if swing % 2 == 0 else -torque


@compiled
def is_probe_in_flight(probe: Record) -> bool:
    """Return True if one of the torques in flight is a probe's."""
    found = False
    for age in range(MAX_DELAY + 1):
        found |= probe.in_flight[age] != 0.0
    return found


@compiled
def other_torque_acts(probe: Record, in_flight: NDArray[np.float64], delay_periods: int) -> bool:
    """Return True if a torque other than a probe's acts, of those that are in flight."""
    for age in range(delay_periods, MAX_DELAY + 1):
        if in_flight[age] != probe.in_flight[age]:
            return True
    return False


@compiled
def send_probe(probe: Record, force: float) -> None:
    """Note the part of a probe in the force that is sent, as it is rounded."""
    put_in_flight(probe.in_flight, force if probe.acts else 0.0)
    probe.acts = False
