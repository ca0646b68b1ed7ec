"""Objects of the SYNC: its window and its period are made to fit the cycle."""

import pytest
from rig import Loop, RigFactory, settings_with


@pytest.mark.parametrize(("pace", "period_us"), [("real_time", 1000), ("simulated", 0)])
def test_period_that_a_drive_watches_is_that_of_the_cycle(
    make_rig: RigFactory, pace: str, period_us: int
) -> None:
    rig = make_rig(settings_with({"bus.pace": pace}))
    rig.node.write(0x1006, 0, 2500)
    rig.set_up()
    assert rig.node.read(0x1006) == period_us
    rig.node.restore()
    assert rig.node.read(0x1006) == 2500


def test_period_that_is_not_watched_stays_so(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"bus.pace": "real_time"}))
    rig.set_up()
    assert rig.node.read(0x1006) == 0


def test_window_that_would_drop_torques_is_opened(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"wall.law": "half_sample"}))
    rig.node.write(0x1007, 0, 1)  # a microsecond: every RPDO would come too late
    loop = Loop(rig)
    assert rig.node.read(0x1007) == 0
    assert loop.run(400).trips == []
    assert rig.node.restore() == []
    assert rig.node.read(0x1007) == 1


def test_window_that_stays_is_told_of(make_rig: RigFactory) -> None:
    rig = make_rig()
    rig.node.write(0x1007, 0, 700)
    rig.tampering.read_only[0x1007, 0] = 0x06010002
    assert any("0x1007 stays as it is" in note for note in rig.set_up().notes)
