"""Random strikes that are quiet, and what the guard says of them: `guarded_strikes.py [DRAWS]`.

A quiet strike does not chatter, is felt with no more than 0.1 N while it comes to rest, and leaves
its first contact no faster than it came. A later contact may still throw the handle by less than a
kick, or after its referent has come to rest, which is read from the true positions, of which the
guard knows nothing; or the wall may have buzzed before.
"""

import math
import sys
from collections.abc import Iterator
from multiprocessing import Pool
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt

from canwall.config import load
from canwall.record import ROW
from canwall.run.closed_loop import SIGNALS, ClosedLoop, simulate_wall
from canwall.sweep import make_plan
from canwall.sweep.law_tables import DAMPED
from canwall.sweep.strike import OPERATORS, SERVOS
from canwall.walls import LAWS

CONFIGURATION = load(Path(__file__).parents[2] / "config" / "sim.toml")
#: `rigid` is no law for a bench.
_LAWS = [name for name in LAWS if name != "rigid"]
#: Walls of laws with a model [N·m/rad], speeds [rad/s], and B·T/m of laws that ask for a damping.
_STIFFNESSES, _SPEEDS = (30.0, 5000.0), (0.2, 2.0)
_DAMPINGS = (0.05, 0.1, 0.2, 0.3, 0.4)
#: Walls of sampled laws: from this [N·m/rad] on, up to twice that and this share of m/T².
_SAMPLED_SOFTEST, _SAMPLED_SHARE = 5.0, 0.15
#: Walls in a draw.
_WALLS = 12
#: Felt while it comes to rest [N].
_FELT_N = 0.1
#: Ripple that is felt [N r.m.s.], cycles over which it is measured, in which a blow is over, and
#: radius of the handle [m].
_RIPPLE_N, _RIPPLES_FOR, _RADIUS = 0.3, 50, 0.08
#: Cycles from the end of a contact in which the guard tells of it, and what it may leave with.
_TOLD_WITHIN, _FASTER = 12, 1.1


class Alarm(NamedTuple):
    """What there was to tell of in a quiet strike, at the guard's first alarm."""

    wall: str
    thrown: bool
    buzzed: bool

    @property
    def right(self) -> bool:
        """True if there was something to tell of."""
        return self.thrown or self.buzzed


def quiet_strikes(draw: int) -> Iterator[Alarm | None]:
    """Yield the alarm of each quiet strike of an operator with a law on walls of any stiffness.

    None where the guard said nothing.
    """
    rng = np.random.default_rng(draw)
    law, operator, servo = (str(rng.choice(list(names))) for names in (_LAWS, OPERATORS, SERVOS))
    axes: dict[str, Any] = {
        "law": law,
        "operator": operator,
        "servo": servo,
        "friction": float(rng.choice([0.0, 0.01, 0.02])),
        "speed": _log_uniform(rng, *_SPEEDS),
        "phase": float(rng.random()),
        "press": 1.2,
        "model": "drive",
        "stiffness": 100.0,
        "guard.action": "warn",
    }
    ratio = float(rng.choice(_DAMPINGS)) if law in DAMPED else 0.0
    if not LAWS[law].sampled:
        axes["delay_error"] = float(rng.choice([-0.3, 0.0, 0.15]))
    plan = make_plan(CONFIGURATION.model_copy(update={"sweep": {}}), axes)
    prepared = plan.prepare(plan.points[0], plan.strikes[0])
    settings = plan.settings(plan.points[0], plan.strikes[0])
    assert settings.run.duration_s is not None
    cycles = round(settings.run.duration_s / prepared.period)
    loop = ClosedLoop(settings, cycles).records()
    most = prepared.mass / prepared.period**2
    walls = _STIFFNESSES
    if LAWS[law].sampled:
        walls = _SAMPLED_SOFTEST, 2.0 * _SAMPLED_SOFTEST + _SAMPLED_SHARE * most
    for _ in range(_WALLS):
        stiffness, damping = _log_uniform(rng, *walls), ratio * prepared.mass / prepared.period
        measures = prepared.on(stiffness, damping)
        if measures["chatters"] or measures["trip"]:
            continue
        if measures["settling_ripple"] > _FELT_N or measures["restitution"] > 1.0:
            continue
        if not measures["alarms"]:
            yield None
            continue
        signals = np.empty((SIGNALS, cycles))
        simulate_wall(loop, stiffness, damping, np.zeros(cycles, ROW), signals)
        guard = loop.cycle["guard"].reshape(-1)[0]
        seen = slice(int(guard["first_alarm"]) + 1)
        thrown, buzzed = throws(signals[0, seen]), buzzes(signals[1, seen], prepared.period)
        yield Alarm(f"{stiffness} N·m/rad, B {damping}: {axes}", thrown, buzzed)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def throws(positions: NDArray[np.float64]) -> bool:
    """Return True if a contact near the end left faster than it came.

    positions: those at the SYNCs [rad], below zero inside the wall.
    """
    inside = positions < 0.0
    entered = np.flatnonzero(~inside[:-1] & inside[1:]) + 1
    left = np.flatnonzero(inside[:-1] & ~inside[1:]) + 1
    # The speed after a contact takes a sample more; its last torques act up to two more.
    for end in left[(left >= len(positions) - _TOLD_WITHIN) & (left < len(positions) - 1)]:
        (begin,) = entered[entered < end][-1:]
        came = positions[begin - 2] - positions[begin - 1]
        if np.diff(positions[end : end + 4]).max() > _FASTER * came:
            return True
    return False


def buzzes(forces: NDArray[np.float64], period: float) -> bool:
    """Return True if the forces [N·m] have rippled above 20 Hz up to the end."""
    ripple = sosfilt(butter(2, 20.0, "highpass", fs=1.0 / period, output="sos"), forces)
    return float(np.sqrt(np.mean(ripple[-_RIPPLES_FOR:] ** 2))) > _RIPPLE_N * _RADIUS


def _counted(draw: int) -> tuple[int, list[Alarm]]:
    strikes = list(quiet_strikes(draw))
    return len(strikes), [alarm for alarm in strikes if alarm]


def main(draws: int) -> None:
    """Print how many strikes are quiet, of how many the guard tells, and of what."""
    quiet = told = thrown = buzzed = 0
    with Pool() as pool:
        for count, alarms in pool.imap_unordered(_counted, range(draws), 8):
            quiet, told = quiet + count, told + len(alarms)
            thrown += sum(alarm.thrown for alarm in alarms)
            buzzed += sum(alarm.buzzed and not alarm.thrown for alarm in alarms)
            for alarm in alarms:
                if not alarm.right:
                    print(f"false alarm: {alarm.wall}", flush=True)
    print(f"{quiet} quiet strikes; the guard told of {told}: {thrown} thrown, {buzzed} had buzzed")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
