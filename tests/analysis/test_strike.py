"""Measures of a strike on signals made by hand, against what was put into them."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from canwall.analysis.felt import felt_band
from canwall.analysis.strike import (
    MEASURE_DESCRIPTIONS,
    MEASURES,
    first_depth,
    keeps_limits,
    measure_strike,
    pressed_cycle,
)

Array = NDArray[np.float64]

PERIOD, COUNT, RADIUS = 1e-3, 1e-6, 0.08
IN, DEEP, REST, OUT, END = 20, 60, 100, 900, 1000
DEPTH, FIRST_DEPTH, REFERENT_DEPTH = 0.01, 0.04, 0.02
J = np.arange(END)


def pressed(first_depth: float = FIRST_DEPTH, exit_speed: float = 0.5) -> Array:
    """Positions of a handle that comes at 1 rad/s, presses at rest, and leaves."""
    fall = (IN - J - 0.5) * PERIOD
    dip = np.interp(J, [IN, DEEP, REST], [fall[IN], -first_depth, -DEPTH])
    leave = (J - OUT + 0.5) * exit_speed * PERIOD
    return np.select([J < IN, J < REST, J < OUT - 1], [fall, dip, -DEPTH], leave)


def sine(amplitude: float, frequency: float) -> Array:
    """A sine while the handle is at rest."""
    wave = amplitude * np.sin(2.0 * math.pi * frequency * PERIOD * (J - REST))
    return np.where((J >= REST) & (J < OUT), wave, 0.0)


def measured(y: Array, force: Array | None = None, **given: Any) -> dict[str, Any]:
    """Measures of a strike whose referent goes in half as deep, and leaves half as fast."""
    nothing = np.zeros(len(y))
    arguments = {
        "torque": nothing,
        "trip": 0,
        "thrown": False,
        "alarms": 0,
        "felt": nothing,
        "in_force": np.zeros((2, len(y))),
        "referent": pressed(REFERENT_DEPTH, 0.25),
        "referent_felt": nothing,
    } | given
    measures = np.zeros(1, MEASURES)
    measure_strike(
        y,
        nothing if force is None else force,
        *arguments.values(),
        PERIOD,
        felt_band(PERIOD),
        RADIUS,
        COUNT,
        1e-6,
        100.0,
        1,
        measures,
    )
    return dict(zip(MEASURES.names or (), measures[0].tolist(), strict=True))


@pytest.mark.slow
def test_every_measure_of_a_strike() -> None:
    y = pressed() + sine(2.0 * COUNT, 25.0)
    force = np.where(y < 0.0, 2.0, 0.0)
    force[IN : IN + 5] = 0.5
    force[OUT] = -0.5  # held for a cycle more, it takes back some energy
    most = 2.0 * (y[OUT] - y[IN + 5]) + 0.5 * (y[IN + 5] - y[IN])
    y[OUT + 50 : OUT + 55] = -0.001  # back once more, without a force
    found = measured(
        y,
        force,
        torque=-3.0 * (J == 5),
        trip=2,
        alarms=3,
        felt=np.where(J < REST + 250, 1.5, 1.0) * sine(0.02, 100.0),
        in_force=np.array([100.0 + J, 2.0 + J]),
        referent=pressed(REFERENT_DEPTH, 0.25) + sine(COUNT, 25.0),
        referent_felt=sine(0.01, 100.0),
    )
    gain = 1.0 / math.sqrt(1.0 + (20.0 / 100.0) ** 4)
    known_best = IN + (OUT + 1 - IN) * 9 // 10 - 1
    assert found == pytest.approx(
        {
            "chatters": False,
            "chatters_counts": False,
            "chatters_kick": False,
            "chatters_amplitude": False,
            "chatters_ripple": False,
            "settled": True,
            "trip": 2,
            "alarms": 3,
            "contacts": 2,
            "events": 3,
            "referent_events": 1,
            "motion": 4.0 * COUNT,
            "referent_motion": 2.0 * COUNT,
            "tolerance": 6.0 * COUNT,
            "ripple": gain * 0.02 / math.sqrt(2.0) / RADIUS,
            "referent_ripple": gain * 0.01 / math.sqrt(2.0) / RADIUS,
            "settling_ripple": gain * 0.03 / math.sqrt(2.0) / RADIUS,
            "amplitude": 0.0,
            "frequency": 0.0,
            "energy_out": most,
            "energy_end": most - 0.5 * (y[OUT + 1] - y[OUT]),
            "energy_tolerance": 3.0 * COUNT,
            "peak_torque": 3.0,
            "penetration": FIRST_DEPTH,
            "stiffness_in_force": 100.0 + known_best,
            "stiffness_in_force_least": 100.0 + IN,
            "mass_est": 2.0 + known_best,
            "first_depth": FIRST_DEPTH,
            "referent_first_depth": REFERENT_DEPTH,
            "rate_hardness": (2.0 - 0.5) / (5.0 * PERIOD) / 1.0,
            "restitution": 0.5,
            "referent_restitution": 0.25,
        },
        rel=2e-3,
        abs=1e-12,
    )
    assert set(MEASURE_DESCRIPTIONS) == set(MEASURES.names or ())


def bouncing(times: int) -> Array:
    """Out and in again, so often, with 10 ms for each, and no faster than it came."""
    out = (J >= DEEP) & (DEEP + 10 * times > J) & (J // 5 % 2 == 0)
    at_the_surface = np.where((J >= IN) & (J < REST), -0.5 * PERIOD, pressed())
    return np.where(out, (J % 5 + 0.5) * PERIOD, at_the_surface)


def kicked(restitution: float) -> Array:
    """Out so many times as fast as in, once, and at rest again."""
    out = (J - DEEP - 10.5) * restitution * PERIOD
    back = np.where(J < REST - 10, out, -DEPTH)
    return np.where((J >= DEEP + 10) & (J < REST), back, pressed())


@pytest.mark.parametrize(
    ("by", "y", "given", "amplitude", "frequency"),
    [
        ("counts", bouncing(2), {}, 0.0, 0.0),
        ("counts", bouncing(10), {"referent": bouncing(8), "gives": True}, 0.0, 0.0),
        ("", bouncing(10), {"referent": bouncing(8)}, 0.0, 0.0),
        ("", bouncing(1), {}, 0.0, 0.0),
        ("amplitude", pressed() + sine(0.002, 25.0), {}, 0.002, 25.0),
        ("kick", kicked(1.3), {}, 0.0, 0.0),
        ("", kicked(1.05), {}, 0.0, 0.0),
        ("", pressed(exit_speed=3.0), {}, 0.0, 0.0),  # the hand takes it out
        ("ripple", pressed() + sine(COUNT, 25.0), {"felt": sine(0.02, 100.0)}, COUNT, 100.0),
        ("thrown", pressed(), {"thrown": True}, 0.0, 0.0),
        # Where nothing settles it is the motion in contact.
        ("thrown", pressed(), {"thrown": True, "referent": np.ones(END)}, 0.01975, 0.0),
    ],
)
def test_chatter_has_the_amplitude_and_frequency_of_what_is_judged(
    by: str, y: Array, given: dict[str, Any], amplitude: float, frequency: float
) -> None:
    force = np.where((y < 0.0) & (J > 300), 1.0, 0.0) if given.pop("gives", False) else None
    found = measured(y, force, **given)
    criteria = ("counts", "kick", "amplitude", "ripple")
    assert [found[f"chatters_{one}"] for one in criteria] == [one == by for one in criteria]
    assert found["chatters"] is (by != "")
    assert found["amplitude"] == pytest.approx(amplitude, rel=0.01)
    assert found["frequency"] == pytest.approx(frequency, rel=0.01)


def test_a_handle_that_meets_no_wall_has_no_measures_of_contact() -> None:
    found = measured(np.ones(END), referent=np.ones(END))
    unknown = {name for name, value in found.items() if math.isnan(value)}
    assert unknown == {
        "ripple",
        "referent_ripple",
        "settling_ripple",
        "stiffness_in_force",
        "stiffness_in_force_least",
        "mass_est",
        "first_depth",
        "referent_first_depth",
        "rate_hardness",
        "restitution",
        "referent_restitution",
    }
    assert not any(value for name, value in found.items() if name not in {*unknown, "tolerance"})


def test_referent_keeps_limits_of_position_and_speed() -> None:
    y = np.array([0.0, 0.5, 1.0, 0.5, -0.5])
    assert keeps_limits(y, (-0.5, 1.0), 1.0, 1.0)
    assert not keeps_limits(y, (-0.4, 1.0), 1.0, 1.0)
    assert not keeps_limits(y, (-0.5, 0.9), 1.0, 1.0)
    assert not keeps_limits(y, (-0.5, 1.0), 0.9, 1.0)
    assert not keeps_limits(y, (-0.5, 1.0), 1.0, 0.9)


def test_only_the_first_contact_counts() -> None:
    assert first_depth(np.array([1.0, -2.0, -3.0, -1.0, 0.0, -9.0])) == 3.0
    assert first_depth(np.array([0.5, -2.0, -7.0])) == 7.0
    assert math.isnan(first_depth(np.array([1.0, 0.0, 2.0])))


def test_a_wall_is_known_best_before_the_hand_leaves_it() -> None:
    y = np.ones(200)
    y[10:15] = y[50:150] = y[160:190] = -1.0
    force = np.zeros(200)
    force[150:152] = 1.0  # held for two cycles more
    assert pressed_cycle(y, force) == 50 + int(102 * 0.9) - 1
    assert pressed_cycle(y[:13], force) == 10 + 1


@pytest.mark.parametrize(("stiffness", "chatters"), [(100.0, True), (0.1, False)])
def test_steps_of_the_torque_explain_the_motion_of_the_wall_in_force(
    stiffness: float, chatters: bool
) -> None:
    """Two walls for which 100 N·m/rad were asked: the torque's steps of 1e-6 N·m."""
    found = measured(pressed() + sine(1e-5, 25.0), in_force=np.full((2, END), stiffness))
    assert found["tolerance"] == pytest.approx(max(6.0 * COUNT, 3e-6 / stiffness))
    assert found["chatters_amplitude"] is chatters
