"""PDO parameters: the order of CiA 301 (7.5.2.35 to 38) is accepted, everything else refused."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from canopen import SdoAbortedError
from rig import eds_with
from simdrive_bench import (
    ACTUAL_TORQUE,
    CONTROLWORD,
    NO_RTR,
    NOT_VALID,
    POSITION,
    RPDO,
    START,
    STATUSWORD,
    TARGET_TORQUE,
    TPDO,
    Bench,
)

DEVICE_STATE = "08000022"
INVALID_VALUE = "06090030"
NOT_MAPPABLE = "06040041"
PDO_LENGTH = "06040042"
NO_OBJECT = "06020000"
NO_SUBINDEX = "06090011"
TOO_HIGH = "06090031"


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_order_of_cia_301(bench: Bench, number: int) -> None:
    rpdo, tpdo = 0x1400 + number - 1, 0x1800 + number - 1
    bench.configure_pdo(rpdo, RPDO[number], 1, [TARGET_TORQUE, CONTROLWORD])
    bench.configure_pdo(tpdo, NO_RTR | TPDO[number], 1, [ACTUAL_TORQUE, POSITION, STATUSWORD])
    assert bench.read(rpdo, 1) == RPDO[number]
    assert bench.read(rpdo, 2) == 1
    assert bench.read(tpdo, 1) == NO_RTR | TPDO[number]
    assert [bench.read(tpdo + 0x200, n) for n in range(5)] == [
        3,
        ACTUAL_TORQUE,
        POSITION,
        STATUSWORD,
        0,
    ]
    bench.nmt(START)
    ((_, data),) = [frame for frame in bench.sync() if frame[0] == TPDO[number]]
    assert data == struct.pack("<hiH", 0, bench.motion.position, 0x0250)


def test_only_the_mapped_number_of_entries_is_sent(bench: Bench) -> None:
    bench.configure_pdo(0x1803, NO_RTR | TPDO[4], 1, [STATUSWORD, POSITION])
    bench.write(0x1803, 1, NOT_VALID | NO_RTR | TPDO[4], 4)
    bench.write(0x1A03, 0, 1, 1)
    bench.write(0x1803, 1, NO_RTR | TPDO[4], 4)
    bench.nmt(START)
    assert (TPDO[4], b"\x50\x02") in bench.sync()


def write(index: int, subindex: int, value: int, size: int) -> Callable[[Bench], None]:
    return lambda bench: bench.write(index, subindex, value, size)


def invalid_pdo(*writes: Callable[[Bench], None]) -> Callable[[Bench], None]:
    """Do the writes while RPDO1 and TPDO1 are invalid and have nothing mapped."""

    def act(bench: Bench) -> None:
        for communication, cob_id in ((0x1400, RPDO[1]), (0x1800, NO_RTR | TPDO[1])):
            bench.write(communication, 1, NOT_VALID | cob_id, 4)
            bench.write(communication + 0x200, 0, 0, 1)
        for each in writes:
            each(bench)

    return act


REFUSED: dict[str, tuple[str, Callable[[Bench], None]]] = {
    "count of a valid PDO": (DEVICE_STATE, write(0x1600, 0, 0, 1)),
    "mapping of a valid PDO": (DEVICE_STATE, write(0x1A00, 1, POSITION, 4)),
    "mapping with a count": (DEVICE_STATE, write(0x1A03, 1, POSITION, 4)),
    "CAN-ID of a valid PDO": (DEVICE_STATE, write(0x1800, 1, NO_RTR | 0x1A5, 4)),
    "inhibit time of a valid PDO": (DEVICE_STATE, write(0x1800, 3, 10, 2)),
    "valid with nothing mapped": (DEVICE_STATE, invalid_pdo(write(0x1400, 1, RPDO[1], 4))),
    "29-bit identifier": (INVALID_VALUE, write(0x1403, 1, 0x20000505, 4)),
    "29-bit identifier, not valid": (INVALID_VALUE, write(0x1403, 1, 0xA0000505, 4)),
    "reserved bits": (INVALID_VALUE, write(0x1803, 1, 0x80001505, 4)),
    "identifier of the SDO": (INVALID_VALUE, write(0x1403, 1, 0x605, 4)),
    "identifier of SYNC for a TPDO": (INVALID_VALUE, write(0x1803, 1, NO_RTR | 0x080, 4)),
    "identifier of SYNC for an RPDO": (INVALID_VALUE, write(0x1403, 1, 0x080, 4)),
    "identifier of the own EMCY": (INVALID_VALUE, write(0x1803, 1, NO_RTR | 0x085, 4)),
    "identifier of TIME": (INVALID_VALUE, write(0x1803, 1, NO_RTR | 0x100, 4)),
    "identifier of a heartbeat": (INVALID_VALUE, write(0x1803, 1, NO_RTR | 0x705, 4)),
    "identifier of NMT": (INVALID_VALUE, write(0x1403, 1, 0x000, 4)),
    "transmission type 241": (INVALID_VALUE, write(0x1800, 2, 241, 1)),
    "transmission type 251": (INVALID_VALUE, write(0x1800, 2, 251, 1)),
    "remote frames to an RPDO": (INVALID_VALUE, write(0x1400, 2, 252, 1)),
    "remote frames to an RPDO, event-driven": (INVALID_VALUE, write(0x1400, 2, 253, 1)),
    "object that is not there": (NO_OBJECT, invalid_pdo(write(0x1A00, 1, 0x60990010, 4))),
    "sub-index that is not there": (NO_SUBINDEX, invalid_pdo(write(0x1A00, 1, 0x60410110, 4))),
    "object not for PDOs": (NOT_MAPPABLE, invalid_pdo(write(0x1A00, 1, 0x10000020, 4))),
    "status into an RPDO": (NOT_MAPPABLE, invalid_pdo(write(0x1600, 1, STATUSWORD, 4))),
    "control into a TPDO": (NOT_MAPPABLE, invalid_pdo(write(0x1A00, 1, CONTROLWORD, 4))),
    "wrong length": (NOT_MAPPABLE, invalid_pdo(write(0x1A00, 1, 0x60640010, 4))),
    "dummy into a TPDO": (NO_OBJECT, invalid_pdo(write(0x1A00, 1, 0x00050008, 4))),
    "dummy of wrong length": (NOT_MAPPABLE, invalid_pdo(write(0x1600, 1, 0x00050010, 4))),
    "bit as dummy": (NO_OBJECT, invalid_pdo(write(0x1600, 1, 0x00010001, 4))),
    "empty entry counted": (
        NO_OBJECT,
        invalid_pdo(write(0x1A00, 1, 0, 4), write(0x1A00, 0, 1, 1)),
    ),
    "more than 64 bits": (
        PDO_LENGTH,
        invalid_pdo(
            write(0x1A00, 1, POSITION, 4),
            write(0x1A00, 2, POSITION, 4),
            write(0x1A00, 3, STATUSWORD, 4),
            write(0x1A00, 0, 3, 1),
        ),
    ),
    "nine objects": (TOO_HIGH, invalid_pdo(write(0x1A00, 0, 9, 1))),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(bench: Bench, name: str) -> None:
    code, act = REFUSED[name]
    with pytest.raises(SdoAbortedError, match=code):
        act(bench)


def test_refused_write_leaves_the_pdo_as_it_is(bench: Bench) -> None:
    with pytest.raises(SdoAbortedError):
        bench.write(0x1A00, 1, POSITION, 4)
    assert bench.nmt(START)[0] == (TPDO[1], b"\x00\x00")


def test_sync_elsewhere_takes_its_identifier(bench: Bench) -> None:
    bench.write(0x1005, 0, 0x1F1, 4)
    for cob_id in (0x1F1, 0x080):  # others may still produce the usual one
        with pytest.raises(SdoAbortedError, match=INVALID_VALUE):
            bench.write(0x1803, 1, NO_RTR | cob_id, 4)


@pytest.mark.parametrize("unserved", [0x60990010, 0x10000020, 0x60410110])
def test_mapping_of_the_file_that_is_not_served_is_a_gap(tmp_path: Path, unserved: int) -> None:
    """As Elmo's 0x1601, which maps 0x2013: nobody has to use it, and it can be put back."""
    bench = Bench(
        eds_with(tmp_path / "gap.eds", {("1A00sub1", "DefaultValue"): f"{unserved:#010x}"})
    )
    assert bench.nmt(START)[0] == (TPDO[1], bytes((unserved & 0xFF) // 8))
    bench.configure_pdo(0x1800, NO_RTR | TPDO[1], 255, [STATUSWORD])
    bench.configure_pdo(0x1800, NO_RTR | TPDO[1], 255, [unserved])
    assert bench.read(0x1A00, 1) == unserved
    with pytest.raises(SdoAbortedError):  # another PDO does not have it from the file
        bench.configure_pdo(0x1803, NO_RTR | TPDO[4], 255, [unserved])


def test_empty_pdo_that_begins_valid_may_be_so_again(tmp_path: Path) -> None:
    """As Elmo's Whistle has it."""
    bench = Bench(eds_with(tmp_path / "empty.eds", {("1600sub0", "DefaultValue"): "0"}))
    before = bench.read(0x1400, 1)
    assert not before & NOT_VALID
    assert bench.read(0x1600, 0) == 0
    bench.configure_pdo(0x1400, RPDO[1], 1, [CONTROLWORD])
    bench.write(0x1400, 1, NOT_VALID | RPDO[1], 4)
    bench.write(0x1600, 0, 0, 1)
    bench.write(0x1400, 1, before, 4)
    bench.nmt(START)
    bench.give(RPDO[1], b"\x06\x00")
    assert bench.read(0x6040) == 0


def test_mapping_changes_while_valid_if_the_identifier_is_read_only(tmp_path: Path) -> None:
    """As Elmo's SimplIQ has it."""
    bench = Bench(eds_with(tmp_path / "fixed.eds", {("1800sub1", "AccessType"): "ro"}))
    bench.nmt(START)
    bench.write(0x1A00, 0, 0, 1)
    assert TPDO[1] not in [can_id for can_id, _ in bench.sync()]
    bench.write(0x1A00, 1, POSITION, 4)
    bench.write(0x1A00, 0, 1, 1)
    bench.write(0x1800, 2, 1, 1)
    frames = bench.sync()
    assert (TPDO[1], struct.pack("<i", bench.motion.position)) in frames


def test_identifier_may_change_with_the_write_that_invalidates(bench: Bench) -> None:
    bench.write(0x1402, 1, NOT_VALID | 0x1A5, 4)
    bench.write(0x1402, 1, 0x1A5, 4)
    assert bench.read(0x1402, 1) == 0x1A5


def test_transmission_type_and_event_timer_change_while_valid(bench: Bench) -> None:
    bench.nmt(START)
    bench.write(0x1800, 2, 1, 1)
    bench.write(0x1800, 5, 10, 2)
    assert TPDO[1] in [can_id for can_id, _ in bench.sync()]


def test_dummies_skip_bytes_of_an_rpdo(bench: Bench) -> None:
    bench.configure_pdo(0x1403, RPDO[4], 255, [0x00050008, TARGET_TORQUE, 0x00070020])
    bench.nmt(START)
    bench.give(RPDO[4], b"\xff\x34\x12\xff\xff\xff\xff")
    assert bench.read(0x6071) == 0x1234


def test_two_rpdos_may_listen_to_one_identifier(bench: Bench) -> None:
    bench.configure_pdo(0x1402, 0x1F0, 255, [CONTROLWORD])
    bench.configure_pdo(0x1403, 0x1F0, 255, [TARGET_TORQUE])
    bench.nmt(START)
    bench.give(0x1F0, b"\x06\x00")
    assert bench.read(0x6040) == 6
    assert bench.read(0x6071) == 6
