"""`canwall drive`: faults are told of, and time is real where it is asked for."""

import contextlib
import json
import os
import re
import signal
import subprocess
from pathlib import Path

import can
import pytest
from commands import COMMAND, PATIENCE_S, Start, command, config_file
from fork_server import ForkedPopen

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


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_doctor_that_is_stopped_puts_the_drive_back(
    start: Start, tmp_path: Path, channel: Path, number: signal.Signals
) -> None:
    bench = drive_file(tmp_path, channel, 'kind = "silence"\nat_s = 999.0\nduration_s = 0.1')
    drive = start(COMMAND, "drive", bench, "--real-time")
    assert drive.stdout is not None
    assert drive.stdout.readline().startswith("simulated drive, node 5")
    doctor = start(COMMAND, "doctor", bench)
    assert doctor.stderr is not None
    for line in doctor.stderr:
        if "enabling the drive with zero torque" in line:
            break
    doctor.send_signal(number)
    said, errors = doctor.communicate(timeout=PATIENCE_S)
    assert doctor.returncode == 130
    assert "changes: all undone" in said
    assert errors.splitlines()[-1] == "canwall: interrupted"


@pytest.mark.slow
def test_tells_that_it_is_ready(tmp_path: Path, channel: Path) -> None:
    fault = 'kind = "silence"\nat_sync = 0\nduration_syncs = 1'
    ours, its = os.pipe()
    words = [COMMAND, "drive", str(drive_file(tmp_path, channel, fault)), "--json"]
    with contextlib.ExitStack() as stack:
        ready = stack.enter_context(os.fdopen(ours))
        drive = ForkedPopen[str](
            [*words, "--ready-fd", str(its)], stdout=subprocess.PIPE, text=True, pass_fds=[its]
        )
        stack.enter_context(drive)
        stack.callback(drive.kill)
        os.close(its)
        assert ready.read() == "ready\n"  # to its end: the drive has closed it
        assert drive.stdout is not None
        assert json.loads(drive.stdout.readline()) == {
            "event": "ready",
            "node_id": 5,
            "interface": "unixcan",
            "channel": str(channel),
            "eds": str(config.shipped("eds/canwall-drive.eds")),
        }
        master = stack.enter_context(can.Bus(interface="unixcan", channel=str(channel)))
        master.send(can.Message(arbitration_id=0x080, is_extended_id=False))
        told = json.loads(drive.stdout.readline())
        assert told == {"event": "report", "text": "SYNC 0: silence begins"}
        drive.send_signal(signal.SIGINT)
        assert drive.wait(PATIENCE_S) == 0


@pytest.mark.slow
@pytest.mark.parametrize("descriptor", ["77", "-1"])
def test_descriptor_that_is_not_open(tmp_path: Path, channel: Path, descriptor: str) -> None:
    done = command("drive", drive_file(tmp_path, channel, 'kind = "sto"'), "--ready-fd", descriptor)
    assert done.returncode == 2
    assert re.fullmatch(rf"canwall: --ready-fd {descriptor}: .*\n", done.stderr)
