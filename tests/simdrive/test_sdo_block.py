"""SDO block transfer by the letter of CiA 301, 7.2.4.3.9 to 7.2.4.3.16."""

import struct
from binascii import crc_hqx

import pytest
from canopen import SdoAbortedError
from simdrive_bench import SDO_REQUEST, SDO_RESPONSE, Bench

DATA = bytes(range(256)) * 8  # three blocks: 127, 127 and 39 segments
MEMORY = 0x2100
DEVICE_NAME = b"canwall simulated servo drive"


def initiate(head: int, index: int, payload: bytes = b"") -> bytes:
    return struct.pack("<BHB4s", head, index, 0, payload)


def frame(*head: int) -> bytes:
    return bytes(head).ljust(8, b"\0")


def responses(bench: Bench, request: bytes) -> list[bytes]:
    return [data for can_id, data in bench.give(SDO_REQUEST, request) if can_id == SDO_RESPONSE]


def segments(data: bytes, block_size: int = 127) -> list[bytes]:
    """Return the first block of what has still to be sent."""
    pieces = [data[at : at + 7] for at in range(0, len(data), 7)]
    block = [bytes([n]) + piece.ljust(7, b"\0") for n, piece in enumerate(pieces[:block_size], 1)]
    if len(pieces) <= block_size:
        block[-1] = bytes([block[-1][0] | 0x80]) + block[-1][1:]
    return block


def start_download(bench: Bench, head: int = 0xC6, size: int = len(DATA)) -> None:
    response = bench.sdo(initiate(head, MEMORY, size.to_bytes(4, "little")))
    assert response == initiate(0xA4, MEMORY, b"\x7f")


def end(data: bytes) -> bytes:
    return frame(0xC1 | -len(data) % 7 << 2, *crc_hqx(data, 0).to_bytes(2, "little"))


def give_block(bench: Bench, block: list[bytes]) -> bytes:
    """Give a block; return the response to it."""
    *first, last = block
    for segment in first:
        assert responses(bench, segment) == []
    (response,) = responses(bench, last)
    return response


def stored(bench: Bench) -> object:
    return bench.drive._dictionary[MEMORY, 0].value


@pytest.mark.parametrize("head", [0xC6, 0xC4, 0xC2, 0xC0])
def test_download(bench: Bench, head: int) -> None:
    start_download(bench, head)
    rest = DATA
    for count in (127, 127, 39):
        assert give_block(bench, segments(rest)) == frame(0xA2, count, 127)
        rest = rest[count * 7 :]
    assert stored(bench) == b""
    checked = end(DATA) if head & 4 else frame(0xC1 | 3 << 2)
    assert bench.sdo(checked) == frame(0xA1)
    assert stored(bench) == DATA


def test_segments_after_a_lost_one_are_sent_again(bench: Bench) -> None:
    start_download(bench)
    block = segments(DATA)
    del block[99]
    assert give_block(bench, block) == frame(0xA2, 99, 127)
    rest = DATA[99 * 7 :]
    assert give_block(bench, segments(rest)) == frame(0xA2, 127, 127)
    rest = rest[127 * 7 :]
    final = segments(rest)
    del final[0]
    assert give_block(bench, final) == frame(0xA2, 0, 127)
    assert give_block(bench, segments(rest)) == frame(0xA2, len(segments(rest)), 127)
    bench.sdo(end(DATA))
    assert stored(bench) == DATA


def test_a_doubled_segment_counts_once(bench: Bench) -> None:
    start_download(bench, size=21)
    first, second, third = segments(DATA[:21])
    for segment in (first, first, second, first):
        assert responses(bench, segment) == []
    assert responses(bench, third) == [frame(0xA2, 3, 127)]
    bench.sdo(end(DATA[:21]))
    assert stored(bench) == DATA[:21]


@pytest.mark.parametrize(
    ("head", "size", "last", "code"),
    [
        (0xC6, 7, end(DATA[:7]), None),
        (0xC6, 8, end(DATA[:7]), "06070013"),
        (0xC6, 6, end(DATA[:7]), "06070012"),
        (0xC6, 7, frame(0xC1, 1, 2), "05040004"),
        (0xC2, 7, frame(0xC1, 1, 2), None),
    ],
)
def test_end(bench: Bench, head: int, size: int, last: bytes, code: str | None) -> None:
    start_download(bench, head, size)
    give_block(bench, segments(DATA[:7]))
    if code is None:
        assert bench.sdo(last) == frame(0xA1)
        return
    with pytest.raises(SdoAbortedError, match=code):
        bench.sdo(last)
    assert stored(bench) == b""


def test_client_may_abort_within_a_block(bench: Bench) -> None:
    start_download(bench)
    assert responses(bench, segments(DATA)[0]) == []
    assert responses(bench, frame(0x80)) == []
    assert bench.read(0x1000) == 0x00020192


@pytest.mark.parametrize("request_head", [0xC6, 0xA4])
def test_refused_at_once(bench: Bench, request_head: int) -> None:
    with pytest.raises(SdoAbortedError, match="06020000"):
        bench.sdo(initiate(request_head, 0x2FFF, b"\x7f"))


def test_download_of_what_may_not_be_written(bench: Bench) -> None:
    with pytest.raises(SdoAbortedError, match="06010002"):
        bench.sdo(initiate(0xC6, 0x1008, b"\x02"))


def test_no_segment_has_the_number_0(bench: Bench) -> None:
    start_download(bench)
    with pytest.raises(SdoAbortedError, match="05040003"):
        bench.sdo(frame(0x00))


def start_upload(bench: Bench, block_size: int) -> None:
    bench.drive._dictionary[MEMORY, 0].value = DATA
    response = bench.sdo(initiate(0xA4, MEMORY, bytes([block_size])))
    assert response == initiate(0xC6, MEMORY, len(DATA).to_bytes(4, "little"))


def test_upload(bench: Bench) -> None:
    start_upload(bench, 127)
    assert responses(bench, frame(0xA3)) == segments(DATA)
    assert responses(bench, frame(0xA2, 127, 100)) == segments(DATA[889:], 100)
    assert responses(bench, frame(0xA2, 100, 127)) == segments(DATA[889 + 700 :])
    assert responses(bench, frame(0xA2, 66, 127)) == [end(DATA)]
    assert responses(bench, frame(0xA1)) == []
    assert bench.tick(10.0) == []


def test_segments_that_were_not_acknowledged_come_again(bench: Bench) -> None:
    start_upload(bench, 10)
    assert responses(bench, frame(0xA3)) == segments(DATA, 10)
    assert responses(bench, frame(0xA2, 4, 10)) == segments(DATA[28:], 10)
    assert responses(bench, frame(0xA2, 0, 127)) == segments(DATA[28:], 127)


def test_upload_of_nothing(bench: Bench) -> None:
    bench.sdo(initiate(0xA4, MEMORY, b"\x7f"))
    assert responses(bench, frame(0xA3)) == [frame(0x81)]
    assert responses(bench, frame(0xA2, 1, 127)) == [frame(0xC1 | 7 << 2)]


def test_client_would_rather_have_short_values_in_segments(bench: Bench) -> None:
    size = len(DEVICE_NAME)
    response = bench.sdo(initiate(0xA4, 0x1008, bytes([127, size])))
    assert response == initiate(0x41, 0x1008, bytes([size]))
    response = bench.sdo(initiate(0xA4, 0x1008, bytes([127, size - 1])))
    assert response == initiate(0xC6, 0x1008, bytes([size]))
