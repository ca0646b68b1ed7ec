"""Who answers: nobody, another node, a slow or a stopped drive, or two of them."""

import time
from collections.abc import Iterator

import can
import pytest
from can.interfaces.virtual import VirtualBus
from rig import SDO_REQUEST, Loop, Rig, RigFactory, settings_with

from canwall import simdrive
from canwall.bench import Findings, examine
from canwall.drive import REQUIRED_OBJECTS, DriveError, DriveNode

QUICK = {"drive.wait_s": 0.0, "drive.sdo_timeout_s": 0.05}


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with(QUICK))


@pytest.mark.slow
def test_another_node_answers(rig: Rig) -> None:
    node = DriveNode(rig.link, 6, rig.node.dictionary, 0.05)
    with pytest.raises(
        DriveError, match=r"node 6 does not answer .*, but node 5 does: is drive\.no"
    ):
        node.wait_until_present(0.0)


@pytest.mark.parametrize(
    ("native", "hint"),
    [(False, 'bus.interface = "virtual" ends at this process'), (True, "`canwall drive CONFIG`")],
)
def test_nobody_answers(make_rig: RigFactory, native: bool, hint: str) -> None:
    rig = make_rig(settings_with(QUICK), native=native)
    rig.link.idle = lambda: None
    with pytest.raises(
        DriveError, match=r"does not answer within 0\.05 s, nor does any other; is .*" + hint
    ):
        rig.set_up()


def test_stopped_drive_is_woken(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with(QUICK | {"drive.wait_s": 5.0}))
    rig.inject(0x000, b"\x02\x05")
    rig.set_up()


class Slow:
    """The drive of a rig takes its time for every request."""

    def __init__(self, rig: Rig, delay_s: float) -> None:
        self._rig, self._delay_s, self._due = rig, delay_s, 0.0
        rig.link.log = self._note
        rig.link.idle = self._idle

    def _note(self, time_s: float, message: can.Message, received: bool) -> None:
        if message.arbitration_id == SDO_REQUEST:
            self._due = time.monotonic() + self._delay_s

    def _idle(self) -> None:
        if time.monotonic() >= self._due:
            self._rig.runner.poll()


def test_drive_that_is_slower_than_the_time_out(rig: Rig) -> None:
    Slow(rig, 0.2)
    with pytest.raises(
        DriveError, match=r"node 5 does not .*, but is on the bus: raise drive\.sdo"
    ):
        rig.set_up()


def test_time_out_for_a_slow_drive(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"drive.sdo_timeout_s": 2.0}))
    Slow(rig, 0.35)
    assert rig.node.read(0x1000) == 0x20192


def test_late_abort_is_not_the_answer_to_a_later_request(rig: Rig) -> None:
    rig.inject(0x585, bytes.fromhex("80 02 65 00 00 00 02 06"))  # for 0x6502
    assert rig.node.read(0x1000) == 0x20192


# Two drives with one node-ID


@pytest.fixture
def twins(make_rig: RigFactory) -> Iterator[Rig]:
    rig = make_rig(settings_with(QUICK | {"drive.sdo_timeout_s": 1.0}))
    assert rig.settings.simulation is not None
    with VirtualBus(rig.drive_bus.channel_id) as bus:  # type: ignore[attr-defined]
        other = simdrive.make_drive(rig.settings.drive, rig.settings.simulation, 0.001)
        runner = simdrive.BusRunner(other, bus)

        def both() -> None:
            rig.runner.poll()
            runner.poll()

        rig.link.idle = both
        yield rig


def test_two_drives_are_named_at_the_set_up(twins: Rig) -> None:
    with pytest.raises(DriveError, match=r"two drives have node-ID 5: requests .* answered twice"):
        twins.set_up()


def test_doctor_names_two_drives(twins: Rig) -> None:
    findings = Findings()
    examine(twins.link, twins.settings, REQUIRED_OBJECTS, lambda step: None, findings)
    (trouble,) = findings.troubles
    assert trouble.found.startswith("two drives have node-ID 5")
    assert trouble.do == "give one of them another node-ID"


def test_boot_up_during_the_set_up(rig: Rig) -> None:
    note = rig.link.log
    assert note is not None

    def switch_on(time_s: float, message: can.Message, received: bool) -> None:
        note(time_s, message, received)
        if (message.arbitration_id, message.data[1:3]) == (SDO_REQUEST, b"\x02\x65"):
            rig.inject(0x705, b"\0")

    rig.link.log = switch_on
    with pytest.raises(DriveError, match=r"restarted during the set-up, or a second drive with"):
        rig.set_up()


def test_one_drive_is_one(rig: Rig) -> None:
    rig.set_up()
    assert rig.node._node.sdo.doubled == 0


def test_second_tpdo_in_the_cycle(make_rig: RigFactory) -> None:
    loop = Loop(make_rig())

    def twin(j: int) -> bool:
        if j >= 300:
            loop.rig.inject(0x185, bytes(8))
        return False

    (trip,) = loop.run(600, twin).trips
    assert "more than one TPDO (0x185) for each SYNC: two drives have node-ID 5" in trip
    assert loop.rows()["torque_cmd"][-1] == 0.0
