"""The hand on the simulated drive's handle: its force, period by period.

The hand is a mass, a spring and a damper about a moving hand position, and a muscle torque
(docs/laws.md). By its script it strikes: it goes to where it presses, stays, and withdraws.
It moves as hands do, with the least jerk (Flash and Hogan 1985). At each SYNC it is exactly on
that path, between two of them on the straight line that joins them, so that over one period all
its forces are affine functions of time and the motion stays exact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.config import Hand, Move, RandomStrikes

Array = NDArray[np.float64]


def _least_jerk(s: Array) -> Array:
    """Return the way from rest at 0 to rest at 1 in unit time."""
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def pressing(hand: Hand, period_s: float, periods: int, first: int = 0) -> Array:
    """Return how far the hand is from resting (0) to pressing (1), at SYNC first … first + periods.

    Shape (periods + 1,). Each strike takes approach_s, press_s and withdraw_s; after the last one
    the hand rests.
    """
    times, stages = [0.0], [0.0]
    for strike in range(hand.strikes):
        start = hand.first_strike_s + strike * hand.interval_s
        arrived = start + hand.approach_s
        leaving = arrived + hand.press_s
        times += [start, arrived, leaving, leaving + hand.withdraw_s]
        stages += [0.0, 1.0, 1.0, 0.0]
    return _least_jerk(np.interp(_instants(period_s, periods, first), times, stages))


def _instants(period_s: float, periods: int, first: int) -> Array:
    return np.arange(first, first + periods + 1, dtype=np.float64) * period_s


def random_moves(strikes: RandomStrikes, rest_rad: float) -> list[Move]:
    """Return the strikes of a seed as a script: rest, approach, press, rest, release, and again."""
    draw = np.random.default_rng(strikes.seed).uniform
    moves = []
    for _ in range(strikes.strikes):
        pause, approach, press, withdraw, depth, torque = (
            float(draw(*bounds))
            for bounds in (
                strikes.pause_s,
                strikes.approach_s,
                strikes.press_s,
                strikes.withdraw_s,
                strikes.press_rad,
                strikes.press_torque_nm,
            )
        )
        moves += [
            Move(move="rest", duration_s=pause),
            # The muscle builds up on the way, as it does in a strike of `Hand`.
            Move(move="press", duration_s=approach, torque_nm=torque, position_rad=depth),
            Move(move="rest", duration_s=press),
            Move(move="release", duration_s=withdraw, position_rad=rest_rad),
        ]
    return moves


@dataclass(frozen=True)
class _Knots:
    """Instants of rest on the way of the hand, which moves with the least jerk between two."""

    times: Array
    positions: Array
    torques: Array

    @classmethod
    def of(cls, moves: list[Move], rest_rad: float) -> "_Knots":
        knots = [(0.0, rest_rad, 0.0)]

        def go(duration_s: float, position: float, torque: float) -> None:
            knots.append((knots[-1][0] + duration_s, position, torque))

        for move in moves:
            _, position, torque = knots[-1]
            if move.move == "tap":
                assert move.position_rad is not None
                go(0.5 * move.duration_s, move.position_rad, torque)
                go(0.5 * move.duration_s, position, torque)
                continue
            if move.move == "release":
                position, torque = rest_rad, 0.0
            if move.position_rad is not None:
                position = move.position_rad
            if move.torque_nm is not None:
                torque = move.torque_nm
            go(move.duration_s, position, torque)
        return cls(*np.array(knots).T)

    def at(self, t: Array) -> tuple[Array, Array]:
        """Return hand position [rad] and muscle torque [N·m] at times t; the last ones stay."""
        stage = np.interp(t, self.times, np.arange(len(self.times), dtype=np.float64))
        knot = np.minimum(stage.astype(np.int64), len(self.times) - 2)
        share = _least_jerk(stage - knot)
        return (
            self.positions[knot] + share * np.diff(self.positions)[knot],
            self.torques[knot] + share * np.diff(self.torques)[knot],
        )


def _path_and_torque(hand: Hand, period_s: float, periods: int, first: int) -> tuple[Array, Array]:
    """Return hand position [rad] and muscle torque [N·m] at SYNC first … first + periods.

    Both (periods + 1,).
    """
    moves = list(hand.script)
    if hand.random is not None:
        moves = random_moves(hand.random, hand.rest_rad)
    if moves:
        return _Knots.of(moves, hand.rest_rad).at(_instants(period_s, periods, first))
    stage = pressing(hand, period_s, periods, first)
    path = hand.rest_rad + (hand.press_rad - hand.rest_rad) * stage
    return path, hand.press_torque_nm * stage


def hand_path(hand: Hand, period_s: float, periods: int, first: int = 0) -> Array:
    """Return the hand position [rad] at SYNC first … first + periods; shape (periods + 1,)."""
    return _path_and_torque(hand, period_s, periods, first)[0]


def hand_force(hand: Hand, period_s: float, periods: int, first: int = 0) -> tuple[Array, Array]:
    """Return the force of the hand on the handle, (u₀, u₁) of u₀ + u₁·t in each period.

    The periods are those from SYNC `first` on. Shape of both (periods,); u₀ [N·m] and u₁ [N·m/s]
    on the drive's axis. The part that depends on the handle's own position and velocity belongs to
    the plant (`servo.hand_plant`).
    """
    path, torque = _path_and_torque(hand, period_s, periods, first)
    speed = np.diff(path) / period_s
    spring, damper = hand.stiffness_nm_per_rad, hand.damping_nm_s_per_rad
    constant = spring * path[:-1] + damper * speed + torque[:-1]
    return constant, spring * speed + np.diff(torque) / period_s
