"""The sweep in memory: closed-loop periods per second, against plain Python, on two cores."""

import gc
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from canwall import config
from canwall.cycle import Loop, run_laws, run_loop, step_address, step_at
from canwall.record import ROW, Phase, Ring
from canwall.run import drive_dictionary, make_axis, make_exchange, on_the_bus
from canwall.run.closed_loop import SIGNALS, ClosedLoop, Disturbances, simulate, simulate_wall
from canwall.sweep import make_plan
from canwall.sweep.plan import Plan
from canwall.sweep.workers import compute_pieces

#: Periods of one strike.
_STRIKE = 1000
#: Turns of a ratio, and strikes in each.
_RATIOS, _TURNS = 15, 300
_RENDERING = int(Phase.RENDERING)


def _plan(**axes: Any) -> Plan:
    base = config.load(config.shipped("config/sim.toml"))
    return make_plan(base, {"servo": "ideal", "operator": "finger", **axes})


def _seconds(work: Callable[[], object], repeats: int = 5) -> float:
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def closed_loop() -> dict[str, Any]:
    """Periods per second and core: plant with friction, encoder, plain estimator, law."""
    found = {}
    for law in ("standard", "half_sample", "mean_force", "push_only"):
        ready = ClosedLoop(_settings(law, guard="warn"), _STRIKE).records()
        into = ready, 50.0, 0.0, np.zeros(1, ROW), np.empty((SIGNALS, _STRIKE))
        simulate_wall(*into)
        found[law] = round(
            100 * _STRIKE / _seconds(lambda into=into: [simulate_wall(*into) for _ in range(100)])  # type: ignore[misc]
        )
    plain = _STRIKE / _seconds(_plain_strike, 3)
    return {
        "periods_per_s": found,
        "plain_python_periods_per_s": round(plain),
        "half_sample_over_plain_python": round(found["half_sample"] / plain, 1),
    }


def unknown_hand() -> dict[str, Any]:
    """Time per period of the loop on two servos, and of the cycle alone with all that it may have.

    The second servo's own cycle does not go with the SYNC. The cycle alone gets the positions of a
    recorded strike: with the law `midpoint`, a few multiplications, and with mean_force, the
    operator identified and the guard. By the processor's time, in turns, in µs.
    """
    servo = {"servo": "1600Hz", "model": "drive", "operator": "grip"}
    all_of_it = {"guard": "act", "hand": "identified"}
    full = _loop("mean_force", **all_of_it, **servo)
    latching = _loop("mean_force", **all_of_it, **servo | {"servo": "800Hz"})
    settings = _settings("mean_force", **all_of_it, **servo)
    counts = simulate(settings, _STRIKE).rows["counts"]
    address = step_address()
    cycles = [
        ClosedLoop(one, _STRIKE).records().cycle
        for one in (_settings("midpoint", **servo), settings)
    ]
    works = [
        full,
        latching,
        *(partial(_replay, address, cycle, np.zeros(1, ROW), counts) for cycle in cycles),
    ]
    for work in works:
        work()
    found = np.array([[_computed(work) for work in works] for _ in range(_RATIOS)])
    loop, latches, plain, having = 1e6 * np.median(found, axis=0) / (_TURNS * _STRIKE)
    return {
        "loop_us": round(float(loop), 2),
        "loop_with_ticks_of_the_drive_us": round(float(latches), 2),
        "cycle_us": round(float(plain), 3),
        "cycle_with_law_identification_and_guard_us": round(float(having), 3),
        "what_they_take_us": round(float(having - plain), 3),
        "aim": "loop <= 1 us (1e6 periods/s and core); they take <= 2 us, better 1",
    }


@njit(nogil=True)
def _replay(step: int, cycles: Any, rows: Any, counts: Any) -> None:
    cycle = cycles[0]
    for _ in range(_TURNS):
        for j in range(len(counts)):
            cycle.phase = _RENDERING
            cycle.trip = 0
            shown = cycle.torque_per_mille & 0xFFFF
            data = (counts[j] & 0xFFFFFFFF) | (0x27 << 32) | (shown << 48)
            step_at(step, cycles, rows, data, True)


def safeguards() -> dict[str, Any]:
    """Time of a closed loop with each safeguard, relative to the same without it; in turns.

    The loop in memory, but for the last: an embedded run, whose loop has a thread of its own.
    """
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / "law.py"
        own.write_text(_OWN_LAW)
        pairs = {
            "guard": (_loop("half_sample"), _loop("half_sample", guard="act")),
            "hand known": (_loop("half_sample"), _loop("half_sample", hand="known")),
            "hand identified": (_loop("half_sample"), _loop("half_sample", hand="identified")),
            "one TPDO in ten missing": (_loop("half_sample"), _loop("half_sample", lost=0.1)),
            "law of one's own": (_loop("standard"), _loop(f"{own}:own")),
        }
        found = {name: _ratio(*pair) for name, pair in pairs.items()}
    found["thread of the loop"] = _ratio(
        partial(_embedded, supervised=False), partial(_embedded, supervised=True)
    )
    return found


#: `standard`, as a user would write it.
_OWN_LAW = """def own(wall):
    return max(0.0, -wall.stiffness * wall.y_sample)
"""
#: Cycles of an embedded run.
_EMBEDDED = 100_000


def _ratio(without: Callable[[], object], having: Callable[[], object]) -> dict[str, float]:
    """Return the median ratio of the processor's times, and its range."""
    without(), having()
    ratios = sorted(_computed(having) / _computed(without) for _ in range(_RATIOS))
    return {
        "ratio": round(statistics.median(ratios), 3),
        "least": round(ratios[0], 3),
        "largest": round(ratios[-1], 3),
    }


def _computed(work: Callable[[], object]) -> float:
    """Return the processor time of this process [s]: who else uses the machine matters less."""
    start = time.process_time()
    work()
    return time.process_time() - start


def _loop(
    law: str, guard: str = "off", hand: str = "", lost: float = 0.0, **axes: Any
) -> Callable[[], object]:
    settings = _settings(law, guard, hand, **axes)
    disturbances = Disturbances.none(_STRIKE)
    disturbances.lost[10:] = np.random.default_rng(0).random(_STRIKE - 10) < lost
    records = ClosedLoop(settings, _STRIKE, disturbances=disturbances).records()
    into = records, 50.0, 0.0, np.zeros(1, ROW), np.empty((SIGNALS, _STRIKE))

    def strikes() -> None:
        for _ in range(_TURNS):
            simulate_wall(*into)

    return strikes


def _settings(law: str, guard: str = "off", hand: str = "", **axes: Any) -> Any:
    """Return the settings of a strike; hand: known, identified, or "" for a plain filter."""
    settings = _struck(law, **axes)
    given = settings.guard.model_copy(update={"action": guard})
    operator = settings.operator.model_copy(update={"adapt": hand == "identified"})
    walk = {} if hand else {"force_walk_nm_per_sqrt_s": 0.2}
    estimator = settings.estimator.model_copy(update=walk)
    update = {"guard": given, "operator": operator, "estimator": estimator}
    return settings.model_copy(update=update)


def _embedded(supervised: bool) -> None:
    settings = config.load(config.shipped("config/sim.toml"), {"bus.exchange": "native"})
    laws, ring = run_laws(settings), Ring.create()

    def work(loop: Loop) -> bool:
        while loop.j < _EMBEDDED and not loop.stops():
            loop.exchange.cycle(loop.exchange.ahead)
            ring.take_rows()
        return False

    with on_the_bus(settings) as link, closing(ring):
        axis = make_axis(link, settings, drive_dictionary(settings), laws, ring)
        with closing(make_exchange(link, [axis])) as exchange:
            if supervised:
                run_loop(exchange, work)
                return
            gc.collect()  # as run_loop does
            loop = Loop(exchange)
            loop.enable()
            work(loop)
            loop.leave()


def _struck(law: str, **axes: Any) -> Any:
    plan = _plan(law=law, stiffness=[50.0], speed=[1.0], phase=[0.0], **axes)
    return plan.settings(plan.points[0], plan.strikes[0])


def _plain_strike() -> None:
    """The same loop as it is written in NumPy: matrices, a Kalman filter, half_sample."""
    from scipy.linalg import expm

    from canwall.walls.estimator import kalman_model

    settings = _struck("half_sample")
    mechanics, period = settings.mechanics, settings.bus.cycle_s
    mass, viscous = mechanics.inertia_kg_m2, mechanics.viscous_nm_s_per_rad
    count, step, stiffness = 2.0 * np.pi / 131072, 0.637e-3, 50.0
    hand = settings.simulation.hand.stiffness_nm_per_rad
    model = np.array([[0.0, 1.0, 0.0], [0.0, -viscous / mass, 1.0 / mass], [0.0, 0.0, 0.0]])
    plant = model.copy()
    plant[1, 0] = -hand / mass
    flow, moves = expm(model * period), expm(plant * period)
    phi, gamma = flow[:2, :2], flow[:2, 2]
    contact = np.array([[0.0, 1.0], [-stiffness / mass, -viscous / mass]])
    half = expm(contact * 0.5 * period)
    gain = kalman_model(mass, viscous, 0.0, period, count, 0.2).gain
    x, estimate, sent = np.array([0.03, 0.0]), np.array([0.03, 0.0, 0.0]), 0.0
    for j in range(_STRIKE):
        y = np.floor(x[0] / count + 0.5) * count
        estimate = estimate + gain * (y - estimate[0])
        friction = np.clip(mass * estimate[1] / period, -0.01, 0.01)
        at = phi @ estimate[:2] + gamma * (sent + estimate[2] - friction)
        force = -stiffness * (half @ at)[0] if at[0] < 0.0 else 0.0
        force = np.clip(np.rint(force / step), -2983, 2983) * step
        friction = np.clip(mass * x[1] / period, -0.01, 0.01)
        push = -0.15 if 50 < j < 750 else 0.0
        x = moves @ np.array([x[0], x[1], sent + push - friction])
        x = x[:2]
        estimate[:2] = at
        sent = force


@njit(nogil=True)  # type: ignore[untyped-decorator]
def _spin(rounds: int) -> float:
    x = 0.0
    for i in range(rounds):
        x = (x * 1.0000001 + i) % 3.7
    return x


def _spun(cores: int) -> None:
    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(_spin, [10_000_000] * 4))


def sweep_on_two_cores() -> dict[str, Any]:
    """The same map on one core and on two, and points per second of a Z-width map."""
    plan = _plan(
        law="half_sample",
        stiffness="1:300:60",
        damping="0:0.05:60",
        speed=[0.5, 1.0, 2.0],
        phase=[0.0],
        press=1.1,
    )
    pieces = range(plan.pieces)
    list(compute_pieces(plan, pieces[:2], 1))
    _spin(10)
    bare = [_seconds(lambda cores=cores: _spun(cores), 3) for cores in (1, 2)]  # type: ignore[misc]
    one = _seconds(lambda: list(compute_pieces(plan, pieces, 1)), 3)
    two = _seconds(lambda: list(compute_pieces(plan, pieces, 2)), 3)
    return {
        "points": plan.point_count,
        "periods": round(
            plan.point_count * plan.settings(plan.points[0], plan.strikes[1]).run.duration_s * 1e3  # type: ignore[operator]
        ),
        "one_core_s": round(one, 2),
        "two_cores_s": round(two, 2),
        "two_cores_over_one": round(one / two, 2),
        # What the machine gives at the time: a loop that touches nothing.
        "bare_loop_two_cores_over_one": round(bare[0] / bare[1], 2),
        "processors": len(os.sched_getaffinity(0)),
    }
