"""Other nodes of a bus, as those of CANopenNode and Lely: what they send beside a wall."""

import struct
import threading
from collections.abc import Iterator

import can

SYNC = 0x080
NODE, DRIVE = 17, 5
#: Identifiers that only these nodes send.
HEARTBEAT, EMCY, TPDO, SDO_REQUEST, SDO_ANSWER, TIME = (
    0x700 + NODE,
    0x080 + NODE,
    0x180 + NODE,
    0x600 + NODE,
    0x580 + NODE,
    0x100,
)


def chatter(syncs: int) -> Iterator[can.Message]:
    """What they send after so many SYNCs: as consumers of SYNC, and at intervals of their own."""
    yield _frame(TPDO, struct.pack("<HiH", 0x1237, syncs, 0xFFFF))
    if syncs % 5 == 0:
        yield _frame(HEARTBEAT, b"\x05")
        yield _frame(0x700 + 99, b"\x7f")
    if syncs % 20 == 0:
        yield _frame(0x700 + 42, b"\x00")  # one of them boots, again and again
        yield _frame(EMCY, bytes.fromhex("3023050000000000"))
        yield _frame(EMCY, bytes(8))
        yield _frame(TIME, bytes(6))
        yield _frame(0x700 + NODE, remote=True)  # node guarding
    if syncs % 10 == 0:
        # Clients of SDO: of another node, in segments, and of our drive.
        yield _frame(SDO_REQUEST, bytes.fromhex("4018100100000000"))
        yield _frame(SDO_ANSWER, bytes.fromhex("4118100100010000"))
        yield _frame(SDO_REQUEST, bytes.fromhex("6000000000000000"))
        yield _frame(SDO_ANSWER, bytes.fromhex("0041424344454647"))
        yield _frame(0x600 + DRIVE, bytes.fromhex("4018100100000000"))
        yield _frame(0x600 + DRIVE, bytes.fromhex("4041600000000000"))


def _frame(can_id: int, data: bytes = b"", remote: bool = False) -> can.Message:
    return can.Message(
        arbitration_id=can_id, data=data, is_remote_frame=remote, is_extended_id=False
    )


class OtherNodes:
    """They are on a bus for the length of a `with` block, and answer to every so many SYNCs."""

    def __init__(self, bus: can.BusABC, every: int = 1) -> None:
        self._bus, self._every = bus, every
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> "OtherNodes":
        # The kernel drops all else, where there is one between: they have no need of it.
        self._bus.set_filters([{"can_id": SYNC, "can_mask": 0x7FF}])
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()

    def _serve(self) -> None:
        syncs = 0
        while not self._stop.is_set():
            message = self._bus.recv(0.01)
            if message is not None and message.arbitration_id == SYNC:
                syncs += 1
                if syncs % self._every == 0:
                    for frame in chatter(syncs // self._every):
                        self._bus.send(frame)
