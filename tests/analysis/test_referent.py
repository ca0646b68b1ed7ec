"""The referent moves what the simulated drive moves: without a wall they are one."""

import math

import numpy as np
import pytest
from rig import settings_with

from canwall.config import Settings
from canwall.run.referent import referent_motion
from canwall.simdrive import ServoMotion


@pytest.mark.parametrize("grip", [True, False])
@pytest.mark.parametrize("side", ["below", "above"])
def test_without_a_wall_it_moves_as_the_handle_does(grip: bool, side: str) -> None:
    base = settings_with({"wall.side": side, "wall.position_rad": 0.013})
    assert base.simulation is not None
    hand = base.simulation.hand.model_copy(update={"grip": grip})
    simulation = base.simulation.model_copy(update={"hand": hand, "cogging_nm": 0.02})
    settings: Settings = base.model_copy(update={"simulation": simulation})
    nothing, position = np.zeros(1500), np.full(1500, 0.013)
    position[700:] = -0.02  # the wall is moved, the handle is not
    referent = referent_motion(settings, nothing, nothing, position)
    assert referent is not None
    motion = ServoMotion(simulation, settings.bus.cycle_s, 2.0 * math.pi * 1e6)
    seen, parted = [], False
    for _ in range(1500):
        seen.append(motion.position_rad)
        motion.advance(0.0, settings.bus.cycle_s)
        parted = parted or not motion.touching
    sign = 1.0 if side == "below" else -1.0
    np.testing.assert_allclose(sign * referent.y + position, seen, rtol=0.0, atol=1e-9)
    assert np.ptp(seen) > 0.1
    assert parted is not grip
