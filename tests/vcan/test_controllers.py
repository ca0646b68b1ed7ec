"""A real controller driver between master and drive: two controllers on one bus."""

import json
import os
import subprocess
from collections.abc import Iterator

import pytest
from commands import Record
from pages import DOCS, blocks
from socketcan import Bench, assert_same_run, ip, tc

#: Set in the guest, whose controllers are emulated: a bench's own are not for tests.
CONTROLLERS = os.environ.get("CANWALL_CONTROLLERS", "").split()

pytestmark = pytest.mark.skipif(
    len(CONTROLLERS) < 2, reason="emulated controllers: scripts/vcan-guest --controllers has them"
)


def test_adapter_is_brought_up_as_the_guide_says() -> None:
    channel = CONTROLLERS[0]
    guide = DOCS / "bench" / "adapter.md"
    first = next(block for block in blocks(guide) if block.remark == "root")
    try:
        for line in first.text.splitlines():
            done = subprocess.run(
                line.replace("can0", channel).split(), capture_output=True, text=True, check=False
            )
            assert (done.returncode, done.stderr) == (0, ""), line
        shown = subprocess.run(
            ["ip", "-json", "-details", "link", "show", channel], capture_output=True, check=True
        )
        (link,) = json.loads(shown.stdout)
        can = link["linkinfo"]["info_data"]
        assert (can["bittiming"]["bitrate"], can["restart_ms"]) == (1_000_000, 100)
        assert (link["txqlen"], "UP" in link["flags"]) == (128, True)
    finally:
        ip("link", "set", channel, "down")


@pytest.fixture(scope="module")
def controllers() -> Iterator[tuple[str, str]]:
    """The drive's and the master's, up at 1 Mbit/s."""
    for name in CONTROLLERS:
        ip("link", "set", name, "type", "can", "bitrate", 1_000_000)
        ip("link", "set", name, "up")
    yield CONTROLLERS[0], CONTROLLERS[1]
    for name in CONTROLLERS:
        ip("link", "set", name, "down")


def _strike(bench: Bench, controllers: tuple[str, str], duration_s: float) -> Record:
    of_the_drive, of_the_master = (
        bench.config({'channel = "vcan0"': f'channel = "{name}"\npace = "simulated"'})
        for name in controllers
    )
    bench.drive(of_the_drive)
    folder = bench.folder / "run"
    run = bench.canwall("run", of_the_master, "--duration", duration_s, "--output", folder)
    assert (run.wait(), run.errors) == (0, [])
    return Record(folder)


def test_strike_through_two_controllers(
    controllers: tuple[str, str],
    embedded: Record,
    bench: Bench,
) -> None:
    for name in controllers:
        shown = subprocess.run(
            ["ip", "-json", "-details", "link", "show", name], capture_output=True, check=True
        )
        (link,) = json.loads(shown.stdout)
        assert link["linkinfo"]["info_data"]["bittiming"]["bitrate"] == 1_000_000
        assert "UP" in link["flags"]
    record = _strike(bench, controllers, 0.4)
    assert record.summary["missed_tpdo"] == 0
    assert record.column("torque_cmd_per_mille").any()
    assert_same_run(record, embedded, cycles=390)


def test_transmit_queue_that_is_full_for_a_moment(
    controllers: tuple[str, str],
    embedded: Record,
    bench: Bench,
) -> None:
    """Each SYNC comes upon the RPDO before it, which leaves after 30 ms: it is waited for."""
    tc("qdisc", "add", "dev", controllers[1], "root", "netem", "delay", "30ms", "limit", "1")
    try:
        record = _strike(bench, controllers, 0.3)
        queue = subprocess.run(
            ["tc", "-json", "-statistics", "qdisc", "show", "dev", controllers[1]],
            capture_output=True,
            check=True,
        )
    finally:
        tc("qdisc", "del", "dev", controllers[1], "root")
    assert json.loads(queue.stdout)[0]["drops"] > 100, "the queue has been full"
    assert record.column("torque_cmd_per_mille").any()
    assert record.summary["missed_tpdo"] == 0
    assert_same_run(record, embedded, cycles=290)
