"""KT²/m of the laws in unknown hands, first strikes, changes of grip, on the plant written apart.

`python tests/independent/figures.py [SERVO] [COULOMB]`: SERVO "1600" or "800", see `plant.SERVOS`.
"""

import math
import sys
from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np
from plant import (
    FORCES,
    OPERATORS,
    SERVOS,
    STRIKES,
    Bench,
    Operator,
    Servo,
    Strike,
    first_strike,
    judge,
    k_limit,
)
from scipy.signal import butter, sosfilt
from scipy.stats import qmc

#: The laws' model of the drive with its handle; the delay is the true one.
_DRIVE = {
    "mechanics.inertia_kg_m2": 1e-4,
    "mechanics.viscous_nm_s_per_rad": 5e-4,
    "mechanics.coulomb_nm": 0.0,
}
#: Time after a change of grip from which on a force that is not quiet is late [s].
_LATE_S = 0.15
_DAMPINGS = (0.05, 0.1, 0.2, 0.4)  # BT/m


def unknown_hand(servo: Servo, law: str = "mean_force", **keys: Any) -> dict[str, Any]:
    """Return the keys of the one configuration for all operators."""
    return {
        **_DRIVE,
        "drive.drive_cycle_s": servo.drive_cycle_s,
        "drive.current_bandwidth_hz": 1.0 / (2.0 * math.pi * servo.lag_s),
        "operator.adapt": True,
        "wall.law": law,
        "wall.damping_ratio": 0.5,
        "wall.tension": "clamp",
        **keys,
    }


def sampled(law: str) -> dict[str, Any]:
    """Return the keys of a law without a model."""
    return {**_DRIVE, "wall.law": law}


def limits(servo: Servo) -> dict[str, list[tuple[float, float]]]:
    """Return (largest KT²/m before the first failure, first failure) of each law and operator."""
    adapting, half = (
        Bench(unknown_hand(servo, law), servo) for law in ("mean_force", "half_sample")
    )
    standard, damped = Bench(sampled("standard"), servo), Bench(sampled("damped"), servo)
    hands = OPERATORS.values()
    return {
        "mean_force, adapt, ζ 0.5": [k_limit(adapting, hand, 0.5) for hand in hands],
        "half_sample, adapt, ζ 0.5": [k_limit(half, hand, 0.5) for hand in hands],
        "standard": [k_limit(standard, hand) for hand in hands],
        "damped, best of 4 B": [
            max(k_limit(damped, hand, damping_normalised=b) for b in _DAMPINGS) for hand in hands
        ],
    }


def with_cap(servo: Servo, cap: float, seconds: float = 1.2) -> list[tuple[int, int, float, float]]:
    """Return for each operator (failures, strikes, fastest exit, K in force of min(K, m/T²))."""
    bench = Bench(unknown_hand(servo, **{"wall.cap": cap}), servo, seconds)
    found = []
    for hand in OPERATORS.values():
        mass = servo.mass + hand.mass
        failed = strikes = 0
        fastest, least = 0.0, math.inf
        for stiffness in np.geomspace(30.0, 2000.0, 10).tolist():
            most = min(stiffness, mass / bench.period**2)
            damping = math.sqrt(most * mass)
            for strike in STRIKES:
                s = bench.strike(hand, strike, stiffness, referent_damping=damping)
                failed += not judge(s)[0]
                strikes += 1
                fastest = max(fastest, first_strike(s)[1])
                least = min(least, float(s.stiffness_in_force[-1]) / most)
        found.append((failed, strikes, fastest, least))
    return found


def first_strikes(
    bench: Bench, hand: Operator, stiffness: float, count: int
) -> tuple[list[float], list[float]]:
    """Return depths over the damped referent's, and speeds out over in, of seeded strikes."""
    mass = bench.servo.mass + hand.mass
    rng = np.random.default_rng(1)
    depths, exits = [], []
    for _ in range(count):
        strike = Strike(math.exp(rng.uniform(math.log(0.3), 0.0)), rng.random(), rng.random())
        s = bench.strike(hand, strike, stiffness, referent_damping=math.sqrt(stiffness * mass))
        depth, speed_out = first_strike(s)
        depths.append(depth)
        exits.append(speed_out)
    return depths, exits


def drawn_strikes(count: int) -> tuple[Strike, ...]:
    """Return strikes at 0.3 to 3 rad/s, spread evenly over speeds and phases, always the same."""
    drawn = qmc.Halton(3, seed=7).random(count).tolist()
    return tuple(Strike(0.3 * 10.0**of_range, *phases) for of_range, *phases in drawn)


def after_change(
    bench: Bench, before: Operator, later: Operator, strikes: Sequence[Strike] = STRIKES[::2]
) -> tuple[float, float, float]:
    """Return how long after a change of grip the force is quiet, how long it was loud, its burst.

    Times in s, the burst in N, each the largest of all strikes. The mass and the damping of the
    hand change in contact. Quiet is a felt ripple below 0.3 N r.m.s. over 20 ms. In friction
    nothing may move for long, and the force becomes loud late.
    """
    change_s = 0.4
    longest = loud_for = burst = 0.0
    for strike in strikes:
        s = bench.strike(before, strike._replace(change_s=change_s), 200.0, later=later)
        rate = FORCES / s.period
        band = butter(2, (20.0, 500.0), "bandpass", fs=rate, output="sos")
        felt = sosfilt(band, s.hand - s.hand[0])[round(change_s * rate) :]
        window = round(0.02 * rate)
        power = np.convolve(felt**2, np.full(window, 1.0 / window), "same")
        loud = np.flatnonzero(power > 0.3**2)
        if len(loud):
            longest = max(longest, (loud[-1] + 1) / rate)
            loud_for = max(loud_for, (loud[-1] + 1 - loud[0]) / rate)
        burst = max(burst, float(np.max(np.abs(felt))))
    return longest, loud_for, burst


def main() -> None:
    name = sys.argv[1] if len(sys.argv) > 1 else "1600"
    servo = SERVOS[name]
    if len(sys.argv) > 2:
        servo = servo._replace(coulomb=float(sys.argv[2]))
    print(f"KT²/m, {name} Hz + {1e3 * servo.drive_cycle_s:g} ms, Coulomb {servo.coulomb:g} N·m")
    print("  ", *OPERATORS, sep="  ")
    for law, found in limits(servo).items():
        print(f"{law}:", "  ".join(f"{passed:.3g}" for passed, _ in found), flush=True)
    for cap in (0.5, 0.8, 1.0):
        for who, found in zip(OPERATORS, with_cap(servo, cap), strict=True):
            failed, strikes, fastest, least = found
            print(
                f"cap {cap:g} {who}: {failed}/{strikes} failed, exit {fastest:.2f}, K {least:.2f}"
            )
    bench = Bench(unknown_hand(servo), servo, 0.5)
    for name, hand in OPERATORS.items():
        depths, exits = first_strikes(bench, hand, 200.0, 48)
        deep = np.quantile(depths, 0.95)
        print(f"first strike, K 200 {name}: depth {deep:.2f} (95 %), exit {max(exits):.2f}")
    bench = Bench(unknown_hand(servo, **{"wall.cap": 0.8}), servo)
    hands = {name: hand for name, hand in OPERATORS.items() if hand.mass > 0.0}
    drawn = drawn_strikes(32)
    for (name, hand), (other, later) in permutations(hands.items(), 2):
        quiet_s, loud_s, burst = after_change(bench, hand, later)
        print(
            f"{name} to {other}: quiet after {1e3 * quiet_s:.0f} ms, "
            f"loud for {1e3 * loud_s:.0f} ms, burst {burst:.1f} N"
        )
        each = [after_change(bench, hand, later, [strike]) for strike in drawn]
        late = sum(after_s > _LATE_S for after_s, _, _ in each)
        quiet_s, loud_s, burst = np.max(each, axis=0)
        print(
            f"  of {len(drawn)} other strikes {late} late: quiet after {1e3 * quiet_s:.0f} ms, "
            f"loud for {1e3 * loud_s:.0f} ms, burst {burst:.1f} N"
        )


if __name__ == "__main__":
    main()
