"""A servo of its own: fine substeps, nothing of canwall's physics; and random ones."""

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from rig import settings_with

from canwall.config import Settings

Array = NDArray[np.float64]
#: Substeps of a period; a tick of the drive is as exact as they are short.
SUBSTEPS = 200


@dataclass(frozen=True)
class Truth:
    """Parameters of a servo, SI units; delay in periods, drive cycle in seconds."""

    inertia: float = 1e-4
    viscous: float = 5e-4
    coulomb: float = 0.01
    stiction: float = 0.015
    bias: float = 0.0
    cogging: float = 0.003
    cogs: int = 24
    lag: float = 1e-4
    delay: float = 1.0
    drive_cycle: float = 0.0
    clock_ppm: float = 50.0
    counts: int = 131072
    shaft_hz: float = 0.0
    shaft_damping: float = 0.02
    rotor_part: float = 0.4
    torque_scale: float = 1.0
    torque_step: float = 3e-4

    @property
    def total_delay(self) -> float:
        return self.delay + self.drive_cycle / 1e-3


@numba.njit(cache=True)
def run_period(state, coming, p, push, period, substeps):
    """Move on by a period; returns nothing, state is changed in place.

    state: rotor y, v; load y, v; current; time since the start [s]; torque in force; latched y.
    coming: torque set before, torque now, and when the latter takes effect [s].
    """
    (
        mass,
        viscous,
        coulomb,
        stiction,
        bias,
        cogging,
        cogs,
        lag,
        shaft_hz,
        zeta,
        rotor,
        scale,
        drive_cycle,
    ) = p
    h = period / substeps
    y, v, yl, vl, current, t, force, latched = state
    elastic = shaft_hz > 0.0
    mr = mass * rotor if elastic else mass
    ml = mass - mr
    mu = mr * ml / mass if elastic else 0.0
    w = 2.0 * math.pi * shaft_hz
    ks, ds = mu * w * w, 2.0 * zeta * mu * w
    decay = math.exp(-h / lag) if lag > 0.0 else 0.0
    for _ in range(substeps):
        # The drive's ticks, at which it latches its position and takes a torque over.
        tick = drive_cycle <= 0.0 or math.floor((t + 1e-12) / drive_cycle) != math.floor(
            (t + 1e-12 - h) / drive_cycle
        )
        if tick:
            latched = y
        if coming[2] >= 0.0 and t + 0.5 * h >= coming[2] and tick:
            force = coming[1]
            coming[2] = -1.0
        wanted = force * scale
        mean = wanted + (current - wanted) * (1.0 - decay) * lag / h if lag > 0.0 else wanted
        current = wanted + (current - wanted) * decay
        x = y * cogs / (2.0 * math.pi)
        x = x - math.floor(x + 0.25)
        tri = 4.0 * x if x < 0.25 else 2.0 - 4.0 * x
        u = mean + bias - cogging * tri + push
        # Leapfrog: exact for a constant force, without damping of its own.
        y += 0.5 * h * v
        if elastic:
            yl += 0.5 * h * vl
        link = ks * (y - yl) + ds * (v - vl) if elastic else 0.0
        free = u - viscous * v - link
        if v == 0.0 and abs(free) <= stiction:
            new = 0.0
        else:
            new = v + h * (free - math.copysign(coulomb, free if v == 0.0 else v)) / mr
            if new * v < 0.0:
                new = 0.0
        v = new
        y += 0.5 * h * v
        if elastic:
            vl += h * link / ml
            yl += 0.5 * h * vl
        t += h
    state[:] = (y, v, yl, vl, current, t, force, latched)


def play(settings: Settings, truth: Truth, excitation, hand=lambda k, y, v: 0.0):
    """Positions and torques of an excitation on a servo, shapes (n,)."""
    period, count = settings.bus.cycle_s, 2.0 * math.pi / truth.counts
    # Ticks of a drifting clock, seen in SYNC time.
    cycle = truth.drive_cycle * (1.0 + 1e-6 * truth.clock_ppm)
    p = (
        truth.inertia,
        truth.viscous,
        truth.coulomb,
        truth.stiction,
        truth.bias,
        truth.cogging,
        float(truth.cogs),
        truth.lag,
        truth.shaft_hz,
        truth.shaft_damping,
        truth.rotor_part,
        truth.torque_scale,
        cycle,
    )
    state, coming = np.zeros(8), np.array([0.0, 0.0, -1.0])
    positions, torques, on_the_way = [], [], []
    nm_per_mille = 0.637e-3
    k = 0
    substep = period / SUBSTEPS
    shift = 0.0137 * period
    state[5] = shift
    while True:
        shown = state[7] if truth.drive_cycle > 0.0 else state[0]
        position = round(shown / count) * count
        wanted = excitation.next(position)
        if wanted is None:
            break
        torque = round(wanted / nm_per_mille) * nm_per_mille
        positions.append(position)
        torques.append(torque)
        sent = round(torque / truth.torque_step) * truth.torque_step
        on_the_way.append((k + truth.delay, sent))
        push = hand(k, state[0], state[1])
        # Pieces of the period between the changes of the torque.
        at = 0.0
        while on_the_way and on_the_way[0][0] < k + 1 - 1e-9:
            when, sent = on_the_way.pop(0)
            part = round((when - k) * SUBSTEPS)
            steps = part - round(at * SUBSTEPS)
            if steps > 0:
                run_period(state, coming, p, push, steps * substep, steps)
            coming[1], coming[2] = sent, state[5] if cycle else 0.0
            if not cycle:
                coming[2] = 0.0
            at = part / SUBSTEPS
        steps = SUBSTEPS - round(at * SUBSTEPS)
        if steps > 0:
            run_period(state, coming, p, push, steps * substep, steps)
        k += 1
    return np.array(positions), np.array(torques)


def free_settings(inertia: float = 1.64e-4, **more) -> Settings:
    return settings_with({"mechanics.inertia_kg_m2": inertia, **more})


def random_servo(seed: int) -> tuple[Truth, Settings]:
    """A realistic servo, and a configuration that knows its inertia only roughly."""
    draw = np.random.default_rng([14, seed])

    def between(low: float, high: float) -> float:
        return float(np.exp(draw.uniform(np.log(low), np.log(high))))

    inertia = between(5e-5, 6e-4)
    coulomb = between(0.004, 0.03)
    delay = float(draw.choice([1.0, 1.0, 0.36, 1.5]))
    drive_cycle = float(draw.choice([0.0, 1.25e-4, 2.5e-4, 5e-4]))
    truth = Truth(
        inertia=inertia,
        viscous=between(2e-4, 2e-3),
        coulomb=coulomb,
        stiction=coulomb * draw.uniform(1.0, 1.6),
        bias=float(draw.choice([0.0, 0.004])),
        cogging=draw.uniform(0.0, 0.006),
        cogs=int(draw.choice([24, 36, 60])),
        lag=1.0 / (2.0 * np.pi * between(600.0, 2200.0)),
        delay=delay,
        # A torque that acts on reception waits for a tick that drifts past it.
        drive_cycle=0.0 if delay < 1.0 else drive_cycle,
        clock_ppm=draw.uniform(-80.0, 80.0),
        counts=int(draw.choice([131072, 131072, 65536, 1048576])),
        shaft_hz=float(draw.choice([0.0, 1.0])) * between(180.0, 480.0),
        shaft_damping=between(0.01, 0.05),
        rotor_part=draw.uniform(0.3, 0.7),
        torque_scale=1.0,
        torque_step=3e-4,
    )
    known = inertia * between(0.7, 1.4)
    return truth, free_settings(known, **{"mechanics.coulomb_nm": 0.01})
