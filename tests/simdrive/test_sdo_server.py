"""The SDO server: expedited and segmented transfer, and every abort code that it knows."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from canopen import SdoAbortedError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from simdrive_bench import (
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    SDO_REQUEST,
    SDO_RESPONSE,
    STOP,
    Bench,
    eds_with,
)

from canwall.simdrive.communication.abort import AbortCode

SAVE = int.from_bytes(b"save", "little")
DEVICE_NAME = b"canwall simulated servo drive"

MORE_OBJECTS = """
[2000]
ParameterName=User text
ObjectType=0x7
DataType=0x0009
AccessType=rw
DefaultValue=as shipped
PDOMapping=0

[2001]
ParameterName=Trim
ObjectType=0x7
DataType=0x0003
LowLimit=-10
HighLimit=10
AccessType=rw
DefaultValue=-3
PDOMapping=0

[2002]
ParameterName=Strobe
ObjectType=0x7
DataType=0x0005
AccessType=wo
DefaultValue=0
PDOMapping=0

[2003]
ParameterName=Gain
ObjectType=0x7
DataType=0x0008
AccessType=rw
DefaultValue=0.5
PDOMapping=0

[2004]
ParameterName=Counter of 64 bits
ObjectType=0x7
DataType=0x001B
AccessType=rw
DefaultValue=0x0123456789ABCDEF
PDOMapping=0

[2005]
ParameterName=Empty text
ObjectType=0x7
DataType=0x0009
AccessType=ro
PDOMapping=0

[2006]
ParameterName=Counter of 24 bits
ObjectType=0x7
DataType=0x0010
AccessType=rw
DefaultValue=-2
PDOMapping=1
"""


@pytest.fixture
def more(tmp_path: Path) -> Bench:
    """With objects of every type, and a memory that cannot be written."""
    return Bench(eds_with(tmp_path, MORE_OBJECTS), tmp_path / "none" / "stored.json")


def initiate(head: int, index: int, subindex: int, payload: bytes = b"") -> bytes:
    return struct.pack("<BHB4s", head, index, subindex, payload)


def segment(head: int, payload: bytes = b"") -> bytes:
    return struct.pack("<B7s", head, payload)


def upload(bench: Bench, index: int, subindex: int = 0) -> bytes:
    """Segmented upload, by the letter of CiA 301, 7.2.4.3.6."""
    response = bench.sdo(initiate(0x40, index, subindex))
    assert response[:4] == initiate(0x41, index, subindex)[:4]
    (size,) = struct.unpack_from("<L", response, 4)
    data, toggle, last = b"", 0, False
    while not last:
        response = bench.sdo(segment(0x60 | toggle))
        assert response[0] & 0xF0 == toggle
        data += response[1 : 8 - (response[0] >> 1 & 7)]
        last = bool(response[0] & 1)
        toggle ^= 0x10
    assert len(data) == size
    return data


def download(bench: Bench, index: int, data: bytes, size: int | None = None) -> None:
    """Segmented download, by the letter of CiA 301, 7.2.4.3.3; ``size`` as indicated."""
    head, indicated = (0x20, b"") if size is None else (0x21, struct.pack("<L", size))
    assert bench.sdo(initiate(head, index, 0, indicated)) == initiate(0x60, index, 0)
    toggle = 0
    pieces = [data[at : at + 7] for at in range(0, len(data), 7)] or [b""]
    for place, piece in enumerate(pieces):
        last = place == len(pieces) - 1
        response = bench.sdo(segment(toggle | (7 - len(piece)) << 1 | last, piece))
        assert response == segment(0x20 | toggle)
        toggle ^= 0x10


def test_expedited_upload_of_each_size(bench: Bench) -> None:
    assert bench.sdo(initiate(0x40, 0x1001, 0)) == initiate(0x4F, 0x1001, 0, b"\0")
    assert bench.sdo(initiate(0x40, 0x6072, 0)) == initiate(0x4B, 0x6072, 0, b"\xb8\x0b")
    device_type = b"\x92\x01\x02\x00"
    assert bench.sdo(initiate(0x40, 0x1000, 0)) == initiate(0x43, 0x1000, 0, device_type)


def test_segmented_upload(bench: Bench, more: Bench) -> None:
    assert upload(bench, 0x1008) == DEVICE_NAME
    assert upload(bench, 0x1008) == DEVICE_NAME
    assert upload(more, 0x2004) == 0x0123456789ABCDEF.to_bytes(8, "little")
    assert upload(more, 0x2005) == b""


@pytest.mark.parametrize("size", [None, 4])
def test_segmented_download_of_a_number(bench: Bench, size: int | None) -> None:
    download(bench, 0x1014, (0x80000085).to_bytes(4, "little"), size)
    assert bench.read(0x1014) == 0x80000085


def test_expedited_download_without_size_has_that_of_the_object(bench: Bench) -> None:
    response = bench.sdo(initiate(0x22, 0x1017, 0, b"\x2c\x01\xff\xff"))
    assert response == initiate(0x60, 0x1017, 0)
    assert bench.read(0x1017) == 300


def test_other_data_types(more: Bench) -> None:
    assert more.read(0x2001, signed=True) == -3
    assert more.read(0x2006, signed=True) == -2
    more.write(0x2006, 0, -70000, 3)
    assert more.read(0x2006, signed=True) == -70000
    more.write(0x2003, 0, int.from_bytes(struct.pack("<f", -1.25), "little"), 4)
    assert struct.pack("<L", more.read(0x2003)) == struct.pack("<f", -1.25)


@settings(
    max_examples=40,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(text=st.binary(max_size=60), indicated=st.booleans())
def test_strings_of_any_length_come_back(more: Bench, text: bytes, indicated: bool) -> None:
    download(more, 0x2000, text, len(text) if indicated else None)
    if 0 < len(text) <= 4:
        response = more.sdo(initiate(0x40, 0x2000, 0))
        assert response[4 : 4 + len(text)] == text
    else:
        assert upload(more, 0x2000) == text


def test_new_transfer_replaces_the_old(bench: Bench) -> None:
    bench.sdo(initiate(0x40, 0x1008, 0))
    bench.sdo(segment(0x60))
    assert upload(bench, 0x1008) == DEVICE_NAME


def test_client_abort_ends_the_transfer_without_answer(bench: Bench) -> None:
    bench.sdo(initiate(0x40, 0x1008, 0))
    assert bench.give(SDO_REQUEST, initiate(0x80, 0x1008, 0)) == []
    with pytest.raises(SdoAbortedError, match="05040001"):
        bench.sdo(segment(0x60))


def test_abort_names_the_object_of_the_transfer(bench: Bench) -> None:
    bench.sdo(initiate(0x40, 0x1008, 0))
    ((_, response),) = bench.give(SDO_REQUEST, segment(0x70))
    assert response == initiate(0x80, 0x1008, 0, (0x05030000).to_bytes(4, "little"))


def test_abort_ends_the_transfer(bench: Bench) -> None:
    bench.sdo(initiate(0x40, 0x1008, 0))
    with pytest.raises(SdoAbortedError, match="05030000"):
        bench.sdo(segment(0x70))
    with pytest.raises(SdoAbortedError, match="05040001"):
        bench.sdo(segment(0x60))


def test_reset_ends_the_transfer(bench: Bench) -> None:
    bench.sdo(initiate(0x40, 0x1008, 0))
    bench.nmt(RESET_COMMUNICATION)
    with pytest.raises(SdoAbortedError, match="05040001"):
        bench.sdo(segment(0x60))


def test_hopeless_download_is_refused_before_its_data(bench: Bench) -> None:
    with pytest.raises(SdoAbortedError, match="06010002"):
        bench.sdo(initiate(0x20, 0x1008, 0))
    with pytest.raises(SdoAbortedError, match="06070012"):
        bench.sdo(initiate(0x21, 0x1017, 0, struct.pack("<L", 3)))


def test_frames_of_other_lengths_are_no_sdo(bench: Bench) -> None:
    assert bench.give(SDO_REQUEST, b"\x40\x00\x10\x00") == []


def test_no_sdo_in_stopped(bench: Bench) -> None:
    request = initiate(0x40, 0x1000, 0)
    bench.nmt(STOP)
    assert bench.give(SDO_REQUEST, request) == []
    bench.nmt(PRE_OPERATIONAL)
    assert len(bench.give(SDO_REQUEST, request)) == 1


def test_dummy_types_are_for_mapping_alone(bench: Bench) -> None:
    with pytest.raises(SdoAbortedError, match="06020000"):
        bench.read(0x0005)


def upload_with_wrong_toggle(bench: Bench) -> None:
    bench.sdo(initiate(0x40, 0x1008, 0))
    bench.sdo(segment(0x60))
    bench.sdo(segment(0x60))


def download_with_wrong_toggle(bench: Bench) -> None:
    bench.sdo(initiate(0x21, 0x1014, 0, struct.pack("<L", 4)))
    bench.sdo(segment(0x10 | 3 << 1 | 1))


def download_more_than_indicated(bench: Bench) -> None:
    bench.sdo(initiate(0x21, 0x2000, 0, struct.pack("<L", 5)))
    bench.sdo(segment(0x01, b"seven b"))


def download_more_than_indicated_and_go_on(bench: Bench) -> None:
    bench.sdo(initiate(0x21, 0x2000, 0, struct.pack("<L", 5)))
    bench.sdo(segment(0x00, b"seven b"))


def download_less_than_indicated(bench: Bench) -> None:
    bench.sdo(initiate(0x21, 0x2000, 0, struct.pack("<L", 9)))
    bench.sdo(segment(0x01, b"seven b"))


def download_without_end(bench: Bench) -> None:
    bench.sdo(initiate(0x20, 0x2000, 0))
    for count in range(10_000):
        bench.sdo(segment((count & 1) << 4, b"and on.."))


def map_too_much(bench: Bench) -> None:
    bench.write(0x1A03, 0, 0, 1)
    for place in (1, 2, 3):
        bench.write(0x1A03, place, 0x60640020, 4)
    bench.write(0x1A03, 0, 3, 1)


def map_control_into_a_tpdo(bench: Bench) -> None:
    bench.write(0x1A03, 0, 0, 1)
    bench.write(0x1A03, 1, 0x60400010, 4)


def watch_one_node_twice(bench: Bench) -> None:
    bench.write(0x1016, 1, 0x00010064, 4)
    bench.write(0x1016, 2, 0x000100C8, 4)


def block_out_of_sequence(bench: Bench) -> None:
    bench.sdo(initiate(0xA0, 0x1008, 0, b"\x7f"))
    bench.give(SDO_REQUEST, segment(0xA3))
    bench.sdo(segment(0xA2, bytes([6, 127])))


def block_with_wrong_crc(bench: Bench) -> None:
    bench.sdo(initiate(0xC4, 0x2000, 0))
    bench.sdo(segment(0x81, b"seven b"))
    bench.sdo(segment(0xC1))


def client_that_leaves(bench: Bench) -> None:
    bench.sdo(initiate(0xC4, 0x2000, 0))
    assert bench.tick(0.999) == []
    ((_, response),) = bench.tick(0.001)
    assert response[:4] == b"\x80\x00\x20\x00"
    raise SdoAbortedError(struct.unpack_from("<L", response, 4)[0])


def test_stopped_is_silent_and_ends_a_transfer(bench: Bench) -> None:
    bench.sdo(initiate(0x40, 0x1008, 0))
    assert bench.nmt(STOP) == []
    assert bench.give(SDO_REQUEST, segment(0x60)) == []
    assert bench.tick(2.0) == []
    bench.nmt(PRE_OPERATIONAL)
    with pytest.raises(SdoAbortedError):
        bench.sdo(segment(0x60))


ABORTS: list[tuple[AbortCode, Callable[[Bench], object]]] = [
    (AbortCode.TOGGLE_BIT, upload_with_wrong_toggle),
    (AbortCode.TOGGLE_BIT, download_with_wrong_toggle),
    (AbortCode.UNKNOWN_COMMAND, lambda bench: bench.sdo(segment(0x60))),
    (AbortCode.UNKNOWN_COMMAND, lambda bench: bench.sdo(segment(0x00))),
    (AbortCode.UNKNOWN_COMMAND, lambda bench: bench.sdo(initiate(0xA3, 0x1008, 0))),
    (AbortCode.UNKNOWN_COMMAND, lambda bench: bench.sdo(initiate(0xC1, 0x1017, 0))),
    (AbortCode.UNKNOWN_COMMAND, lambda bench: bench.sdo(initiate(0xE0, 0x1017, 0))),
    (AbortCode.TIME_OUT, client_that_leaves),
    (AbortCode.INVALID_BLOCK_SIZE, lambda bench: bench.sdo(initiate(0xA0, 0x1008, 0))),
    (AbortCode.INVALID_BLOCK_SIZE, lambda bench: bench.sdo(initiate(0xA0, 0x1008, 0, b"\x80"))),
    (AbortCode.INVALID_SEQUENCE_NUMBER, block_out_of_sequence),
    (AbortCode.CRC, block_with_wrong_crc),
    (AbortCode.OUT_OF_MEMORY, lambda bench: bench.sdo(initiate(0xC2, 0x2000, 0, b"\1\0\1\0"))),
    (AbortCode.OUT_OF_MEMORY, lambda bench: download(bench, 0x2000, b"", 65537)),
    (AbortCode.OUT_OF_MEMORY, download_without_end),
    (AbortCode.WRITE_ONLY, lambda bench: bench.read(0x2002)),
    (AbortCode.READ_ONLY, lambda bench: bench.write(0x6041, 0, 0, 2)),
    (AbortCode.READ_ONLY, lambda bench: bench.write(0x1018, 0, 4, 1)),
    (AbortCode.READ_ONLY, lambda bench: download(bench, 0x1008, b"another name")),
    (AbortCode.NO_OBJECT, lambda bench: bench.read(0x6099)),
    (AbortCode.NO_OBJECT, lambda bench: bench.write(0x6099, 0, 0, 4)),
    (AbortCode.NO_SUBINDEX, lambda bench: bench.read(0x1018, 5)),
    (AbortCode.NO_SUBINDEX, lambda bench: bench.read(0x6041, 1)),
    (AbortCode.NO_SUBINDEX, lambda bench: bench.read(0x1400, 3)),
    (AbortCode.NOT_MAPPABLE, map_control_into_a_tpdo),
    (AbortCode.PDO_LENGTH, map_too_much),
    (AbortCode.INCOMPATIBLE_PARAMETER, watch_one_node_twice),
    (AbortCode.TOO_LONG, download_more_than_indicated),
    (AbortCode.TOO_LONG, download_more_than_indicated_and_go_on),
    (AbortCode.TOO_SHORT, download_less_than_indicated),
    (AbortCode.TOO_LONG, lambda bench: bench.write(0x1017, 0, 0, 4)),
    (AbortCode.TOO_LONG, lambda bench: download(bench, 0x1017, bytes(8), 8)),
    (AbortCode.TOO_LONG, lambda bench: download(bench, 0x1017, bytes(8))),
    (AbortCode.TOO_SHORT, lambda bench: bench.write(0x1017, 0, 0, 1)),
    (AbortCode.TOO_SHORT, lambda bench: download(bench, 0x1014, b"")),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x6060, 0, 8, 1)),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x1003, 0, 1, 1)),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x1005, 0, 0x40000080, 4)),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x1005, 0, 0x20000080, 4)),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x1005, 0, 0x605, 4)),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x1014, 0, 0x40000085, 4)),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x1016, 1, 0x01010064, 4)),
    (AbortCode.INVALID_VALUE, lambda bench: bench.write(0x1016, 1, 0x00800064, 4)),
    (AbortCode.TOO_HIGH, lambda bench: bench.write(0x6072, 0, 3001, 2)),
    (AbortCode.TOO_HIGH, lambda bench: bench.write(0x2001, 0, 11, 2)),
    (AbortCode.TOO_LOW, lambda bench: bench.write(0x2001, 0, -11, 2)),
    (AbortCode.DEVICE_STATE, lambda bench: bench.write(0x1A00, 0, 0, 1)),
    (AbortCode.DEVICE_STATE, lambda bench: bench.write(0x1014, 0, 0x90, 4)),
    (AbortCode.NOT_STORED, lambda bench: bench.write(0x1010, 1, 1, 4)),
    (AbortCode.HARDWARE, lambda bench: bench.write(0x1010, 1, SAVE, 4)),
    (AbortCode.NO_DATA, lambda bench: bench.read(0x1003, 1)),
]


@pytest.mark.parametrize(("code", "access"), ABORTS)
def test_abort(more: Bench, code: AbortCode, access: Callable[[Bench], object]) -> None:
    with pytest.raises(SdoAbortedError) as aborted:
        access(more)
    assert aborted.value.code == code
    assert more.read(0x1000) == 0x00020192  # the server is ready again


def test_every_abort_code_is_seen_on_the_bus(more: Bench) -> None:
    for _, access in ABORTS:
        with pytest.raises(SdoAbortedError):
            access(more)
    seen = {
        AbortCode(struct.unpack_from("<L", data, 4)[0])
        for can_id, data in more.sent
        if can_id == SDO_RESPONSE and data[0] == 0x80
    }
    assert seen == set(AbortCode)
