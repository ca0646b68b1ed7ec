"""Whatever comes over the bus, the drive goes on and keeps to the rules of the bus."""

import struct

from hypothesis import given, settings
from hypothesis import strategies as st
from simdrive_bench import (
    EMCY,
    HEARTBEAT,
    NODE_ID,
    PRE_OPERATIONAL,
    RPDO,
    SDO_REQUEST,
    SDO_RESPONSE,
    SYNC,
    TPDO,
    Bench,
)

LSS_RESPONSE = 0x7E4

OBJECTS = (
    0x1003, 0x1005, 0x1014, 0x1016, 0x1017, 0x1018, 0x1400, 0x1402, 0x1600, 0x1602,
    0x1800, 0x1803, 0x1A00, 0x1A03, 0x6007, 0x6040, 0x605A, 0x605E, 0x6060, 0x6071, 0x6072,
)  # fmt: skip

any_frame = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8))
own_frame = st.tuples(
    st.sampled_from((0, SYNC, SDO_REQUEST, 0x701, *RPDO.values())), st.binary(max_size=8)
)
nmt_command = st.tuples(
    st.just(0),
    st.builds(bytes, st.tuples(st.sampled_from((1, 2, 128, 129, 130)), st.just(NODE_ID))),
)
sdo_request = st.tuples(
    st.just(SDO_REQUEST),
    st.builds(
        struct.Struct("<BHBL").pack,
        st.sampled_from(
            (
                0x2F,
                0x2B,
                0x23,
                0x22,
                0x21,
                0x20,
                0x40,
                0x60,
                0x70,
                0x00,
                0x10,
                0x01,
                0xC6,
                0xC2,
                0xC1,
                0xA4,
                0xA3,
                0xA2,
                0xA1,
            )
        ),
        st.sampled_from(OBJECTS),
        st.integers(0, 9),
        st.one_of(
            st.integers(0, 2**32 - 1),
            st.integers(0, 300),
            st.sampled_from((0x205, 0x405, 0x80000205, 0x40000185, 0xC0000185, 0x00010064)),
            st.sampled_from((0x60400010, 0x60410010, 0x60640020, 0x60710010, 0x00050008)),
        ),
    ),
)
tick = st.floats(0.0, 1.0)
events = st.lists(st.one_of(any_frame, own_frame, nmt_command, sdo_request, tick), max_size=60)


@settings(max_examples=150, derandomize=True, deadline=None)
@given(events=events)
def test_drive_survives(events: list[tuple[int, bytes] | float]) -> None:
    bench = Bench()
    bench.tick()
    bench.nmt(1)
    for event in events:
        if isinstance(event, float):
            bench.tick(event)
        else:
            bench.give(*event)
    for can_id, data in bench.sent:
        assert 0 < can_id <= 0x7FF
        assert len(data) <= 8
    bench.nmt(PRE_OPERATIONAL)
    bench.give(SDO_REQUEST, bytes.fromhex("80 0000 00 00000405"))  # whatever was under way
    assert bench.read(0x1000) == 0x00020192


@settings(max_examples=60, derandomize=True, deadline=None)
@given(frames=st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=60))
def test_drive_sends_under_its_own_identifiers_only(frames: list[tuple[int, bytes]]) -> None:
    own = {EMCY, SDO_RESPONSE, LSS_RESPONSE, HEARTBEAT, *TPDO.values()}
    bench = Bench()
    bench.nmt(1)
    for can_id, data in frames:
        if can_id != SDO_REQUEST:  # nobody reconfigures it
            bench.give(can_id, data)
    assert {can_id for can_id, _ in bench.sent} <= own
