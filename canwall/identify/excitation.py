"""Torques that excite a servo: slow ramps at rest, and sweeps both ways with a signal on top.

The handle follows a reference, so that it stays within its travel and below a speed; the gains
are low, and need the inertia of the configuration only roughly. On top come pairs of opposite
torques of random sign, and multisines; both leave no lasting speed.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.config import Settings
from canwall.identify.estimates import UntellingDataError

Array = NDArray[np.float64]

#: The torques are random but the same every time.
_SEED = 402
#: Share of what the limits allow that is used: of travel, speed and torque.
_TRAVEL, _SPEED, _TORQUE = 0.8, 0.5, 0.5
#: Natural frequency of the loop around the reference [rad/s], and its damping ratio.
_OMEGA, _DAMPING_RATIO = 25.0, 0.7
#: Time in which the reference gets from rest to its speed, and time of the fastest sweep [s].
_REVERSAL_S, _FASTEST_SWEEP_S = 0.15, 0.25
#: Longest period of the SYNC, of which the shortest of these times has some [s].
SLOWEST_SYNC_S = 0.05
#: Speeds of the sweeps as parts of the largest one, and seconds for each.
_SWEEPS = ((1.0, 10.0), (0.5, 9.0), (0.2, 8.0), (0.07, 6.0))
#: Change of the speed by the signal on top, as a part of that of the sweep.
_RIPPLE = 0.3
#: Part of the signal on top that a rotor at the end of an elastic shaft bears, with which the
#: first sweep begins, and factors a cycle by which it grows and shrinks.
_FIRST_GAIN, _GROWS, _SHRINKS = 0.05, 1.004, 0.99
#: Largest torque of the signal on top, as a part of the largest one.
_ON_TOP = 0.7
#: Duration of a ramp, of the rest before it, and their number [s].
_RAMP_S, _REST_S, _RAMPS = 0.35, 0.15, 16
#: Travel beyond which a handle is not where the reference wants it, as a part of the limits.
_ASTRAY = 0.95


@dataclass(frozen=True)
class Bounds:
    """Bounds of the excitation around the first position [rad, rad/s, N·m]."""

    travel_rad: float
    speed_rad_s: float
    torque_nm: float

    @classmethod
    def of(cls, settings: Settings, position: float, torque_nm: float) -> "Bounds":
        """Return the bounds at a position, for a drive that gives at most `torque_nm`.

        Raises UntellingDataError if the position is too near to a limit: the drive is enabled.
        """
        limits = settings.limits
        low, high = limits.position_rad
        room = min(position - low, high - position)
        if room <= 0.1 * (high - low):
            raise UntellingDataError(
                f"limits.position_rad: the handle is at {position:.3g} rad, too near to a limit "
                f"to be moved both ways; bring it to the middle of [{low:g}, {high:g}]"
            )
        travel = _TRAVEL * room
        torque = _TORQUE * min(limits.torque_nm, torque_nm)
        # The reference has to be able to turn round within the travel.
        inertia = settings.mechanics.inertia_kg_m2
        fastest = min(
            _SPEED * limits.speed_rad_s,
            2.0 * travel / _FASTEST_SWEEP_S,
            0.5 * torque / inertia * _REVERSAL_S,
        )
        return cls(travel, fastest, torque)


class Excitation:
    """Torques for one axis, cycle by cycle; they depend on the positions alone."""

    #: Duration at most [s].
    duration_s = (
        _RAMPS * (_RAMP_S + 2.0 * _REST_S) + sum(seconds for _, seconds in _SWEEPS) + 2.0 * _REST_S
    )

    def __init__(self, settings: Settings, torque_nm: float) -> None:
        """Prepare the excitation for a drive that gives at most `torque_nm`."""
        self._settings = settings
        self._largest = torque_nm
        self._period = settings.bus.cycle_s
        self._random = np.random.default_rng(_SEED)
        # Made here: no cycle waits for it.
        self._signals = [self._signal(round(seconds / self._period)) for _, seconds in _SWEEPS]
        self._torques: Iterator[float] | None = None
        self._position = self._speed = self._moved = 0.0
        #: Mean square of the change of the speed from cycle to cycle, and the gain against it.
        self._jolt, self._gain = 0.0, _FIRST_GAIN

    def next(self, position: float, periods: int = 1) -> float | None:
        """Return the torque after a position [N·m], None at the end.

        Args:
            position: Latest position [rad].
            periods: Periods since the position before; 0: there is none since the last call.

        Raises:
            UntellingDataError: If the handle is not where it should be, or has no room.
        """
        if self._torques is None:
            self._position, self._start = position, position
            self.bounds = Bounds.of(self._settings, position, self._largest)
            self._torques = self._all()
        elif periods:
            moved = (position - self._position) / (periods * self._period)
            self._jolt += 0.02 * ((moved - self._moved) ** 2 - self._jolt)
            self._moved = moved
            # Some smoothing: a coarse encoder has one count in many cycles.
            self._speed += 0.5 * (moved - self._speed)
            self._position = position
        return next(self._torques, None)

    def _all(self) -> Iterator[float]:
        yield from self._ramps()
        for (part, _), signal in zip(_SWEEPS, self._signals, strict=True):
            yield from self._sweep(part * self.bounds.speed_rad_s, signal)
        yield from self._follow(0.0, 2.0 * _REST_S)

    def _ramps(self) -> Iterator[float]:
        """Break the handle loose at several places, in both directions."""
        limit = self.bounds.torque_nm
        cycles = round(_RAMP_S / self._period)
        # A tenth of the torque in each ramp; friction of a servo is far below.
        slope = 0.1 * limit / cycles
        freed = 3.0 * 2.0 * math.pi / 4096.0
        for k in range(_RAMPS):
            yield from self._zero(_REST_S)
            direction = 1.0 if k % 2 == 0 else -1.0
            rest = self._position
            for j in range(cycles):
                if abs(self._position - rest) > freed:
                    break
                yield direction * slope * (j + 1)
            yield 0.0
            if k + 1 < _RAMPS:
                # Elsewhere on the cogging's map.
                target = self._start + self.bounds.travel_rad * 0.2 * float(
                    self._random.uniform(-1.0, 1.0)
                )
                yield from self._go(target)
        yield 0.0

    def _zero(self, seconds: float) -> Iterator[float]:
        for _ in range(round(seconds / self._period)):
            self._watch()
            yield 0.0

    def _go(self, target: float) -> Iterator[float]:
        """Move near to a position within _REST_S."""
        cycles = round(_REST_S / self._period)
        begin = self._position
        for j in range(cycles):
            share = (j + 1) / cycles
            smooth = share * share * (3.0 - 2.0 * share)
            slope = 6.0 * share * (1.0 - share) / _REST_S
            yield self._loop(begin + (target - begin) * smooth, (target - begin) * slope)

    def _follow(self, speed: float, seconds: float) -> Iterator[float]:
        for _ in range(round(seconds / self._period)):
            yield self._loop(self._position, speed)

    def _sweep(self, speed: float, signal: list[float]) -> Iterator[float]:
        """Sweep to and fro under a signal that changes the speed by a part of it."""
        period, travel = self._period, self.bounds.travel_rad
        limit = self.bounds.torque_nm
        most = _ON_TOP * limit
        mass = self._settings.mechanics.inertia_kg_m2
        amplitude = min(_RIPPLE * speed * mass / period, most)
        rate = speed / _REVERSAL_S
        reference, moving, direction = self._position, 0.0, 1.0
        for one in signal:
            offset = reference - self._start
            stopping = 0.5 * moving * moving / rate
            if direction * offset > travel - stopping:
                direction = -direction
            moving += min(max(direction * speed - moving, -rate * period), rate * period)
            reference += moving * period
            # A shaft may swing, and the inertia be far less than that of the configuration.
            self._gain *= _SHRINKS if self._jolt > (_RIPPLE * speed) ** 2 else _GROWS
            self._gain = min(self._gain, 1.0)
            on_top = min(max(amplitude * one, -most), most)
            wanted = self._loop(reference, moving) + self._gain * on_top
            yield min(max(wanted, -limit), limit)

    def _signal(self, cycles: int) -> list[float]:
        """Return pairs in the first half of the cycles, a multisine in the second, about 1 high."""
        signs = self._random.choice([-1.0, 1.0], size=cycles // 4)
        pairs = np.stack([signs, -signs], axis=1).reshape(-1)
        # Equal amplitudes up to the Nyquist frequency, random phases, period of about a second.
        n = cycles - len(pairs)
        length = min(n, max(64, round(1.0 / self._period)))
        frequencies = np.fft.rfftfreq(length, self._period)
        spectrum = np.exp(2j * np.pi * self._random.uniform(size=len(frequencies)))
        spectrum[frequencies < 0.02 / self._period] = 0.0
        tones = np.fft.irfft(spectrum, length)
        repeated = np.resize(tones / tones.std() / 1.5, n)
        return [*pairs.tolist(), *repeated.tolist()]

    def _loop(self, position: float, speed: float) -> float:
        """Return the torque that leads the handle to the reference."""
        self._watch()
        mechanics, limit = self._settings.mechanics, self.bounds.torque_nm
        mass = mechanics.inertia_kg_m2
        stiffness, damping = mass * _OMEGA**2, 2.0 * _DAMPING_RATIO * mass * _OMEGA
        friction = mechanics.coulomb_nm * math.copysign(1.0, speed) if speed else 0.0
        pulled = stiffness * (position - self._position) + damping * (speed - self._speed)
        return min(max(pulled + friction, -limit), limit)

    def _watch(self) -> None:
        low, high = self._settings.limits.position_rad
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        if abs(self._position - middle) > _ASTRAY * half:
            raise UntellingDataError(
                f"the handle went to {self._position:.3g} rad, next to limits.position_rad: "
                f"something pushes it, or mechanics.inertia_kg_m2 is far off"
            )
        if abs(self._speed) > 0.9 * self._settings.limits.speed_rad_s:
            raise UntellingDataError(
                f"the handle went at {self._speed:.3g} rad/s, next to limits.speed_rad_s: "
                f"something pushes it, or mechanics.inertia_kg_m2 is far too large"
            )


class HandExcitation:
    """Small torques at a handle that somebody holds: a multisine up to 60 Hz."""

    duration_s = 12.0
    #: Highest frequency [Hz], and length of a period of the multisine [s].
    _HIGHEST_HZ, _PERIOD_S = 60.0, 2.0

    def __init__(self, settings: Settings, torque_nm: float) -> None:
        """Prepare the excitation for a drive that gives at most `torque_nm`."""
        period = settings.bus.cycle_s
        length = round(self._PERIOD_S / period)
        spectrum = np.zeros(length // 2 + 1, complex)
        highest = min(round(self._HIGHEST_HZ * self._PERIOD_S), len(spectrum) - 1)
        phases = np.random.default_rng(_SEED).uniform(size=highest)
        spectrum[1 : highest + 1] = np.exp(2j * np.pi * phases)
        one = np.fft.irfft(spectrum, length)
        amplitude = min(
            settings.estimator.measure_torque_nm,
            _TORQUE * min(settings.limits.torque_nm, torque_nm),
        )
        torques = np.clip(0.5 * amplitude * one / one.std(), -amplitude, amplitude)
        self._torques = iter(np.resize(torques, round(self.duration_s / period)).tolist())

    def next(self, position: float, periods: int = 1) -> float | None:
        """Return the torque of the next cycle [N·m], None at the end."""
        return next(self._torques, None)
