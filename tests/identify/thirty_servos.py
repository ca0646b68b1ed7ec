"""Identification of random servos: `python tests/identify/thirty_servos.py [FIRST [END]]`.

Prints a line for each quantity of each servo, then how many are within their aims and intervals.
"""

import math
import sys
from collections import defaultdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from servo_bench import Truth, play, random_servo

from canwall.identify import Estimate, ServoFit, fit_servo
from canwall.identify.excitation import Excitation

PERIOD = 1e-3
#: Largest errors: relative, but those of delays, which are in periods.
AIMS = {
    "inertia": 0.02,
    "viscous": 0.1,
    "coulomb": 0.05,
    "delay": 0.02,
    "lag": 0.15,
    "total": 0.02,
    "resonance": 0.05,
}


def identified(seed: int) -> tuple[Truth, ServoFit]:
    """Identify a random servo in memory."""
    truth, settings = random_servo(seed)
    position, torque = play(settings, truth, Excitation(settings, 1.911))
    return truth, fit_servo(position, torque, PERIOD, 2.0 * math.pi / truth.counts)


def compared(truth: Truth, fit: ServoFit) -> dict[str, tuple[Estimate, float]]:
    """What was found beside what is true; a shaft that was not found is infinitely far off."""
    pairs = {
        "inertia": (fit.inertia, truth.inertia),
        "viscous": (fit.viscous, truth.viscous),
        "coulomb": (fit.coulomb, truth.coulomb),
        "delay": (fit.delay, truth.total_delay),
        "lag": (fit.lag, truth.lag),
        "total": (fit.total, truth.total_delay + truth.lag / PERIOD),
    }
    if truth.shaft_hz or fit.shaft:
        found = fit.shaft.hz if fit.shaft else Estimate(math.inf, 0.0)
        pairs["resonance"] = (found, truth.shaft_hz)
    return pairs


def error(name: str, estimate: Estimate, true: float) -> float:
    """Error as AIMS has it."""
    off = abs(estimate.value - true)
    return off if name in ("delay", "total") else off / true if true else math.inf


def main(first: int, end: int) -> None:
    """Print the comparison."""
    within: defaultdict[str, int] = defaultdict(int)
    inside: defaultdict[str, int] = defaultdict(int)
    servos: defaultdict[str, int] = defaultdict(int)
    worst: defaultdict[str, float] = defaultdict(float)
    for seed in range(first, end):
        truth, fit = identified(seed)
        for name, (estimate, true) in compared(truth, fit).items():
            off = error(name, estimate, true)
            servos[name] += 1
            within[name] += off <= AIMS[name]
            inside[name] += estimate.contains(true)
            worst[name] = max(worst[name], off)
            marks = ("" if off <= AIMS[name] else " FAR") + (
                "" if estimate.contains(true) else " OUT"
            )
            print(
                f"{seed:3} {name:10} {true:.5g} found {estimate.value:.5g} ± {estimate.half:.2g}, "
                f"off by {off:.2%}{marks}",
                flush=True,
            )
        print(f"{seed:3} residuals {fit.residuals.rms:.2f} steps", flush=True)
    for name, number in servos.items():
        print(
            f"{name:10} of {number} servos: {within[name]} within {AIMS[name]:.0%}, "
            f"{inside[name]} in their interval, worst {worst[name]:.2%}"
        )


if __name__ == "__main__":
    main(*(int(argument) for argument in (sys.argv[1:] + ["0", "30"][len(sys.argv) - 1 :])))
