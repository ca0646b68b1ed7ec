"""Motor, handle and hand as one record, moved on by one compiled function.

The simulated drive on the bus moves by it, and the closed loop without a bus: they cannot differ.
"""

import math

import numpy as np
from numpy.typing import NDArray

from canwall.compiled import Record, compiled
from canwall.config import Simulation
from canwall.physics import (
    PLANT,
    SHAFT,
    Force,
    Grasp,
    HandBody,
    TwoMasses,
    advance,
    advance_grasp,
    advance_shaft,
    make_plant,
    make_shaft,
    shaft_spring,
)

#: Plants: the handle alone, joined with the hand, and joined with it at the end of a shaft.
#: The hand as a separate body. Current loop, control cycle and clock of the drive. The state:
#: position and velocity at the encoder and of the hand (of handle and hand, if it grips); torque in
#: force in the drive, torque that its current loop believes to deliver, time until its next tick;
#: encoder and torque as latched at the last one. Times are by the clock of the SYNC. SI units.
SERVO = np.dtype(
    [
        ("handle", PLANT, (1,)),
        ("joined", PLANT, (1,)),
        ("elastic", "?"),
        ("shaft", SHAFT, (1,)),
        ("grip", "?"),
        ("hand_mass", "f8"),
        ("hand_viscous", "f8"),
        ("hand_spring", "f8"),
        ("hand_side", "f8"),
        ("lag_rate", "f8"),
        ("torque_step", "f8"),
        ("torque_gain", "f8"),
        ("drive_cycle", "f8"),
        ("counts_per_rad", "f8"),
        ("y", "f8"),
        ("v", "f8"),
        ("hand_y", "f8"),
        ("hand_v", "f8"),
        ("touching", "?"),
        ("demand", "f8"),
        ("torque", "f8"),
        ("until_tick", "f8"),
        ("latched_counts", "i8"),
        ("latched_torque", "f8"),
    ],
    align=True,
)


def handle_plant(simulation: Simulation) -> dict[str, float]:
    """Return the handle without the hand, as keywords of `physics.make_plant`."""
    return {
        "mass": simulation.inertia_kg_m2,
        "viscous": simulation.viscous_nm_s_per_rad,
        "coulomb": simulation.coulomb_nm,
        "stiction": simulation.breakaway_nm,
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


def elastic_shaft(simulation: Simulation) -> NDArray[np.void]:
    """Return rotor, shaft, and handle with hand; shape (1,), dtype SHAFT."""
    hand, rotor = simulation.hand, simulation.rotor_inertia_kg_m2
    handle = simulation.inertia_kg_m2 - rotor
    stiffness, damping = shaft_spring(
        simulation.inertia_kg_m2, rotor, simulation.shaft_hz, simulation.shaft_damping_ratio
    )
    return make_shaft(
        handle_plant(simulation) | {"mass": rotor},
        handle + hand.inertia_kg_m2,
        hand.damping_nm_s_per_rad,
        hand.stiffness_nm_per_rad,
        stiffness=stiffness,
        damping=damping,
    )


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
    servo["elastic"] = simulation.shaft_hz > 0.0
    if simulation.shaft_hz > 0.0:
        servo["shaft"] = elastic_shaft(simulation)
    servo["grip"] = simulation.hand.grip
    body = hand_body(simulation)
    servo["hand_mass"], servo["hand_viscous"] = body.mass, body.viscous
    servo["hand_spring"], servo["hand_side"] = body.spring, body.side
    servo["lag_rate"] = 2.0 * math.pi * simulation.current_bandwidth_hz
    servo["torque_step"] = simulation.torque_step_nm
    servo["torque_gain"] = 1.0 + simulation.torque_constant_error
    servo["drive_cycle"] = simulation.drive_cycle_s / (1.0 + 1e-6 * simulation.clock_ppm)
    servo["until_tick"] = simulation.clock_phase * servo["drive_cycle"]
    servo["counts_per_rad"] = counts_per_rev / (2.0 * math.pi)
    servo["y"] = servo["hand_y"] = simulation.hand.rest_rad
    servo["touching"] = True
    _latch(servo)
    return servo


@compiled
def _latch(servos: NDArray[np.void]) -> None:
    """Latch what a TPDO carries: the nearest increment of the encoder, and the torque."""
    servo: Record = servos[0]
    servo.latched_counts = math.floor(servo.y * servo.counts_per_rad + 0.5)
    servo.latched_torque = servo.torque


@compiled
def shows_its_torque(servos: NDArray[np.void]) -> bool:
    """Return True if the drive shows the torque that it delivers, not the one that it applies."""
    servo: Record = servos[0]
    return servo.lag_rate > 0.0 or servo.drive_cycle > 0.0


@compiled
def move_servo(
    servos: NDArray[np.void], torque: float, push: float, slope: float, duration: float
) -> int:
    """Move on under a torque that is demanded meanwhile, and a hand that pushes push + slope·t.

    servos has dtype SERVO and shape (1,). Returns the encoder position that the drive knows at the
    end [increments]. The hand's push is the part of its force that does not depend on the handle's
    position. The current loop quantizes the torque and follows as a first-order lag.

    A drive with a cycle of its own puts a demand into force at its next tick, and knows its encoder
    as of its last one.
    """
    servo: Record = servos[0]
    demand = torque
    if servo.torque_step > 0.0:
        demand = np.rint(torque / servo.torque_step) * servo.torque_step
    if servo.drive_cycle == 0.0:
        servo.demand = demand
        _move_on(servos, push, slope, duration)
        _latch(servos)
        return servo.latched_counts
    tick = servo.until_tick
    rounding = 1e-9 * servo.drive_cycle
    if tick > duration + rounding:
        _move_on(servos, push, slope, duration)
        servo.until_tick = tick - duration
        return servo.latched_counts
    # Between the first and the last tick nothing changes. A tick at the end belongs to this period:
    # rounding must not put it into the next one now and then.
    ticks = math.floor((duration + rounding - tick) / servo.drive_cycle)
    last = min(tick + ticks * servo.drive_cycle, duration)
    tick = min(tick, last)
    done = 0.0
    if demand != servo.demand:
        _move_on(servos, push, slope, tick)
        servo.demand = demand
        done = tick
    _move_on(servos, push + slope * done, slope, last - done)
    _latch(servos)
    _move_on(servos, push + slope * last, slope, duration - last)
    servo.until_tick = last + servo.drive_cycle - duration
    return servo.latched_counts


@compiled
def _move_on(servos: NDArray[np.void], push: float, slope: float, duration: float) -> None:
    """Move on under the torque that is in force, from one tick of the drive to another."""
    servo: Record = servos[0]
    rate = servo.lag_rate
    start = servo.torque if rate > 0.0 else servo.demand
    excess = start - servo.demand
    motor = Force(servo.torque_gain * start, 0.0, servo.torque_gain * excess, rate)
    script = Force(push, slope, 0.0, 0.0)
    if servo.elastic:
        ends = TwoMasses(servo.y, servo.v, servo.hand_y, servo.hand_v)
        ends = advance_shaft(servo.shaft[0], ends, motor, script, duration)
        servo.y, servo.v, servo.hand_y, servo.hand_v = ends
    elif servo.grip:
        joined = servo.joined[0]
        pull = motor.constant + push
        if excess == 0.0:
            servo.y, servo.v, _ = advance(joined, servo.y, servo.v, pull, slope, duration)
        else:
            servo.y, servo.v, _ = advance(
                joined, servo.y, servo.v, pull, slope, duration, motor.excess, rate
            )
        servo.hand_y, servo.hand_v = servo.y, servo.v
    else:
        hand = HandBody(servo.hand_mass, servo.hand_viscous, servo.hand_spring, servo.hand_side)
        now = Grasp(servo.y, servo.v, servo.hand_y, servo.hand_v, servo.touching)
        now = advance_grasp(servo.handle[0], servo.joined[0], hand, now, motor, script, duration)
        servo.y, servo.v, servo.hand_y, servo.hand_v, servo.touching = now
    if math.isnan(servo.y):
        raise ArithmeticError("the simulated handle's motion is not a number: too many events")
    servo.torque = servo.demand
    if excess != 0.0:
        servo.torque += excess * math.exp(-rate * duration)
