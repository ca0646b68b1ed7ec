"""The bouncing ball as a Dataset."""

from collections.abc import Mapping

import numpy as np
import xarray as xr

from canwall.library.arguments import as_dict
from canwall.library.laws import LawLike, law_name
from canwall.workbench import CONTINUOUS, Ball, simulate_ball


def ball(
    law: LawLike,
    *,
    stiffness: float = 1.0,
    damping: float = 0.0,
    mass: float = 1.0,
    viscous: float = 0.0,
    spring: float = 0.0,
    gravity: float = 1.0,
    height: float = 1.0,
    speed: float = 0.0,
    period: float = 0.1,
    periods: int = 3000,
    tension: str = "allow",
    passivity: float = 0.0,
    deadbeat: bool = False,
    options: Mapping[str, float] | None = None,
) -> xr.Dataset:
    """Bounce a ball on the wall as its floor: exact state, no delay, held force (`canwall ball`).

    m·ÿ + b·ẏ + k_h·y = f − m·g, with the floor at y = 0 (Tables 5.2 and 5.3). What a law does wrong
    here is its own fault.

    Args:
        law: Law of the floor, or "continuous" for its referent.
        stiffness: Stiffness K of the floor [N/m].
        damping: Damping B of the floor [N·s/m].
        mass: Mass m of the ball [kg].
        viscous: Viscous damping b of the ball [N·s/m].
        spring: Spring k_h on the ball, with its rest at the floor [N/m].
        gravity: Gravity g [m/s²].
        height: Height at the start [m].
        speed: Velocity at the start, upwards [m/s].
        period: Sampling period T [s].
        periods: Number of periods N.
        tension: Policy for pulling forces: allow, clamp or budget.
        passivity: Damping of the passivity controller [N·s/m].
        deadbeat: Add the deadbeat compensation.
        options: Options of the law.

    Returns:
        A Dataset over the times `t` of the samples, shape (N + 1,), with `y`, `v`, `f`, the force
        held from a sample on (the last is 0), and `energy`, that of ball and floor; all with
        `units` and `long_name`.

    Raises:
        canwall.errors.InputError: If the law or an option does not exist, or a value is out of
            range.
        canwall.errors.RunFailedError: If the law's force is not a number, or the trajectory or its
            energy overflows.
    """
    dropped = Ball(
        stiffness=stiffness,
        damping=damping,
        mass=mass,
        viscous=viscous,
        spring=spring,
        gravity=gravity,
        height=height,
        speed=speed,
        period=period,
        periods=periods,
        tension=tension,
        passivity=passivity,
    )
    name = law if law == CONTINUOUS else law_name(law)
    y, v, force = simulate_ball(dropped, str(name), deadbeat, as_dict("options", options))
    variables = {
        "y": (y, "m", "height above the floor"),
        "v": (v, "m/s", "velocity, upwards"),
        "f": (force, "N", "force held from the sample on"),
        "energy": (dropped.energy(y, v), "J", "energy of ball and floor"),
    }
    times = np.arange(len(y)) * period
    return xr.Dataset(
        {
            name: ("t", values, {"units": unit, "long_name": meaning})
            for name, (values, unit, meaning) in variables.items()
        },
        {"t": ("t", times, {"units": "s", "long_name": "time"})},
        {"law": str(name), "deadbeat": int(deadbeat)} | vars(dropped) | {"theta": dropped.theta},
    )
