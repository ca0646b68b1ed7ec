"""The guard on walls that are quiet in the end: it tells of a handle thrown, and of a buzz."""

import numpy as np
import pytest
from guarded_strikes import buzzes, quiet_strikes, throws

#: In one of these draws strikes are thrown.
DRAWS = range(70, 80)


def test_contact_that_leaves_faster_than_it_came_throws() -> None:
    came = np.array([3.0, 2.0, 1.0, -0.5, -0.2])
    assert throws(np.append(came, [0.8, 2.0, 3.2, 4.4]))
    assert not throws(np.append(came, [0.8, 1.8, 2.8, 3.8]))
    # A torque that acts after the contact.
    assert throws(np.append(came, [0.8, 1.6, 2.5, 3.7]))
    # One that has only just ended has no speed yet.
    assert not throws(np.append(came, [0.8]))
    # What is long over is not what the guard tells of.
    assert not throws(np.append(came, 0.8 + 1.2 * np.arange(20.0)))


def test_ripple_that_lasts_to_the_end_buzzes() -> None:
    cycles = np.arange(200)
    swing = 0.06 * np.sin(0.5 * np.pi * cycles + 0.3)
    assert buzzes(0.15 + swing, 0.001)
    assert not buzzes(0.15 + np.where(cycles < 80, swing, 0.0), 0.001)


@pytest.mark.slow
def test_guard_tells_of_no_quiet_strike_but_of_those_that_are_thrown_or_buzzed() -> None:
    strikes = [strike for draw in DRAWS for strike in quiet_strikes(draw)]
    assert len(strikes) > 6 * len(DRAWS)
    alarms = [alarm for alarm in strikes if alarm]
    assert [alarm.wall for alarm in alarms if not alarm.right] == []
    assert any(alarm.thrown for alarm in alarms)
