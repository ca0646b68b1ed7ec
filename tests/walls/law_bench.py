"""One wall and one law without a loop: helpers shared by the tests of the laws."""

import numpy as np
from bouncing import Array
from hypothesis import strategies as st
from numbers_drawn import log_floats, or_zero
from numpy.typing import NDArray

from canwall.walls import (
    LAWS,
    TENSION,
    WALL,
    set_applied_force,
    set_plant,
    set_referent,
    wall_force,
)
from canwall.walls.interface import free_step
from canwall.workbench import Ball

PREDICTING = ("half_sample", "midpoint", "pole_placement")
COMPENSATED = ("half_sample+deadbeat", "pole_placement+deadbeat")


def wall_of(ball: Ball, law: str, **options: float) -> NDArray[np.void]:
    """The WALL record of a ball on its floor."""
    wall = np.zeros(1, WALL)
    set_plant(wall, ball.mass, ball.viscous, ball.spring, ball.period)
    set_referent(wall, ball.stiffness, ball.damping, LAWS[law].option_values(options))
    wall["tension"] = TENSION[ball.tension]
    wall["passivity_damping"] = ball.passivity
    wall["d"] = -ball.mass * ball.gravity
    return wall


def force_at(wall: NDArray[np.void], law: str, y: float, v: float) -> float:
    """Force of a law at this state at actuation; the sample lies outside and would give none."""
    wall["y_sample"], wall["v_sample"] = 1.0, 77.0
    wall["y"], wall["v"] = y, v
    return wall_force(LAWS[law].address, wall[0])


def force_at_sample(wall: NDArray[np.void], law: str, y: float, v: float) -> float:
    """Force of a law at this sample; the state at actuation lies outside and would give none."""
    wall["y"], wall["v"] = 1.0, 77.0
    wall["y_sample"], wall["v_sample"] = y, v
    return wall_force(LAWS[law].address, wall[0])


def bounced_in_python(
    ball: Ball, wall: NDArray[np.void], law: str
) -> tuple[Array, Array, Array, Array]:
    """(y, ẏ, f, absorbed) of a ball, stepped in Python; absorbed energy as before each force."""
    y, v = ball.height, ball.speed
    states, forces, absorbed = [(y, v)], [], []
    address = LAWS[law].address
    for _ in range(ball.periods):
        wall["v_sample"] = (y - states[-2][0]) / ball.period if len(states) > 1 else v
        wall["y"], wall["v"], wall["y_sample"] = y, v, y
        forces.append(wall_force(address, wall[0]))
        absorbed.append(float(wall["absorbed"][0]))
        set_applied_force(wall[0], forces[-1])
        y, v = free_step(wall[0], y, v, forces[-1])
        states.append((y, v))
    positions, velocities = np.array(states).T
    return positions, velocities, np.array(forces), np.array(absorbed)


@st.composite
def balls(draw: st.DrawFn, damped: bool = True, hardest: float = 3.0) -> Ball:
    """Any mass, period and wall up to θ = `hardest`, with b, k_h, B and gravity of an effect."""
    mass, period = draw(log_floats(1e-4, 1e2)), draw(log_floats(1e-4, 1.0))
    theta = draw(log_floats(0.02, hardest))
    rate = theta / period
    return Ball(
        stiffness=mass * rate**2,
        damping=draw(or_zero(log_floats(1e-3, 1.5))) * 2.0 * mass * rate if damped else 0.0,
        mass=mass,
        viscous=draw(or_zero(log_floats(1e-3, 0.5))) * mass * rate if damped else 0.0,
        spring=draw(or_zero(log_floats(1e-3, 1.0))) * mass * rate**2,
        gravity=draw(or_zero(st.floats(-1.0, 1.0))) * rate**2,
        height=1.0,
        period=period,
        periods=1,
    )
