"""A wall beside other nodes on the bus: they do not disturb it."""

from collections import Counter
from pathlib import Path

import can
import other_nodes
import pytest
from commands import Record, same_signals
from other_nodes import OtherNodes
from rig import settings_with

from canwall.run import run as run_wall


@pytest.mark.slow
def test_signals_are_those_of_a_wall_alone(tmp_path: Path) -> None:
    settings = settings_with(
        {"bus.exchange": "python-can", "bus.channel": tmp_path.name, "run.duration_s": 1.0}
    )
    alone = run_wall(settings, tmp_path / "alone")
    with (
        can.Bus(interface="virtual", channel=tmp_path.name) as bus,
        OtherNodes(bus),
    ):
        beside = run_wall(settings, tmp_path / "beside")
    assert beside.outcome.trips == alone.outcome.trips == []
    assert beside.remarks == alone.remarks
    assert beside.summary["missed_tpdo"] == 0
    assert same_signals(Record(tmp_path / "beside"), Record(tmp_path / "alone"))
    seen = Counter(frame.arbitration_id for frame in Record(tmp_path / "beside").frames)
    for can_id in (other_nodes.HEARTBEAT, other_nodes.EMCY, other_nodes.TPDO, 0x585):
        assert seen[can_id] > 10, hex(can_id)
