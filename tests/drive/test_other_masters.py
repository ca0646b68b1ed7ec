"""A second master does not begin: it hears the first one, and says so."""

import threading
from collections.abc import Iterator

import can
import pytest
from can.interfaces.virtual import VirtualBus

from canwall.config import Bus
from canwall.drive import DriveError, Link, refuse_second_master


@pytest.fixture
def others() -> Iterator[VirtualBus]:
    with VirtualBus("masters") as bus:
        yield bus


@pytest.fixture
def link() -> Iterator[Link]:
    link = Link(VirtualBus("masters"))
    yield link
    link.close()


def _send(bus: VirtualBus, can_id: int, data: bytes = b"") -> None:
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


@pytest.mark.parametrize(
    ("can_id", "data", "what"),
    [
        (0x080, b"", "SYNC (0x080)"),
        (0x080, b"\1", "SYNC (0x080)"),
        (0x205, b"\0\0\0\0", "RPDO1 of node 5 (0x205)"),
        (0x77F, b"\5", "the heartbeat of node 127 (0x77f)"),
    ],
)
def test_what_only_a_master_sends(
    link: Link, others: VirtualBus, can_id: int, data: bytes, what: str
) -> None:
    _send(others, 0x7A0, bytes(8))
    _send(others, can_id, data)
    with pytest.raises(DriveError) as raised:
        refuse_second_master(link, Bus(), [4, 5])
    assert f"it sends {what}; end it first" in str(raised.value)


def test_it_is_heard_though_it_sends_later(link: Link, others: VirtualBus) -> None:
    later = threading.Timer(0.1, _send, (others, 0x080))
    later.start()
    with pytest.raises(DriveError, match="SYNC"):
        refuse_second_master(link, Bus(), [5])
    later.join()


def test_drives_and_tools_are_no_masters(link: Link, others: VirtualBus) -> None:
    for can_id, data in (
        (0x085, bytes(8)),
        (0x185, bytes(8)),
        (0x206, bytes(4)),
        (0x585, bytes(8)),
        (0x605, bytes(8)),
        (0x705, b"\x7f"),
    ):
        _send(others, can_id, data)
    others.send(can.Message(arbitration_id=0x080, is_extended_id=True))
    refuse_second_master(link, Bus(), [5])


def test_external_sync_is_wanted(link: Link, others: VirtualBus) -> None:
    _send(others, 0x080)
    refuse_second_master(link, Bus(sync="external"), [5])
