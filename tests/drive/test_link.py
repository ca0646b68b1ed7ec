"""One thread for everything on the bus: SDO, EMCY and the frames of others, among one another."""

import errno
import logging
import math
import struct

import can
import pytest
from can.interfaces.virtual import VirtualBus
from rig import SDO_ANSWER, Rig, RigFactory

from canwall.drive import DriveError, Link


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig()


def answer(index: int, value: int) -> bytes:
    """An expedited upload response of four bytes."""
    return struct.pack("<BHBL", 0x43, index, 0, value)


def from_the_drive(rig: Rig, can_id: int, data: bytes, **kinds: bool) -> None:
    rig.drive_bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False, **kinds))


# SDO


def test_answers_that_come_too_late_answer_nothing(rig: Rig) -> None:
    for value in (1, 2, 3):
        from_the_drive(rig, SDO_ANSWER, answer(0x6041, value))
    assert rig.node.read(0x1000) == 0x20192


def test_late_answer_after_the_request(make_rig: RigFactory) -> None:
    rig = make_rig()
    process = rig.tampering.process

    def late(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        return [(SDO_ANSWER, answer(0x6041, 7)), *process(can_id, data)]

    rig.tampering.process = late  # type: ignore[method-assign]
    assert rig.node.read(0x1000) == 0x20192
    rig.node.set(0x6071, 0, -5)


def test_abort_of_another_request_is_none(rig: Rig) -> None:
    process = rig.tampering.process
    abort = struct.pack("<BHBL", 0x80, 0x6041, 0, 0x08000000)

    def late(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        return [(SDO_ANSWER, abort), *process(can_id, data)]

    rig.tampering.process = late  # type: ignore[method-assign]
    assert rig.node.read(0x1000) == 0x20192


def test_abort_may_name_no_object(rig: Rig) -> None:
    abort = struct.pack("<BHBL", 0x80, 0, 0, 0x08000021)
    rig.tampering.process = lambda *frame: [(SDO_ANSWER, abort)]  # type: ignore[method-assign]
    with pytest.raises(DriveError, match="0x08000021"):
        rig.node.read(0x1000)


def test_other_frames_do_not_disturb(rig: Rig) -> None:
    for data in (b"", b"\x01", bytes(8)):
        for can_id in (0x000, 0x080, 0x085, 0x123, 0x185, 0x585, 0x705):
            from_the_drive(rig, can_id, data)
    assert rig.node.read(0x1000) == 0x20192


@pytest.mark.parametrize("data", [b"", b"\x43", answer(0x1000, 1)[:4]])
def test_frame_too_short_for_an_sdo_is_no_answer(rig: Rig, data: bytes) -> None:
    from_the_drive(rig, SDO_ANSWER, data)
    assert rig.node.read(0x1000) == 0x20192


def test_segmented_answer(rig: Rig) -> None:
    name = rig.node.read(0x1008)
    assert name.to_bytes(29, "little") == b"canwall simulated servo drive"


def test_negative_numbers(rig: Rig) -> None:
    rig.node.write(0x6071, 0, -1)
    assert rig.node.read(0x6071) == -1


def test_failures_are_not_logged_as_well(
    rig: Rig, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # as in a program, not as in pytest
    rig.tampering.mute.add(SDO_ANSWER)
    with pytest.raises(DriveError):
        rig.node.read(0x1000)
    assert capfd.readouterr().err == ""


# EMCY


def test_emergencies_reach_the_node(rig: Rig) -> None:
    assert rig.node.emergencies == []
    for code in (0x2310, 0x0000, 0x8130):
        from_the_drive(rig, 0x085, struct.pack("<HB5s", code, 0x11, bytes(5)))
    while rig.link.serve(0.0):
        pass
    assert [emergency.code for emergency in rig.node.emergencies] == [0x2310, 0x0000, 0x8130]


# Frames


def test_remote_and_error_frames_are_ignored(rig: Rig) -> None:
    from_the_drive(rig, SDO_ANSWER, b"", is_remote_frame=True)
    from_the_drive(rig, SDO_ANSWER, answer(0x1000, 1), is_error_frame=True)
    assert rig.node.read(0x1000) == 0x20192
    from_the_drive(rig, 0x185, b"", is_remote_frame=True)
    from_the_drive(rig, 0x185, b"late", is_error_frame=True)
    from_the_drive(rig, 0x185, b"data")
    message = rig.link.wait_for((0x185,), 1.0)
    assert message is not None
    assert bytes(message.data) == b"data"


def test_wait_for_hands_the_rest_to_the_network(rig: Rig) -> None:
    from_the_drive(rig, 0x085, struct.pack("<HB5s", 0x4210, 1, bytes(5)))
    from_the_drive(rig, 0x185, b"mine")
    from_the_drive(rig, 0x285, b"next")
    assert rig.link.wait_for((0x185,), 1.0) is not None
    assert len(rig.node.emergencies) == 1
    message = rig.link.receive(0.0)
    assert message is not None
    assert message.arbitration_id == 0x285
    assert rig.link.wait_for((0x185,), 0.0) is None


def test_everything_is_noted(rig: Rig) -> None:
    rig.node.read(0x1000)
    assert rig.frames == [
        (0x605, b"\x40\x00\x10\x00\0\0\0\0"),
        (0x705, b"\0"),
        (0x585, answer(0x1000, 0x20192)),
    ]


def test_without_idle_the_bus_is_waited_on(rig: Rig) -> None:
    link = Link(rig.bus)
    assert link.receive(0.0) is not None  # boot-up
    assert link.receive(0.001) is None
    from_the_drive(rig, 0x185, b"here")
    assert link.serve(1.0)
    link.close()
    with pytest.raises(can.CanOperationError):
        link.receive(0.0)


# A transmit queue that is full, as SocketCAN tells it


class FullQueue(VirtualBus):
    """Takes no frame for a number of attempts, then all of them."""

    def __init__(self, channel: str, attempts: float, code: int = errno.ENOBUFS) -> None:
        super().__init__(channel)
        # Of the sort that SocketCAN has.
        self.attempts, self.code, self.channel_info = attempts, code, channel

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.attempts > 0:
            self.attempts -= 1
            raise can.CanOperationError("Failed to transmit", self.code)
        super().send(msg, timeout)


def test_full_queue_is_waited_for() -> None:
    noted: list[int] = []
    with FullQueue("full queue", 3) as bus, VirtualBus("full queue") as other:
        link = Link(bus)
        link.log = lambda time_s, message, received: noted.append(message.arbitration_id)
        link.send(can.Message(arbitration_id=0x205, is_extended_id=False))
        received = other.recv(0)
        assert received is not None
        assert received.arbitration_id == 0x205
        assert other.recv(0) is None
    assert noted == [0x205]


def test_queue_that_stays_full_is_an_error() -> None:
    noted: list[int] = []
    with FullQueue("can7", math.inf) as bus:
        link = Link(bus)
        link.log = lambda time_s, message, received: noted.append(message.arbitration_id)
        with pytest.raises(
            can.CanOperationError,
            match="the transmit queue of can7 stays full: does anybody acknowledge",
        ):
            link.send(can.Message(arbitration_id=0x205, is_extended_id=False))
    assert noted == []


def test_another_error_is_not_waited_for() -> None:
    with FullQueue("can7", 1, errno.ENETDOWN) as bus:
        with pytest.raises(
            can.CanOperationError, match="can7 is down; as root: ip link set can7 up"
        ):
            Link(bus).send(can.Message(arbitration_id=0x205, is_extended_id=False))
        assert bus.attempts == 0


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENODEV, "there is no interface can7; `ip link` shows which there are"),
        (errno.EIO, f"Failed to receive [Error Code {errno.EIO}]"),
    ],
)
def test_what_fails_to_be_received_is_said_in_words(code: int, words: str) -> None:
    def fail(timeout: float | None = None) -> None:
        raise can.CanOperationError("Failed to receive", code)

    with FullQueue("can7", 0) as bus:
        bus.recv = fail  # type: ignore[method-assign]
        with pytest.raises(can.CanOperationError) as raised:
            Link(bus).receive(0.0)
    assert str(raised.value) == words


def test_a_short_number_in_29_bits_is_another_identifier(rig: Rig) -> None:
    heard: list[int] = []
    rig.link.network.subscribe(0x085, lambda can_id, data, timestamp: heard.append(can_id))
    for extended in (True, False):
        for can_id in (0x085, 0x185):
            message = can.Message(arbitration_id=can_id, is_extended_id=extended, data=bytes(8))
            rig.drive_bus.send(message)
    message = rig.link.wait_for([0x185], 1.0)
    assert message is not None
    assert not message.is_extended_id
    assert heard == [0x085]
