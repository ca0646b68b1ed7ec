"""The main job with its drive behind SocketCAN, and what others may do on the bus meanwhile."""

from collections import Counter

from commands import Record, read_log
from conftest import Strikes
from main_job import DURATION_S
from other_nodes import EMCY, HEARTBEAT, TPDO, chatter
from rig import RPDO1, SDO_ANSWER, SDO_REQUEST, SYNC, TPDO1
from socketcan import assert_same_run, first_difference


def test_signals_are_those_of_the_embedded_bus(
    strikes: Strikes, embedded: Record, exchange: str
) -> None:
    assert strikes.record.summary["timing"]["exchange"] == exchange
    assert strikes.record.signals.num_rows > 1000 * DURATION_S
    assert_same_run(strikes.record, embedded)


def test_standard_chatters_and_mean_force_does_not(strikes: Strikes) -> None:
    found = strikes.record.summary["strikes"]
    assert [strike["law"] for strike in found] == ["mean_force", "standard"]
    assert [strike["chatter"] for strike in found] == [False, True]


def test_candump_has_the_record_frame_by_frame(strikes: Strikes) -> None:
    logged, recorded = read_log(strikes.candump), strikes.record.frames
    for can_id in (SYNC, TPDO1, RPDO1, 0x000):
        seen, own = (
            [bytes(frame.data) for frame in frames if frame.arbitration_id == can_id]
            for frames in (logged, recorded)
        )
        assert own, hex(can_id)
        assert first_difference(seen, own) is None, hex(can_id)
    # Somebody else's question may pass one of ours, or come once the run is over.
    asked, of_the_record = (
        Counter(bytes(frame.data) for frame in frames if frame.arbitration_id == SDO_REQUEST)
        for frames in (logged, recorded)
    )
    assert of_the_record <= asked
    theirs = [frame for frame in chatter(20) if frame.arbitration_id == SDO_REQUEST]
    assert set(asked - of_the_record) <= {bytes(frame.data) for frame in theirs}


def test_load_and_foreign_sdo_pass_by(strikes: Strikes) -> None:
    seen = Counter(frame.arbitration_id for frame in strikes.record.frames)
    assert seen[0x7A0] > 50
    assert min(seen[can_id] for can_id in (HEARTBEAT, EMCY, TPDO)) > 5
    vendor = [
        bytes(frame.data)
        for frame in strikes.record.frames
        if frame.arbitration_id == SDO_ANSWER and frame.data[1:4] == b"\x18\x10\x01"
    ]
    assert vendor, "the answer to cansend's question"


def test_second_master_is_refused_before_it_sends(strikes: Strikes) -> None:
    assert strikes.second_master.wait() == 1
    (line,) = strikes.second_master.errors
    assert line.startswith("canwall: another master is on vcan0: it sends ")
    assert line.endswith("; end it first")
    assert not strikes.folder_of_the_second.exists()
