"""A real controller driver between master and drive: two controllers on one bus."""

import json
import os
import subprocess

import pytest
from commands import Record, same_signals
from conftest import Strikes
from socketcan import Bench, first_difference, ip

#: Set in the guest, whose controllers are emulated: a bench's own are not for tests.
CONTROLLERS = os.environ.get("CANWALL_CONTROLLERS", "").split()


@pytest.mark.skipif(
    len(CONTROLLERS) < 2, reason="emulated controllers: scripts/vcan-guest has them"
)
def test_strike_through_two_controllers(strikes: Strikes, bench: Bench) -> None:
    for name in CONTROLLERS:
        ip("link", "set", name, "type", "can", "bitrate", 1_000_000)
        ip("link", "set", name, "txqueuelen", 100)
        ip("link", "set", name, "up")
    shown = subprocess.run(
        ["ip", "-json", "-details", "link", "show", CONTROLLERS[0]], capture_output=True, check=True
    )
    (link,) = json.loads(shown.stdout)
    assert link["linkinfo"]["info_data"]["bittiming"]["bitrate"] == 1_000_000
    of_the_drive, of_the_master = (
        bench.config({'channel = "vcan0"': f'channel = "{name}"'}) for name in CONTROLLERS[:2]
    )
    bench.drive(of_the_drive)
    folder = bench.folder / "run"
    run = bench.canwall("run", of_the_master, "--duration", 0.9, "--output", folder)
    assert (run.wait(), run.errors) == (0, [])
    record = Record(folder)
    assert record.summary["missed_tpdo"] == 0
    assert first_difference(record.cycles[:890], strikes.record.cycles[:890]) is None
    assert same_signals(record, strikes.record, rows=890)
