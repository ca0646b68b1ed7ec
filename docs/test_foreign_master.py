"""A master that is a program of its own, and what the drive does without it."""

import subprocess
import sys

import pytest


@pytest.fixture
def master(simulated_drive):
    drive = simulated_drive
    command = [sys.executable, "foreign_master.py", drive.interface, drive.channel, drive.eds]
    with subprocess.Popen(command) as process:
        yield process
        process.kill()


def test_death_of_the_master_ends_the_torque(simulated_drive, master):
    drive = simulated_drive
    drive.wait_until(lambda: drive.torque > 0.03 and drive.velocity > 0.1, timeout_s=60.0)
    master.kill()
    drive.wait_until(lambda: drive.state == "FAULT", timeout_s=60.0)  # it brakes before
    assert drive.torque == 0.0
    assert drive.errors == (0x8130,)  # heartbeat
