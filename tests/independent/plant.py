"""A servo in a hand, written apart from canwall's physics, simulated drive and sweeps.

Only the compiled cycle is canwall's. The motion is integrated in small fixed steps, so that it
shares neither code nor method with the exact motion of the package: handle and hand move as one
mass under torque, friction with a higher break-away torque, and the hand's spring. The torque
follows its command by a first-order lag; the drive latches the position at its own ticks, takes
torques over at them, and its crystal drifts against the SYNC.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from canwall import config
from canwall.compiled import copied
from canwall.config import Settings
from canwall.cycle import make_cycle, run_laws, start_at, step_address, step_at
from canwall.cycle.state import set_wall
from canwall.drive import DriveSetup, Field, PdoLayout
from canwall.record import ROW, Phase
from canwall.units import DriveUnits

Array = NDArray[np.float64]

RADIUS_M = 0.08
COUNTS_PER_TURN = 131072
RATED_NM = 0.637
RAD_PER_COUNT = 2.0 * math.pi / COUNTS_PER_TURN
NM_PER_MILLE = RATED_NM / 1000.0

#: Steps of the integration per period, at 1 kHz of 7.8 µs.
STEPS = 128
#: Samples of the hand's force per period.
FORCES = 4


class Operator(NamedTuple):
    """Hand at the shaft: inertia [kg·m²], damping [N·m·s/rad], stiffness [N·m/rad]."""

    mass: float
    viscous: float
    spring: float


def _at_handle(mass_kg: float, damping: float, stiffness: float) -> Operator:
    """Convert from the handle: kg, N·s/m, N/m."""
    return Operator(*(value * RADIUS_M**2 for value in (mass_kg, damping, stiffness)))


#: Within the ranges of docs/results.md.
OPERATORS = {
    "none": Operator(0.0, 0.0, 0.0),
    "finger": _at_handle(0.004, 2.0, 300.0),
    "finger20": _at_handle(0.020, 4.0, 500.0),
    "grip": _at_handle(0.050, 6.0, 800.0),
    "hand": _at_handle(0.200, 6.5, 400.0),
    "arm": _at_handle(0.550, 6.5, 135.0),
}


class Servo(NamedTuple):
    """The drive with its handle; zero for what an ideal one has not."""

    mass: float = 1e-4
    viscous: float = 5e-4
    coulomb: float = 0.01
    stiction: float = 1.5  # of Coulomb friction
    lag_s: float = 1.0 / (2.0 * math.pi * 1600.0)
    drive_cycle_s: float = 0.00025
    clock_ppm: float = 50.0
    torque_error: float = 0.0

    def delay(self, period: float) -> float:
        """Return D: a period by the synchronous RPDO, the drive's cycle and the lag [periods]."""
        return 1.0 + (self.drive_cycle_s + self.lag_s) / period


SERVOS = {
    "1600": Servo(),
    "800": Servo(lag_s=1.0 / (2.0 * math.pi * 800.0), drive_cycle_s=0.0004),
}


class Strike(NamedTuple):
    """One strike: speed of approach [rad/s], phases of contact and of the drive's ticks [0 … 1].

    The hand presses with `press` [N·m]; without a hand a constant torque does. Contact is near
    `contact_s`. At `change_s` the mass and damping of another hand come to be at the handle.
    """

    speed: float
    phase: float
    tick_phase: float
    press: float = 0.15
    contact_s: float = 0.05
    change_s: float = math.inf


@njit(error_model="numpy")
def _move(
    step: int,
    cycle: Any,
    row: Any,
    period: float,
    servo: Servo,
    operator: Operator,
    later: Operator,
    strike: Strike,
    stiffness: float,
    damping: float,
    continuous: bool,
    y: Array,
    hand: Array,
    applied: Array,
    in_force: Array,
) -> int:
    """Fill y at each SYNC, the hand's force, the mean torque, and (K, mass) in force.

    With `continuous` the wall is max(0, −K·y − B·ẏ) without drive or sampling. Returns the number
    of cycles up to a trip.
    """
    h = period / STEPS
    decay = math.exp(-h / servo.lag_s) if servo.lag_s > 0.0 else 0.0
    m_h, b_h, k_h = operator
    mass, viscous = servo.mass + m_h, servo.viscous + b_h
    v = -strike.speed
    place = (strike.contact_s + strike.phase * period) * strike.speed
    press = strike.press if k_h > 0.0 else 0.4 * strike.press
    # The rest of the spring leads such that the hand moves at its speed, then stops as it presses.
    lead = (b_h * strike.speed + servo.coulomb) / k_h if k_h > 0.0 else 0.0
    deepest = press / k_h if k_h > 0.0 else 0.0
    tick_period = servo.drive_cycle_s * (1.0 + 1e-6 * servo.clock_ppm)
    next_tick = strike.tick_phase * servo.drive_cycle_s
    latched = place
    received = commanded = torque = 0.0
    t = 0.0
    for j in range(len(y)):
        y[j] = place
        if not continuous:
            if servo.drive_cycle_s == 0.0:
                latched = place
                commanded = received
            counts = math.floor(latched / RAD_PER_COUNT + 0.5)
            shown = cycle[0].torque_per_mille
            data = (counts & 0xFFFFFFFF) | (0x27 << 32) | ((shown & 0xFFFF) << 48)
            step_at(step, cycle, row, data, True)
            # The drive has what was sent after the last SYNC; this comes with the next one.
            following = cycle[0].torque_per_mille * NM_PER_MILLE * (1.0 + servo.torque_error)
            in_force[j, 0] = row[0].stiffness_in_force
            in_force[j, 1] = row[0].mass_est
            if cycle[0].trip != 0:
                return j
        mean = 0.0
        total = 0.0
        for i in range(STEPS):
            if t >= strike.change_s and later.mass != m_h:
                m_h, b_h = later.mass, later.viscous
                mass, viscous = servo.mass + m_h, servo.viscous + b_h
            if continuous:
                torque = 0.0
                if place < 0.0:
                    torque = max(0.0, -stiffness * place - damping * v)
            else:
                if servo.drive_cycle_s > 0.0 and t >= next_tick:
                    latched = place
                    commanded = received
                    next_tick += tick_period
                torque = commanded + (torque - commanded) * decay
            if k_h > 0.0:
                rest = strike.contact_s * strike.speed - strike.speed * t - lead
                spring = k_h * (max(rest, -deepest - lead) - place)
            else:
                spring = -press * min(1.0, max(0.0, (t - strike.contact_s) / 0.1))
            push = torque + spring - viscous * v
            friction = servo.coulomb
            if v > 0.0:
                push -= friction
            elif v < 0.0:
                push += friction
            elif abs(push) > servo.stiction * friction:
                push -= math.copysign(friction, push)
            else:
                push = 0.0
            a = push / mass
            v_next = v + a * h
            if v * v_next < 0.0 and friction > 0.0:
                # Friction stops the motion before it turns it round.
                a, v_next = -v / h, 0.0
            place += h * 0.5 * (v + v_next)
            v = v_next
            t += h
            mean += torque
            total += m_h * a + b_h * v - spring if m_h > 0.0 else servo.mass * a
            if (i + 1) % (STEPS // FORCES) == 0:
                hand[j * FORCES + i // (STEPS // FORCES)] = total / (STEPS // FORCES) / RADIUS_M
                total = 0.0
        applied[j] = mean / STEPS
        if not continuous:
            received = following
    return len(y)


@dataclass(frozen=True)
class Signals:
    """Signals of one strike, and those of the continuous wall in the same hand."""

    period: float
    stiffness: float
    y: Array
    hand: Array
    applied: Array
    stiffness_in_force: Array
    mass: Array
    referent_y: Array
    referent_hand: Array
    tripped: bool


def prepare(keys: dict[str, Any]) -> Settings:
    """Return the settings of config/ideal.toml with these keys, without schedule and simulation."""
    settings = config.load(
        config.shipped("config/ideal.toml"),
        {
            "simulation.ideal": False,
            "limits.torque_nm": 1.9,
            "limits.speed_rad_s": 1000.0,
            "limits.stuck_rad": 0.0,
            "limits.torque_error_nm": 0.0,
            "run.ramp_in_s": 0.0,
            "estimator.measure_delay": False,
            **keys,
        },
    )
    return settings.model_copy(update={"schedule": (), "simulation": None})


_TPDO = PdoLayout(0, (Field(0x6064, 0, 0, 32), Field(0x6041, 0, 32, 16), Field(0x6077, 0, 48, 16)))
_RPDO = PdoLayout(0, (Field(0x6071, 0, 0, 16),))


class Bench:
    """One configuration on one servo, to be struck by any operator at any stiffness."""

    def __init__(self, keys: dict[str, Any], servo: Servo, seconds: float = 1.2) -> None:
        self.settings = prepare(keys)
        self.servo = servo
        self.period = self.settings.bus.cycle_s
        self.cycles = round(seconds / self.period)
        self._laws = run_laws(self.settings)
        units = DriveUnits.behind_gear(COUNTS_PER_TURN, RATED_NM, 1.0)
        setup = DriveSetup(units, 0, _TPDO, _RPDO, torque_limit_nm=1.911)
        self._cycle = make_cycle(self.settings, setup, self._laws)
        self._cycle["phase"] = Phase.RENDERING

    def strike(
        self,
        operator: Operator,
        strike: Strike,
        stiffness: float,
        damping: float = 0.0,
        later: Operator | None = None,
        referent_damping: float | None = None,
    ) -> Signals:
        """Strike a wall; the referent has the same K and the damping given, else the wall's."""
        cycle = copied(self._cycle)
        wall = self.settings.wall.model_copy(
            update={"stiffness_nm_per_rad": stiffness, "damping_nm_s_per_rad": damping}
        )
        set_wall(cycle, wall, self._laws)
        row = np.zeros(1, ROW)
        n = self.cycles
        y, applied, in_force = np.zeros(n), np.zeros(n), np.zeros((n, 2))
        hand = np.zeros(n * FORCES)
        start = (strike.contact_s + strike.phase * self.period) * strike.speed
        start_at(cycle, math.floor(start / RAD_PER_COUNT + 0.5))
        if referent_damping is None:
            referent_damping = damping
        operators = operator, operator if later is None else later
        done = _move(
            step_address(), cycle, row, self.period, self.servo, *operators, strike, stiffness,
            damping, False, y, hand, applied, in_force,
        )  # fmt: skip
        referent_y, referent_hand = np.zeros(n), np.zeros(n * FORCES)
        _move(
            step_address(), cycle, row, self.period, self.servo, *operators, strike, stiffness,
            referent_damping, True, referent_y, referent_hand, np.zeros(n), np.zeros((n, 2)),
        )  # fmt: skip
        return Signals(
            self.period, stiffness, y, hand, applied, in_force[:, 0], in_force[:, 1],
            referent_y, referent_hand, done < n,
        )  # fmt: skip


#: Length of the stretch at the end of a strike that has to be quiet [s].
SETTLED_S = 0.3
QUIET_N = 0.1


def ripple(force: Array, period: float) -> float:
    """Return the r.m.s. in 20–500 Hz of a hand's force [N], sampled FORCES times a period."""
    n = len(force)
    t = np.linspace(-1.0, 1.0, n)
    centred = force - np.polynomial.Polynomial.fit(t, force, 1)(t)
    spectrum = np.fft.rfft(centred) / n
    frequency = np.fft.rfftfreq(n, period / FORCES)
    inside = (frequency >= 20.0) & (frequency <= 500.0)
    return float(np.sqrt(2.0 * np.sum(np.abs(spectrum[inside]) ** 2)))


def switches(y: Array) -> int:
    """Return how often contact is made or broken."""
    return int(np.count_nonzero(np.diff(y < 0.0)))


def judge(s: Signals) -> tuple[bool, float, float]:
    """Return (quiet, ripple [N], excess amplitude [rad]) of the settled stretch (section 5)."""
    if s.tripped:
        return False, math.inf, math.inf
    n = round(SETTLED_S / s.period)
    felt = ripple(s.hand[-n * FORCES :], s.period)
    felt_referent = ripple(s.referent_hand[-n * FORCES :], s.period)
    excess = float(np.ptp(s.y[-n:]) - np.ptp(s.referent_y[-n:]))
    room = max(6.0 * RAD_PER_COUNT, 3.0 * NM_PER_MILLE / s.stiffness)
    counts, allowed = switches(s.y[-n:]), switches(s.referent_y[-n:])
    quiet = (
        felt <= max(QUIET_N, 1.2 * felt_referent)
        and excess <= room
        and counts < max(3.0, 1.25 * allowed + 2.0)
    )
    return quiet, felt, excess


def first_strike(s: Signals) -> tuple[float, float]:
    """Return depth of the first contact over the referent's, and speed out over speed in."""

    def depth(y: Array) -> tuple[float, float, float]:
        inside = np.flatnonzero(y < 0.0)
        if not len(inside):
            return 0.0, 0.0, 0.0
        begin = inside[0]
        outside = np.flatnonzero(y[begin:] >= 0.0)
        end = begin + outside[0] if len(outside) else len(y)
        speed_in = (y[begin - 3] - y[begin]) / 3.0 if begin >= 3 else 0.0
        leaves = end + 3 < len(y)
        speed_out = (y[end + 2] - y[end - 1]) / 3.0 if leaves else 0.0
        return -float(y[begin:end].min()), float(speed_in), float(speed_out)

    deep, speed_in, speed_out = depth(s.y)
    referent, _, _ = depth(s.referent_y)
    return deep / referent if referent else math.inf, speed_out / speed_in if speed_in else 0.0


STRIKES = tuple(
    Strike(speed, phase, tick)
    for speed, phase, tick in (
        (0.3, 0.0, 0.1), (0.3, 0.5, 0.7), (0.5, 0.25, 0.4), (0.8, 0.75, 0.9),
        (1.0, 0.1, 0.3), (1.5, 0.6, 0.6), (2.0, 0.35, 0.0), (3.0, 0.85, 0.5),
    )
)  # fmt: skip


def k_limit(
    bench: Bench,
    operator: Operator,
    damping_ratio: float = 0.0,
    damping_normalised: float = 0.0,
    scan: Array | None = None,
) -> tuple[float, float]:
    """Return the largest KT²/m below the first failure of an upward scan, and the failing one.

    damping_ratio is the referent's, damping_normalised = BT/m that of a wall with fixed B.
    """
    mass = bench.servo.mass + operator.mass
    passed = 0.0
    for normalised in np.geomspace(0.01, 2.5, 26) if scan is None else scan:
        stiffness = float(normalised) * mass / bench.period**2
        damping = damping_normalised * mass / bench.period
        referent = damping or 2.0 * damping_ratio * math.sqrt(stiffness * mass)
        for strike in STRIKES:
            s = bench.strike(operator, strike, stiffness, damping, referent_damping=referent)
            if not judge(s)[0]:
                return passed, float(normalised)
        passed = float(normalised)
    return passed, math.inf
