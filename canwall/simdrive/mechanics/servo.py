"""Motor, handle and hand as one record, moved on by one compiled function.

The simulated drive on the bus moves by it, and the closed loop without a bus: they cannot differ.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.config import Simulation
from canwall.physics import PLANT, Force, Grasp, HandBody, advance, advance_grasp, make_plant

#: Plants (the handle alone, and joined with the hand), the hand as a separate body, the current
#: loop, and the state: position and velocity of handle and hand, torque of the motor. SI units.
SERVO = np.dtype(
    [
        ("handle", PLANT, (1,)),
        ("joined", PLANT, (1,)),
        ("grip", "?"),
        ("hand_mass", "f8"),
        ("hand_viscous", "f8"),
        ("hand_spring", "f8"),
        ("hand_side", "f8"),
        ("lag_rate", "f8"),
        ("torque_step", "f8"),
        ("counts_per_rad", "f8"),
        ("y", "f8"),
        ("v", "f8"),
        ("hand_y", "f8"),
        ("hand_v", "f8"),
        ("touching", "?"),
        ("torque", "f8"),
    ],
    align=True,
)


def handle_plant(simulation: Simulation) -> dict[str, float]:
    """Return the handle without the hand, as keywords of `physics.make_plant`."""
    return {
        "mass": simulation.inertia_kg_m2,
        "viscous": simulation.viscous_nm_s_per_rad,
        "coulomb": simulation.coulomb_nm,
        "cogging": simulation.cogging_nm,
        "cog_pitch": 2.0 * math.pi / simulation.cogs_per_rev,
    }


def hand_plant(simulation: Simulation) -> dict[str, float]:
    """Return drive, handle and hand as one plant, as keywords of `physics.make_plant`."""
    hand, handle = simulation.hand, handle_plant(simulation)
    return handle | {
        "mass": handle["mass"] + hand.inertia_kg_m2,
        "viscous": handle["viscous"] + hand.damping_nm_s_per_rad,
        "spring": hand.stiffness_nm_per_rad,
    }


def hand_body(simulation: Simulation) -> HandBody:
    """Return the hand as a separate body, for a hand that can lose the handle."""
    hand = simulation.hand
    return HandBody(
        hand.inertia_kg_m2, hand.damping_nm_s_per_rad, hand.stiffness_nm_per_rad, hand.side
    )


def make_servo(simulation: Simulation, counts_per_rev: float) -> NDArray[np.void]:
    """Return one servo at rest where its hand rests; shape (1,), dtype SERVO."""
    servo = np.zeros(1, SERVO)
    servo["handle"] = make_plant(**handle_plant(simulation))
    servo["joined"] = make_plant(**hand_plant(simulation))
    servo["grip"] = simulation.hand.grip
    body = hand_body(simulation)
    servo["hand_mass"], servo["hand_viscous"] = body.mass, body.viscous
    servo["hand_spring"], servo["hand_side"] = body.spring, body.side
    servo["lag_rate"] = 2.0 * math.pi * simulation.current_bandwidth_hz
    servo["torque_step"] = simulation.torque_step_nm
    servo["counts_per_rad"] = counts_per_rev / (2.0 * math.pi)
    servo["y"] = servo["hand_y"] = simulation.hand.rest_rad
    servo["touching"] = True
    return servo


@compiled
def encoder_counts(servos: NDArray[np.void]) -> int:
    """Return the encoder position [increments], the nearest one."""
    servo: Record = servos[0]
    return math.floor(servo.y * servo.counts_per_rad + 0.5)


@compiled
def move_servo(
    servos: NDArray[np.void], torque: float, push: float, slope: float, duration: float
) -> int:
    """Move on under a torque that is demanded meanwhile, and a hand that pushes push + slope·t.

    servos has dtype SERVO and shape (1,). Returns the encoder position at the end [increments].
    The hand's push is the part of its force that does not depend on the handle's position. The
    current loop quantizes the torque and follows as a first-order lag.
    """
    servo: Record = servos[0]
    demand = torque
    if servo.torque_step > 0.0:
        demand = np.rint(torque / servo.torque_step) * servo.torque_step
    rate = servo.lag_rate
    start = servo.torque if rate > 0.0 else demand
    excess = start - demand
    if servo.grip:
        joined = servo.joined[0]
        if excess == 0.0:
            servo.y, servo.v, _ = advance(joined, servo.y, servo.v, start + push, slope, duration)
        else:
            servo.y, servo.v, _ = advance(
                joined, servo.y, servo.v, start + push, slope, duration, excess, rate
            )
        servo.hand_y, servo.hand_v = servo.y, servo.v
    else:
        hand = HandBody(servo.hand_mass, servo.hand_viscous, servo.hand_spring, servo.hand_side)
        now = Grasp(servo.y, servo.v, servo.hand_y, servo.hand_v, servo.touching)
        motor, script = Force(start, 0.0, excess, rate), Force(push, slope, 0.0, 0.0)
        now = advance_grasp(servo.handle[0], servo.joined[0], hand, now, motor, script, duration)
        servo.y, servo.v, servo.hand_y, servo.hand_v, servo.touching = now
    servo.torque = demand
    if excess != 0.0:
        servo.torque += excess * math.exp(-rate * duration)
    return encoder_counts(servos)
