"""The laws on the bouncing ball: time per step, its worst, and the ball by an ODE solver.

All by the processor's time of this process: who else uses the machine matters less.
"""

import itertools
import math
import statistics
import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from canwall.compiled import Record, compiled
from canwall.walls import (
    HORIZON,
    LAWS,
    WALL,
    clear_memory,
    set_plant,
    set_referent,
    wall_force,
)
from canwall.workbench import Ball, sampled_ball
from canwall.workbench.ball import bounce

_REPEATS = 7
_PERIODS = 3000
#: Times that one ball, or one planning step, is repeated within one measurement.
_BALLS, _STEPS = 20, 300
#: θ = 0.1: some forty samples to a contact.
_BALL = Ball(periods=_PERIODS)
#: Options of laws whose defaults would throw this ball so high that it hardly ever comes back.
_OPTIONS = {"exponential": {"length": 2.0}}


def _wall(law: str, ball: Ball) -> NDArray[np.void]:
    wall = np.zeros(1, WALL)
    set_plant(wall, ball.mass, ball.viscous, ball.spring, ball.period)
    set_referent(wall, ball.stiffness, ball.damping, LAWS[law].option_values(_OPTIONS.get(law, {})))
    wall["d"] = -ball.mass * ball.gravity
    return wall


def law_steps() -> dict[str, Any]:
    """Nanoseconds per period of a ball on each law, with the step of the plant.

    On the whole, in flight, and in contact, where the rest of the time goes.
    """
    results: dict[str, Any] = {"ball": "theta = 0.1, dropped from 1, 3000 periods"}
    for law in LAWS:
        turns = [_turn(law) for _ in range(_REPEATS)]
        whole, flight, contact = (statistics.median(turn[i] for turn in turns) for i in range(3))
        results[law] = {
            "ns_per_step": round(whole),
            "in_flight": round(flight),
            "in_contact": round(contact),
            **({"aim": "<= 2000"} if law == "mean_force" or "deadbeat" in law else {}),
        }
    return results


def _turn(law: str) -> tuple[float, float, float]:
    """Nanoseconds per step: of the ball, of one that stays up, and of the first in contact."""
    wall, address = _wall(law, _BALL), LAWS[law].address
    trajectory = np.zeros((3, _PERIODS + 1))
    flight = _ns_per_period(wall, address, 1e9, trajectory)
    whole = _ns_per_period(wall, address, _BALL.height, trajectory)
    contact = np.count_nonzero((trajectory[0] < 0.0) | (trajectory[2] != 0.0))
    return whole, flight, flight + (whole - flight) * _PERIODS / contact


def _ns_per_period(
    wall: NDArray[np.void], address: int, height: float, trajectory: NDArray[np.float64]
) -> float:
    bounce(wall, address, height, 0.0, trajectory)
    begin = time.process_time_ns()
    for _ in range(_BALLS):
        bounce(wall, address, height, 0.0, trajectory)
    return (time.process_time_ns() - begin) / _BALLS / _PERIODS


@compiled
def _first_steps(wall: Record, address: int, y: float, v: float, count: int) -> int:
    """Plan the same contact `count` times from its beginning; how many periods it has."""
    periods = 0
    for _ in range(count):
        wall.memory[:] = 0.0
        wall.y = y
        wall.v = v
        wall_force(address, wall)
        periods = int(wall.memory[0])
    return periods + 1


def planning_steps() -> dict[str, Any]:
    """Microseconds of the one step at which a whole contact is planned, over many contacts.

    The worst one is what counts. `pole_placement` and `half_sample` with deadbeat plan alike.
    """
    aims = {"push_only": 20.0, "half_sample+deadbeat": 2.0, "mean_force": 2.0, "two_step": None}
    results: dict[str, Any] = {"horizon": HORIZON}
    for law, aim in aims.items():
        times = [_planning_us(law, ball) for ball in _contacts()]
        worst = max(times)
        results[law] = {
            "worst_us": round(worst[0], 3),
            "median_us": round(statistics.median(us for us, _ in times), 3),
            "periods_of_the_worst": worst[1],
            "contacts": len(times),
            **({} if aim is None else {"aim": f"<= {aim:g}"}),
        }
    return results


def _contacts() -> list[Ball]:
    """Balls about to strike, or deep inside, with contacts about as long as the horizon or less."""
    balls = []
    for periods, share, spring in itertools.product(
        (2.5, 8.5, 20.5, 40.5, HORIZON - 0.5), (0.0, 0.1, 0.3, 0.5), (0.0, 0.2)
    ):
        theta = math.pi / periods
        floor = Ball(
            stiffness=theta**2,
            damping=2.0 * share * theta,
            spring=spring * theta**2,
            gravity=0.01 * theta,
            period=1.0,
        )
        balls += [replace(floor, height=phase, speed=-1.0) for phase in (0.05, 0.35, 0.65, 0.95)]
        balls += [replace(floor, height=-0.75 / theta, speed=v) for v in (-0.9, -0.25, 0.25)]
    return balls


def _planning_us(law: str, ball: Ball) -> tuple[float, int]:
    wall = _wall(law, ball)
    address = LAWS[law].address
    times = []
    for _ in range(_REPEATS):
        clear_memory(wall)
        begin = time.process_time_ns()
        periods = _first_steps(wall[0], address, ball.height, ball.speed, _STEPS)
        times.append((time.process_time_ns() - begin) / _STEPS / 1e3)
    return statistics.median(times), periods


def ball() -> dict[str, Any]:
    """Ball periods per second, and how many times those of the chapter's way (Table 5.4).

    That is the same ball, half-sample prediction on it, with solve_ivp called once per period.
    """
    ours, theirs, ratios = [], [], []
    short = 200
    for _ in range(_REPEATS):
        begin = time.process_time()
        for _ in range(_BALLS):
            y, _, _ = sampled_ball(_BALL, LAWS["half_sample"])
        ours.append(_BALLS * _PERIODS / (time.process_time() - begin))
        begin = time.process_time()
        positions = _by_solver(_BALL, short)
        theirs.append(short / (time.process_time() - begin))
        ratios.append(ours[-1] / theirs[-1])
        if np.abs(positions - y[: short + 1]).max() > 1e-9:
            raise RuntimeError("not the same ball")
    return {
        "periods_per_s": round(statistics.median(ours)),
        "by_solver_per_s": round(statistics.median(theirs)),
        "ratio": round(statistics.median(ratios)),
        "aim": ">= 1000",
        "repeats": [round(ratio) for ratio in ratios],
    }


def _by_solver(ball: Ball, periods: int) -> NDArray[np.float64]:
    """Positions at the samples, as Table 5.4 has them (its errata put right)."""
    mass, gravity, period = ball.mass, ball.gravity, ball.period
    omega = math.sqrt(ball.stiffness / mass)
    state, force = np.array([ball.height, ball.speed]), 0.0
    positions = [ball.height]
    for k in range(periods):
        solution = solve_ivp(
            lambda t, x, f: [x[1], f / mass - gravity],
            (k * period, (k + 1) * period),
            state,
            args=(force,),
        )
        state = solution.y[:, -1]
        force = 0.0
        if state[0] < 0.0:
            a, b = state[0] + gravity / omega**2, state[1] / omega
            half = omega * period / 2.0
            force = -ball.stiffness * (a * math.cos(half) + b * math.sin(half) - gravity / omega**2)
        positions.append(float(state[0]))
    return np.array(positions)
