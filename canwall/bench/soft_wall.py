"""The wall to begin with on an unknown bench: so soft that no law chatters, with little torque."""

import math

from canwall.analysis.analytic_limits import stable_stiffness
from canwall.analysis.felt import handle_radius
from canwall.config import Mechanics

#: Part of the rated torque that is the first limit.
TORQUE_PART = 0.1
#: Delay that is reckoned with [periods]: one by the bus, and at most one more by the drive's own
#: cycle and current loop.
WORST_DELAY = 2
#: The lightest hand, a fingertip: mass [kg] and damping [N·s/m].
_FINGERTIP_KG, _FINGERTIP_N_S_PER_M = 0.004, 2.0
#: Part of the stability limit. Of all laws `exponential` is the stiffest at a depth, and was found
#: free of chatter up to a fifth of the limit at the worst of servos and hands (docs/results.md).
_PART = 0.1


def soft_stiffness(inertia_kg_m2: float, viscous_nm_s_per_rad: float, cycle_s: float) -> float:
    """Return a stiffness at which no law chatters in any hand [N·m/rad].

    A tenth of the stability limit of the law `standard` at the worst delay and in the lightest
    hand, which is (b + b_h)/(T/2 + D·T) for small (b + b_h)·T/m (Gil, Hulin), rounded down to a
    figure of one digit. The handle is one of HANDLE_RADIUS_M.

    Args:
        inertia_kg_m2: Inertia of drive and handle.
        viscous_nm_s_per_rad: Their viscous friction b.
        cycle_s: Period T of the SYNC.
    """
    mechanics = Mechanics(inertia_kg_m2=inertia_kg_m2, viscous_nm_s_per_rad=viscous_nm_s_per_rad)
    limit = stable_stiffness(*with_fingertip(mechanics), 0.0, cycle_s, WORST_DELAY)
    return rounded_down(_PART * limit, 1)


def with_fingertip(mechanics: Mechanics) -> tuple[float, float]:
    """Return inertia [kg·m²] and damping [N·m·s/rad] of drive and handle in the lightest hand."""
    radius = handle_radius(mechanics.handle_radius_m)
    return (
        mechanics.inertia_kg_m2 + _FINGERTIP_KG * radius**2,
        mechanics.viscous_nm_s_per_rad + _FINGERTIP_N_S_PER_M * radius**2,
    )


def soft_torque(rated_nm: float) -> float:
    """Return a tenth of the rated torque, rounded down to two digits [N·m]."""
    return rounded_down(TORQUE_PART * rated_nm, 2)


def rounded_down(value: float, digits: int) -> float:
    """Return a positive value rounded down to so many digits."""
    if value <= 0.0:
        return 0.0
    exponent = math.floor(math.log10(value)) - digits + 1
    # The tolerance keeps a value that has so many digits as it is.
    return float(f"{math.floor(value / 10.0**exponent + 1e-9)}e{exponent}")
