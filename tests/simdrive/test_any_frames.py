"""Whatever comes over the bus, the drive goes on and keeps to the rules of the bus.

Frames of every kind under every identifier: random ones, and sequences that mean something (a PDO
is configured, a block transferred, the drive enabled, LSS) with something wrong in them, ticks and
SYNCs between.
"""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import can
import pytest
from can.interfaces.virtual import VirtualBus
from hypothesis import given, settings
from hypothesis import strategies as st
from simdrive_bench import (
    CONTROLWORD,
    EDS,
    EMCY,
    HEARTBEAT,
    NODE_ID,
    PERIOD_S,
    POSITION,
    PRE_OPERATIONAL,
    RPDO,
    SDO_REQUEST,
    SDO_RESPONSE,
    STATUSWORD,
    SYNC,
    TARGET_TORQUE,
    TPDO,
    Bench,
    RecordingMotion,
)
from vendors import OWN, path_of

from canwall.simdrive import BusRunner, Dictionary, ServoDrive

LSS_REQUEST, LSS_RESPONSE = 0x7E5, 0x7E4
DICTIONARIES = (OWN, "technosoft_iPOS.D.v1.04.eds")

Data: TypeAlias = tuple[int, bytes]
"""A data frame: CAN-ID and data."""

Event: TypeAlias = Data | int | float
"""A data frame, a remote frame by its CAN-ID, or seconds that pass."""

OBJECTS = (
    0x1003, 0x1005, 0x1006, 0x1010, 0x1014, 0x1016, 0x1017, 0x1018, 0x1019, 0x100C, 0x100D, 0x1400,
    0x1402, 0x1600, 0x1602, 0x1800, 0x1803, 0x1A00, 0x1A03, 0x2100, 0x6007, 0x6040, 0x605A, 0x605E,
    0x6060, 0x6071, 0x6072, 0x6087,
)  # fmt: skip
SDO_HEADS = (0x2F, 0x2B, 0x23, 0x22, 0x21, 0x20, 0x40, 0x60, 0x70, 0x00, 0x10, 0x01, 0xC6, 0xC2,
             0xC1, 0xA4, 0xA3, 0xA2, 0xA1)  # fmt: skip


def sdo(head: int, index: int, subindex: int, payload: int = 0) -> Data:
    return SDO_REQUEST, struct.pack("<BHBL", head, index, subindex, payload)


def lss(*content: int) -> Data:
    return LSS_REQUEST, bytes(content).ljust(8, b"\0")


def pdo(communication: int, cob_id: int, kind: int, mapping: Sequence[int]) -> list[Data]:
    """Configure a PDO in the order of CiA 301."""
    objects = communication + 0x200
    return [
        sdo(0x23, communication, 1, 1 << 31 | cob_id),
        sdo(0x2F, objects, 0, 0),
        *(sdo(0x23, objects, place, mapped) for place, mapped in enumerate(mapping, start=1)),
        sdo(0x2F, objects, 0, len(mapping)),
        sdo(0x2F, communication, 2, kind),
        sdo(0x23, communication, 1, cob_id),
    ]


def block_download(data: bytes, block: int) -> list[Data]:
    pieces = [data[at : at + 7] for at in range(0, len(data), 7)]
    segments = [
        (SDO_REQUEST, bytes([n % block + 1]) + piece.ljust(7, b"\0"))
        for n, piece in enumerate(pieces)
    ]
    last = segments[-1][1]
    segments[-1] = (SDO_REQUEST, bytes([last[0] | 0x80]) + last[1:])
    unused = 7 * len(pieces) - len(data)
    return [
        sdo(0xC2, 0x2100, 0, len(data)),
        *segments,
        (SDO_REQUEST, bytes([0xC1 | unused << 2]).ljust(8, b"\0")),
    ]


ENABLE = [
    (0x000, bytes([1, NODE_ID])),
    sdo(0x2F, 0x6060, 0, 10),
    *(sdo(0x2B, 0x6040, 0, controlword) for controlword in (0x80, 0x06, 0x07, 0x0F)),
    sdo(0x2B, 0x6071, 0, 100),
    (SYNC, b""),
    (SYNC, b""),
]
SEQUENCES: list[list[Data]] = [
    ENABLE,
    pdo(0x1400, RPDO[1], 1, [CONTROLWORD, TARGET_TORQUE])
    + pdo(0x1800, TPDO[1], 1, [STATUSWORD, POSITION])
    + [(RPDO[1], struct.pack("<Hh", word, 50)) for word in (0x06, 0x07, 0x0F)],
    pdo(0x1803, TPDO[4], 252, [POSITION]),
    pdo(0x1803, TPDO[4], 255, [POSITION, STATUSWORD]),
    block_download(bytes(range(200)), 127),
    block_download(bytes(2000), 127),
    [
        sdo(0xA4, 0x1008, 0, 3),
        (SDO_REQUEST, b"\xa3".ljust(8, b"\0")),
        (SDO_REQUEST, b"\xa2\x03\x03".ljust(8, b"\0")),
        (SDO_REQUEST, b"\xa1".ljust(8, b"\0")),
    ],
    [sdo(0x21, 0x2100, 0, 21), *((SDO_REQUEST, bytes([n << 4]) + bytes(7)) for n in (0, 1, 0))],
    [lss(4, 1), lss(0x11, 9), lss(0x17), lss(4, 0), (0x000, bytes([130, 0]))],
    [lss(4, 1), lss(0x11, 255), (0x000, bytes([129, 0])), lss(0x51, 0, 0, 0, 0, 0x80)],
    [lss(4, 1), lss(0x15, 20, 0), lss(0x5E)],
    [lss(0x46 + n, *bound) for n, bound in enumerate([(), (1,), (), (255,) * 4, (), (255,) * 4])],
    [sdo(0x23, 0x1016, 1, 0x00010014), (0x701, b"\x05")],
    [sdo(0x2B, 0x100C, 0, 10), sdo(0x2F, 0x100D, 0, 2)],
    [sdo(0x23, 0x1010, 1, int.from_bytes(b"save", "little")), (0x000, bytes([129, NODE_ID]))],
]

any_data = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8))
own_data = st.tuples(
    st.sampled_from((0, SYNC, SDO_REQUEST, LSS_REQUEST, 0x701, *RPDO.values())),
    st.binary(max_size=8),
)
nmt_command = st.tuples(
    st.just(0),
    st.builds(bytes, st.tuples(st.sampled_from((1, 2, 128, 129, 130)), st.just(NODE_ID))),
)
sdo_request = st.builds(
    sdo,
    st.sampled_from(SDO_HEADS),
    st.sampled_from(OBJECTS),
    st.integers(0, 9),
    st.one_of(
        st.integers(0, 2**32 - 1),
        st.integers(0, 300),
        st.sampled_from((0x205, 0x405, 0x80000205, 0x40000185, 0xC0000185, 0x00010064)),
        st.sampled_from((0x60400010, 0x60410010, 0x60640020, 0x60710010, 0x00050008)),
    ),
)
remote = st.integers(0, 0x7FF) | st.sampled_from((HEARTBEAT, SYNC, *TPDO.values()))
sync = st.tuples(st.just(SYNC), st.binary(max_size=1))
tick = st.floats(0.0, 1.0)
event = any_data | own_data | nmt_command | sdo_request | remote | sync | tick


@st.composite
def mutated(draw: st.DrawFn) -> list[Event]:
    """Draw a sequence with at most a few things wrong with it."""
    events: list[Event] = list(draw(st.sampled_from(SEQUENCES)))
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(events) - 1))
        chosen = events[at]
        fault = draw(st.sampled_from(("drop", "double", "later", "between", "bit", "short", "id")))
        if fault == "drop":
            del events[at]
        elif fault == "double":
            events.insert(at, chosen)
        elif fault == "later":
            events.append(events.pop(at))
        elif fault == "between":
            events.insert(at, draw(event))
        elif isinstance(chosen, tuple):
            can_id, data = chosen
            if fault == "id":
                events[at] = (can_id ^ 1 << draw(st.integers(0, 10)), data)
            elif fault == "short":
                events[at] = (can_id, data[: draw(st.integers(0, len(data)))])
            elif data:
                bit = draw(st.integers(0, 8 * len(data) - 1))
                number = int.from_bytes(data, "little") ^ 1 << bit
                events[at] = (can_id, number.to_bytes(len(data), "little"))
        if not events:
            break
    return events


event_lists = st.lists(st.lists(event, max_size=10) | mutated(), max_size=8).map(
    lambda parts: [one for part in parts for one in part]
)


class WatchedMotion(RecordingMotion):
    """Notes every torque that is not zero, and what the drive said of its state meanwhile."""

    drive: ServoDrive

    def advance(self, torque_nm: float, duration_s: float) -> None:
        if torque_nm:
            statusword = self.drive._dictionary[0x6041, 0].value
            assert statusword & 0x6F in (0x27, 0x07, 0x0F), "no torque but in these states"
        super().advance(torque_nm, duration_s)


class Fuzzed(Bench):
    """A drive that has been switched on, with a motion that watches it."""

    def __init__(self, path: Path) -> None:
        self.motion = motion = WatchedMotion()
        dictionary = Dictionary.load(path, NODE_ID)
        dictionary.supply(0x6076, 0, 637)
        self.drive = motion.drive = ServoDrive(dictionary, NODE_ID, motion, PERIOD_S)
        self.sent = self.drive.boot()
        self.tick()
        self.nmt(1)

    def happen(self, events: Sequence[Event]) -> None:
        for event in events:
            if isinstance(event, tuple):
                self.give(*event)
            elif isinstance(event, int):
                self.request(event)
            else:
                self.tick(event)

    def answers_a_valid_request(self) -> bool:
        """Return True if the device type can be read, whatever node-ID LSS has set."""
        self.tick(200.0)  # longer than any change of the bit timing
        self.give(*lss(4, 0))
        self.give(*lss(4, 1))
        ((_, answer),) = self.give(*lss(0x5E))
        node_id = answer[1]
        if node_id == 255:
            node_id = NODE_ID
            self.give(*lss(0x11, node_id))
        self.give(*lss(4, 0))
        self.nmt(PRE_OPERATIONAL, 0)
        self.give(0x600 + node_id, bytes.fromhex("80 0000 00 00000405"))
        frames = self.give(0x600 + node_id, bytes.fromhex("40 0010 00 00000000"))
        return (0x580 + node_id, bytes.fromhex("43 0010 00")) in [
            (can_id, data[:4]) for can_id, data in frames
        ]


@pytest.mark.slow
@pytest.mark.parametrize("file", DICTIONARIES)
@settings(max_examples=100, derandomize=True, deadline=None)
@given(events=event_lists)
def test_drive_survives(file: str, events: list[Event]) -> None:
    bench = Fuzzed(path_of(file))
    bench.happen(events)
    for can_id, data in bench.sent:
        assert 0 < can_id <= 0x7FF
        assert len(data) <= 8
    assert bench.answers_a_valid_request()


def without_enabling(event: Event) -> Event:
    """Take the command 'enable operation' (bits 0 to 3 of a controlword) out of a frame."""
    if not isinstance(event, tuple):
        return event
    can_id, data = event
    return can_id, bytes(byte & 0xF7 if byte & 0x0F == 0x0F else byte for byte in data)


@pytest.mark.slow
@pytest.mark.parametrize("file", DICTIONARIES)
@settings(max_examples=50, derandomize=True, deadline=None)
@given(events=event_lists)
def test_nobody_enables_it_nothing_moves(file: str, events: list[Event]) -> None:
    bench = Fuzzed(path_of(file))
    bench.happen([without_enabling(event) for event in events])
    for _ in range(3):
        bench.sync()
    assert not any(call[1] for call in bench.motion.calls if call[0] == "advance")


@pytest.mark.slow
def test_sequences_do_what_they_are_to_do() -> None:
    """As they stand, they lead into the depths: only then is it worth while to disturb them."""
    refused: list[bytes] = []
    for number, sequence in enumerate(SEQUENCES):
        bench = Fuzzed(EDS)
        bench.nmt(PRE_OPERATIONAL)
        bench.happen(sequence)
        refused += [
            frame for frame in bench.sent if frame[0] == SDO_RESPONSE and frame[1][0] == 0x80
        ]
        if sequence is ENABLE:
            assert any(call[1] for call in bench.motion.calls if call[0] == "advance")
        assert bench.answers_a_valid_request(), number
    assert refused == []


@pytest.mark.slow
@settings(max_examples=60, derandomize=True, deadline=None)
@given(frames=st.lists(any_data, max_size=60))
def test_drive_sends_under_its_own_identifiers_only(frames: list[Data]) -> None:
    own = {EMCY, SDO_RESPONSE, LSS_RESPONSE, HEARTBEAT, *TPDO.values()}
    bench = Bench()
    bench.nmt(1)
    for can_id, data in frames:
        if can_id not in (SDO_REQUEST, LSS_REQUEST):  # nobody reconfigures it
            bench.give(can_id, data)
    assert {can_id for can_id, _ in bench.sent} <= own


any_message = st.builds(
    can.Message,
    arbitration_id=st.integers(0, 0x7FF) | st.sampled_from((0, SYNC, SDO_REQUEST, HEARTBEAT)),
    is_extended_id=st.booleans(),
    is_remote_frame=st.booleans(),
    is_error_frame=st.booleans(),
    dlc=st.integers(0, 8),
)
fd_message = st.builds(
    lambda can_id, data: can.Message(
        arbitration_id=can_id, is_extended_id=False, is_fd=True, data=data
    ),
    st.sampled_from((0, SYNC, SDO_REQUEST, RPDO[1], RPDO[3], LSS_REQUEST)),
    st.binary(max_size=64),
)


def data_message(frame: Data) -> can.Message:
    return can.Message(arbitration_id=frame[0], data=frame[1], is_extended_id=False)


@pytest.mark.slow
@settings(max_examples=60, derandomize=True, deadline=None)
@given(
    messages=st.lists(
        any_message | fd_message | (any_data | own_data | sdo_request).map(data_message),
        max_size=40,
    )
)
def test_runner_survives_whatever_is_on_the_bus(messages: list[can.Message]) -> None:
    with VirtualBus("any frames") as master, VirtualBus("any frames") as bus:
        drive = ServoDrive(Dictionary.load(EDS, NODE_ID), NODE_ID, RecordingMotion(), PERIOD_S)
        runner = BusRunner(drive, bus)
        for message in messages:
            master.send(message)
            runner.poll()
        while (answer := master.recv(0)) is not None:
            assert (answer.is_error_frame, answer.is_remote_frame, answer.is_fd) == (False,) * 3
        for frame in (lss(4, 1), lss(0x11, NODE_ID), lss(4, 0), (0, bytes([130, 0]))):
            master.send(data_message(frame))
        master.send(data_message(sdo(0x40, 0x1000, 0)))
        runner.poll()
        frames = []
        while (answer := master.recv(0)) is not None:
            frames.append((answer.arbitration_id, bytes(answer.data)))
        assert (SDO_RESPONSE, bytes.fromhex("43 0010 00 92010200")) in frames
