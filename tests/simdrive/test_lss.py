"""The LSS slave (CiA 305), frame by frame."""

import struct
from pathlib import Path

import pytest
from simdrive_bench import EDS, HEARTBEAT, NODE_ID, RESET_COMMUNICATION, RESET_NODE, STOP, Bench

from canwall.config import Drive as DriveSettings
from canwall.config import Simulation
from canwall.simdrive import make_drive

REQUEST, RESPONSE = 0x7E5, 0x7E4
IDENTITY = (0, 1, 0x00010000, 1)
CONFIGURATION, WAITING = 1, 0


def frame(command: int, number: int = 0) -> bytes:
    return struct.pack("<BL3x", command, number)


def ask(bench: Bench, command: int, number: int = 0) -> list[bytes]:
    frames = bench.give(REQUEST, frame(command, number))
    assert {can_id for can_id, _ in frames} <= {RESPONSE}
    return [data for _, data in frames]


@pytest.fixture
def configuring(bench: Bench) -> Bench:
    assert ask(bench, 0x04, CONFIGURATION) == []
    return bench


def test_waiting_slave_answers_nothing(configuring: Bench) -> None:
    assert ask(configuring, 0x04, WAITING) == []
    for command in (0x11, 0x13, 0x17, 0x5A, 0x5E):
        assert ask(configuring, command, 9) == []
    configuring.nmt(RESET_NODE)
    assert configuring.read(0x1200, 1) == 0x605


def test_identity(configuring: Bench) -> None:
    for command, number in zip(range(0x5A, 0x5E), IDENTITY, strict=True):
        assert ask(configuring, command) == [frame(command, number)]
    assert ask(configuring, 0x5E) == [frame(0x5E, NODE_ID)]


@pytest.mark.parametrize("wrong", [None, 0, 1, 2, 3])
def test_switch_selective(bench: Bench, wrong: int | None) -> None:
    numbers = [number + (place == wrong) for place, number in enumerate(IDENTITY)]
    answers = [ask(bench, 0x40 + place, number) for place, number in enumerate(numbers)]
    assert answers == [[], [], [], [frame(0x44)] if wrong is None else []]
    assert len(ask(bench, 0x5E)) == (wrong is None)


@pytest.mark.parametrize("reset", [RESET_NODE, RESET_COMMUNICATION])
def test_new_node_id_holds_from_the_next_reset_on(configuring: Bench, reset: int) -> None:
    assert ask(configuring, 0x11, 9) == [frame(0x11, 0)]
    assert configuring.read(0x1200, 1) == 0x605
    assert configuring.nmt(reset) == [(0x709, b"\x00")]
    assert configuring.nmt(RESET_NODE, NODE_ID) == []
    read = bytes.fromhex("40 0012 01 00000000")
    assert configuring.give(HEARTBEAT - 0x100, read) == []
    assert configuring.give(0x609, read) == [(0x589, bytes.fromhex("43 0012 01 09060000"))]


@pytest.mark.parametrize("node_id", [0, 128, 255])
def test_node_id_that_is_none(configuring: Bench, node_id: int) -> None:
    assert ask(configuring, 0x11, node_id) == [frame(0x11, 1)]
    assert ask(configuring, 0x5E) == [frame(0x5E, NODE_ID)]


def test_short_frames_are_ignored_and_stopped_is_served(configuring: Bench) -> None:
    assert configuring.give(REQUEST, b"\x5e") == []
    configuring.nmt(STOP)
    assert ask(configuring, 0x5E) == [frame(0x5E, NODE_ID)]


def test_stored_node_id_survives_a_restart(tmp_path: Path) -> None:
    simulation = Simulation(store=tmp_path / "stored.json")
    settings = DriveSettings(node_id=NODE_ID, eds=EDS)
    drive = make_drive(settings, simulation, 0.001)
    assert drive.boot() == [(0x705, b"\x00")]
    for request in (frame(0x04, 1), frame(0x11, 9)):
        drive.process(REQUEST, request)
    assert make_drive(settings, simulation, 0.001).boot() == [(0x705, b"\x00")]
    assert drive.process(REQUEST, frame(0x17)) == [(RESPONSE, frame(0x17, 0))]
    assert make_drive(settings, simulation, 0.001).boot() == [(0x709, b"\x00")]


def test_store_that_cannot_be_written(tmp_path: Path) -> None:
    bench = Bench(store=tmp_path / "none" / "stored.json")
    ask(bench, 0x04, CONFIGURATION)
    assert ask(bench, 0x17) == [frame(0x17, 2)]
