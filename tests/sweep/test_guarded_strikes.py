"""The guard on walls that are quiet: it tells only of contacts that throw the handle."""

import numpy as np
import pytest
from guarded_strikes import quiet_strikes, throws

#: In one of these draws strikes are thrown.
DRAWS = range(70, 80)


def test_contact_that_leaves_faster_than_it_came_throws() -> None:
    came = np.array([3.0, 2.0, 1.0, -0.5, -0.2])
    assert throws(np.append(came, [0.8, 2.0, 3.2, 4.4]))
    assert not throws(np.append(came, [0.8, 1.8, 2.8, 3.8]))
    # What is long over is not what the guard tells of.
    assert not throws(np.append(came, 0.8 + 1.2 * np.arange(20.0)))


@pytest.mark.slow
def test_guard_tells_of_no_quiet_strike_but_of_those_that_are_thrown() -> None:
    strikes = [strike for draw in DRAWS for strike in quiet_strikes(draw)]
    assert len(strikes) > 6 * len(DRAWS)
    assert [strike.wall for strike in strikes if strike.told and not strike.thrown] == []
    assert any(strike.thrown for strike in strikes)
