"""Set-up of the watchdog: its choice, its time, the master's frames for it, and its effect."""

import contextlib
import math

import pytest
from rig import Rig, RigFactory, lack, settings_with

from canwall.drive import DriveError, ErrorControlFrame, disarm

PRE_OPERATIONAL = 127
READ_ONLY = 0x06010002
REAL_TIME = {"bus.pace": "real_time", "drive.wait_s": 0.0}


def rig_without(make_rig: RigFactory, *missing: int, **drive: object) -> Rig:
    """A drive in real time; its dictionary lacks some objects, or (0x1400) the RPDO's timer."""
    rig = make_rig(settings_with(REAL_TIME | {f"drive.{k}": v for k, v in drive.items()}))
    lack(rig, *missing)
    return rig


def test_rpdo_event_timer_goes_first(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig)
    watchdog = rig.set_up().watchdog
    assert (watchdog.kind, watchdog.time_s, watchdog.error_control) == (
        "RPDO event timer",
        0.1,
        None,
    )
    assert watchdog.period_s == math.inf
    assert rig.node.read(0x1400, 5) == 100
    assert rig.node.read(0x1400, 1) == 0x205  # on again


def test_then_the_consumer_heartbeat(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig, 0x1400, watchdog_s=0.06)
    watchdog = rig.set_up().watchdog
    assert (watchdog.kind, watchdog.time_s) == ("consumer heartbeat", 0.06)
    assert watchdog.error_control == ErrorControlFrame(0x77F, b"\x05")
    assert watchdog.period_s == pytest.approx(0.02)
    assert rig.node.read(0x1016, 1) == 0x7F003C
    assert watchdog.passed_over == ("RPDO event timer: no 0x1400:05",)


def test_an_entry_that_watches_another_node_is_left_alone(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig, 0x1400)
    rig.node.write(0x1016, 1, 0x0901F4)
    rig.set_up()
    assert rig.node.read(0x1016, 1) == 0x0901F4
    assert rig.node.read(0x1016, 2) == 0x7F0064


@pytest.mark.parametrize("entry", [1, 2])
def test_an_entry_of_a_predecessor_is_taken_over(make_rig: RigFactory, entry: int) -> None:
    rig = rig_without(make_rig, 0x1400)
    rig.node.write(0x1016, entry, 0x7F01F4)
    assert rig.set_up().watchdog.kind == "consumer heartbeat"
    assert rig.node.read(0x1016, entry) == 0x7F0064


def test_then_life_guarding(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig, 0x1400, 0x1016)
    rig.node.write(0x1017, 0, 50)  # who sends heartbeats is not guarded
    watchdog = rig.set_up().watchdog
    assert (watchdog.kind, watchdog.error_control) == (
        "life guarding",
        ErrorControlFrame(0x705, remote=True),
    )
    assert watchdog.time_s == pytest.approx(0.102)
    assert watchdog.period_s == pytest.approx(0.034)
    assert [rig.node.read(i) for i in (0x100C, 0x100D, 0x1017)] == [34, 3, 0]


def test_what_is_refused_is_passed_over(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig)
    rig.tampering.read_only[(0x1400, 5)] = READ_ONLY
    rig.tampering.lies[(0x1016, 1)] = 0
    watchdog = rig.set_up().watchdog
    assert watchdog.kind == "life guarding"
    timer, heartbeat = watchdog.passed_over
    assert "writing 0x64 to 0x1400:05 failed" in timer
    assert "0x1016:01: wrote 0x7f0064, the drive keeps 0x0" in heartbeat
    assert rig.node.read(0x1400, 1) == 0x205


def test_what_is_passed_over_is_not_armed(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig)
    rig.tampering.lies = {(0x1400, 5): 0, (0x1016, 1): 0}
    assert rig.set_up().watchdog.kind == "life guarding"
    rig.tampering.lies = {}
    assert [rig.node.read(0x1400, i) for i in (1, 5)] == [0x205, 0]
    assert rig.node.read(0x1016, 1) == 0


@pytest.mark.parametrize(
    ("missing", "kind", "off"),
    [
        ((), "RPDO event timer", [(0x1400, 5)]),
        ((0x1400,), "consumer heartbeat", [(0x1016, 2)]),
        ((0x1400, 0x1016), "life guarding", [(0x100C, 0), (0x100D, 0)]),
    ],
)
def test_disarmed(
    make_rig: RigFactory, missing: tuple[int, ...], kind: str, off: list[tuple[int, int]]
) -> None:
    rig = rig_without(make_rig, *missing)
    if kind == "consumer heartbeat":
        rig.node.write(0x1016, 1, 0x0901F4)
    setup = rig.set_up()
    assert setup.watchdog.kind == kind
    armed = [rig.node.read(*key) for key in off]
    disarm(rig.node, setup.rpdo, setup.watchdog)
    assert 0 not in armed
    assert not any(rig.node.read(*key) for key in off)
    assert rig.node.read(0x1400, 1) == 0x205
    assert rig.tampering.drive.drive.nmt_state == PRE_OPERATIONAL
    if kind == "consumer heartbeat":
        assert rig.node.read(0x1016, 1) == 0x0901F4


def test_none_is_refused(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig, 0x1400, 0x1016, 0x100C)
    with pytest.raises(DriveError, match=r"no watchdog.*--accept-no-watchdog"):
        rig.set_up()


def test_none_may_be_accepted(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig, 0x1400, 0x1016, 0x100C, accept_no_watchdog=True)
    watchdog = rig.set_up().watchdog
    assert watchdog.kind == "none"
    assert len(watchdog.passed_over) == 3


def test_never_shorter_than_some_cycles(make_rig: RigFactory) -> None:
    settings = settings_with(REAL_TIME | {"bus.cycle_s": 0.05})
    assert make_rig(settings).set_up().watchdog.time_s == pytest.approx(0.15)


def test_simulated_time_has_time(make_rig: RigFactory) -> None:
    assert make_rig().set_up().watchdog.time_s == 30.0


@pytest.mark.parametrize(
    ("refused", "said"),
    [((), "disable voltage (0x6007 = 2)"), ((2,), "fault (0x6007 = 1)")],
)
def test_reaction(make_rig: RigFactory, refused: tuple[int, ...], said: str) -> None:
    rig = rig_without(make_rig)
    process = rig.tampering.drive.process

    def refusing(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        if can_id == 0x605 and data[:4] == b"\x2b\x07\x60\x00" and data[4] in refused:
            return [(0x585, b"\x80\x07\x60\x00\x30\x00\x09\x06")]
        return process(can_id, data)

    rig.tampering.drive.process = refusing  # type: ignore[method-assign]
    assert rig.set_up().watchdog.reaction == said


def test_watchdog_that_does_nothing_is_none(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig)
    rig.node.write(0x6007, 0, 0)
    rig.tampering.read_only[0x6007, 0] = READ_ONLY
    with pytest.raises(DriveError, match=r"no watchdog, .*0x6007 = 0, no action"):
        rig.set_up()


@pytest.mark.parametrize("parameter", [(0x6007, 0), (0x1400, 5), (0x6060, 0)])
def test_change_whose_answer_is_lost_is_undone(
    make_rig: RigFactory, parameter: tuple[int, int]
) -> None:
    rig = rig_without(make_rig, sdo_timeout_s=0.1)
    before = rig.node.read(*parameter)
    process, lost = rig.tampering.drive.process, []

    def losing(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        answers = process(can_id, data)
        written = data[0] >> 5 == 1 and (int.from_bytes(data[1:3], "little"), data[3]) == parameter
        if can_id == 0x605 and written and not lost:
            lost.append(data)
            return [frame for frame in answers if frame[0] != 0x585]
        return answers

    rig.tampering.drive.process = losing  # type: ignore[method-assign]
    with contextlib.suppress(DriveError):
        rig.set_up()
    assert lost
    assert rig.node.restore() == []
    assert rig.node.read(*parameter) == before


def test_without_0x6007_the_error_behaviour_must_change_the_state(make_rig: RigFactory) -> None:
    rig = rig_without(make_rig, 0x6007)
    rig.node.write(0x1029, 1, 1)
    assert "leaves NMT OPERATIONAL" in rig.set_up().watchdog.reaction
    assert rig.node.read(0x1029, 1) == 0


def test_no_other_node_may_have_the_number_of_the_master() -> None:
    with pytest.raises(Exception, match="no two nodes of a bus may share one"):
        settings_with({"bus.master_id": 5})
