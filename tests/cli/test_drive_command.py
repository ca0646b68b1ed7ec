"""`canwall drive`: faults are told of, and time is real where it is asked for."""

import signal
from pathlib import Path

import can
import pytest
from commands import COMMAND, PATIENCE_S, Start, config_file

from canwall import config

UNIXCAN_CONFIG = config.shipped("config/unixcan.toml")


@pytest.fixture
def channel(tmp_path: Path) -> Path:
    return tmp_path / "can.sock"


def drive_file(tmp_path: Path, channel: Path, fault: str) -> Path:
    changes = {'channel = "/tmp/canwall.sock"': f'channel = "{channel}"'}
    path = config_file(tmp_path / "drive.toml", changes, UNIXCAN_CONFIG)
    path.write_text(f"{path.read_text()}\n[[simulation.fault]]\n{fault}\n")
    return path


@pytest.mark.slow
def test_real_time_needs_no_sync(start: Start, tmp_path: Path, channel: Path) -> None:
    fault = 'kind = "silence"\nat_s = 0.05\nduration_s = 0.05'
    drive = start(COMMAND, "drive", drive_file(tmp_path, channel, fault), "--real-time")
    assert drive.stdout is not None
    assert drive.stdout.readline().startswith("simulated drive, node 5")
    assert drive.stdout.readline().endswith("s: silence begins\n")
    assert drive.stdout.readline().endswith("s: silence ends\n")
    drive.send_signal(signal.SIGINT)
    assert drive.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_syncs_count_where_time_is_theirs(start: Start, tmp_path: Path, channel: Path) -> None:
    fault = 'kind = "bus_off"\nat_sync = 2\nduration_syncs = 1'
    drive = start(COMMAND, "drive", drive_file(tmp_path, channel, fault))
    assert drive.stdout is not None
    assert drive.stdout.readline().startswith("simulated drive, node 5")
    with can.Bus(interface="unixcan", channel=str(channel)) as master:
        for _ in range(4):
            master.send(can.Message(arbitration_id=0x080, is_extended_id=False))
        seen = master.recv(PATIENCE_S)
        while seen is not None and not seen.is_error_frame:
            seen = master.recv(PATIENCE_S)
        assert seen is not None
        assert seen.arbitration_id == 0x40  # CAN_ERR_BUSOFF
        assert drive.stdout.readline() == "SYNC 2: bus_off begins\n"
        assert drive.stdout.readline() == "SYNC 3: bus_off ends\n"
    drive.send_signal(signal.SIGTERM)
    assert drive.wait(PATIENCE_S) == 0
