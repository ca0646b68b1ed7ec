"""KT²/m of the laws in unknown hands, and strikes with the cap, on the plant written apart.

`python tests/independent/figures.py [SERVO] [COULOMB]`: SERVO "1600" or "800", see `plant.SERVOS`.
"""

import math
import sys
from typing import Any

import numpy as np
from plant import OPERATORS, SERVOS, STRIKES, Bench, Servo, first_strike, judge, k_limit

#: The laws' model of the drive with its handle; the delay is the true one.
_DRIVE = {
    "mechanics.inertia_kg_m2": 1e-4,
    "mechanics.viscous_nm_s_per_rad": 5e-4,
    "mechanics.coulomb_nm": 0.0,
}
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


def main() -> None:
    name = sys.argv[1] if len(sys.argv) > 1 else "1600"
    servo = SERVOS[name]
    if len(sys.argv) > 2:
        servo = servo._replace(coulomb=float(sys.argv[2]))
    print(f"KT²/m, {name} Hz + {1e3 * servo.drive_cycle_s:g} ms, Coulomb {servo.coulomb:g} N·m")
    print("  ", *OPERATORS, sep="  ")
    for law, found in limits(servo).items():
        print(f"{law}:", "  ".join(f"{passed:.3g}" for passed, _ in found), flush=True)
    for cap in (0.5, 1.0):
        for hand, (failed, strikes, fastest, least) in zip(
            OPERATORS, with_cap(servo, cap), strict=True
        ):
            print(
                f"cap {cap:g} {hand}: {failed}/{strikes} failed, exit {fastest:.2f}, K {least:.2f}"
            )


if __name__ == "__main__":
    main()
