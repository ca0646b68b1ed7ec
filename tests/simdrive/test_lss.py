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


@pytest.fixture
def unconfigured(configuring: Bench) -> Bench:
    """Whoever has been told to have no node-ID, and reset."""
    assert ask(configuring, 0x11, 255) == [frame(0x11, 0)]
    assert configuring.nmt(RESET_NODE) == []
    return configuring


def test_waiting_slave_answers_nothing(configuring: Bench) -> None:
    assert ask(configuring, 0x04, WAITING) == []
    for command in (0x11, 0x13, 0x15, 0x17, 0x4C, 0x51, 0x5A, 0x5E):
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


def test_configuring_slave_is_not_selected_again(configuring: Bench) -> None:
    assert [ask(configuring, 0x40 + n, IDENTITY[n]) for n in range(4)] == [[]] * 4
    assert ask(configuring, 0x04, 7) == []  # no such state
    assert ask(configuring, 0x5E) == [frame(0x5E, NODE_ID)]


@pytest.mark.parametrize("state", [WAITING, CONFIGURATION])
@pytest.mark.parametrize(
    ("bounds", "found"),
    [
        ((0, 1, 0x10000, 0x10000, 1, 1), True),
        ((0, 1, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF), True),
        ((1, 1, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF), False),
        ((0, 0, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF), False),
        ((0, 1, 0x10001, 0xFFFFFFFF, 0, 0xFFFFFFFF), False),
        ((0, 1, 0, 0xFFFF, 0, 0xFFFFFFFF), False),
        ((0, 1, 0, 0xFFFFFFFF, 2, 0xFFFFFFFF), False),
        ((0, 1, 0, 0xFFFFFFFF, 0, 0), False),
    ],
)
def test_identify(bench: Bench, state: int, bounds: tuple[int, ...], found: bool) -> None:
    ask(bench, 0x04, state)
    answers = [ask(bench, 0x46 + n, bound) for n, bound in enumerate(bounds)]
    assert answers == [[]] * 5 + [[frame(0x4F)] if found else []]


def test_identify_in_another_order(bench: Bench) -> None:
    for n in (0, 1, 3, 2, 4, 5):
        assert ask(bench, 0x46 + n, (0, 1, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF)[n]) == []
    assert ask(bench, 0x4C) == []  # it has a node-ID


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 10_000, 83_333])
def test_bit_timing_is_that_of_the_bus(bitrate: int) -> None:
    settings = DriveSettings(node_id=NODE_ID, eds=EDS)
    drive = make_drive(settings, Simulation(), 0.001, bitrate)
    drive.boot()
    drive.process(REQUEST, frame(0x04, CONFIGURATION))
    accepted = [
        (table, index)
        for table in (0, 1)
        for index in range(12)
        if drive.process(REQUEST, frame(0x13, table | index << 8)) == [(RESPONSE, frame(0x13))]
    ]
    assert accepted == {1_000_000: [(0, 0)], 500_000: [(0, 2)], 10_000: [(0, 8)]}.get(bitrate, [])


def test_nothing_is_sent_while_the_bit_timing_changes(configuring: Bench) -> None:
    configuring.write(0x1017, 0, 10, 2)
    configuring.give(REQUEST, struct.pack("<BH5x", 0x15, 50))
    assert [configuring.tick(0.01) for _ in range(9)] == [[]] * 9
    assert ask(configuring, 0x5E) == []
    assert configuring.tick(0.01) == [(HEARTBEAT, b"\x7f")]
    assert ask(configuring, 0x5E) == [frame(0x5E, NODE_ID)]


def test_without_a_node_id_there_is_lss_alone(unconfigured: Bench) -> None:
    unconfigured.sent.clear()
    for command in (1, 2, 128, 129, 130):
        unconfigured.nmt(command, 0)
        unconfigured.nmt(command, 255)
    for can_id in (0x605, 0x6FF, 0x205):
        unconfigured.give(can_id, bytes.fromhex("40 0010 00 00000000"))
    for can_id in (HEARTBEAT, 0x7FF, 0x185):
        unconfigured.request(can_id)
    unconfigured.tick(10.0)
    assert ask(unconfigured, 0x5E) == []
    assert unconfigured.sent == []
    assert ask(unconfigured, 0x4C) == [frame(0x50)]
    position = unconfigured.motion.position
    assert unconfigured.sync() == []
    assert unconfigured.sync() == []
    assert unconfigured.motion.position != position  # the world goes on


def test_node_without_an_id_starts_when_it_is_given_one(unconfigured: Bench) -> None:
    ask(unconfigured, 0x04, CONFIGURATION)
    assert ask(unconfigured, 0x5E) == [frame(0x5E, 255)]
    assert ask(unconfigured, 0x11, 9) == [frame(0x11)]
    assert ask(unconfigured, 0x5E) == [frame(0x5E, 9)]
    assert ask(unconfigured, 0x4C) == []
    assert ask(unconfigured, 0x04, CONFIGURATION) == []
    assert unconfigured.give(REQUEST, frame(0x04, WAITING)) == [(0x709, b"\0")]
    assert len(unconfigured.give(0x609, bytes.fromhex("40 0010 00 00000000"))) == 1


def scan(bench: Bench, number: int, bit: int, place: int, following: int) -> bool:
    answers = bench.give(REQUEST, struct.pack("<BLBBB", 0x51, number, bit, place, following))
    assert answers in ([], [(RESPONSE, frame(0x4F))])
    return bool(answers)


def test_fast_scan(unconfigured: Bench) -> None:
    assert scan(unconfigured, 0, 0x80, 0, 0)
    for place, wanted in enumerate(IDENTITY):
        number = 0
        for bit in reversed(range(32)):
            if not scan(unconfigured, number, bit, place, place):
                number |= 1 << bit
        assert number == wanted
        assert ask(unconfigured, 0x5E) == []
        assert scan(unconfigured, number, 0, place, (place + 1) % 4)
    assert ask(unconfigured, 0x5E) == [frame(0x5E, 255)]  # it is selected
    assert not scan(unconfigured, 0, 0x80, 0, 0)


@pytest.mark.parametrize(
    ("number", "bit", "place", "following"),
    [(0, 32, 0, 0), (0, 0x7F, 0, 0), (0, 0, 4, 0), (0, 0, 0, 4), (1, 0, 1, 2), (1, 0, 0, 1)],
)
def test_scan_that_finds_nobody(
    unconfigured: Bench, number: int, bit: int, place: int, following: int
) -> None:
    assert scan(unconfigured, 0, 0x80, 0, 0)
    assert not scan(unconfigured, number, bit, place, following)
    assert scan(unconfigured, 0, 0, 0, 1)  # the scan stands where it stood


def test_who_has_a_node_id_is_not_scanned(bench: Bench, configuring: Bench) -> None:
    assert not scan(bench, 0, 0x80, 0, 0)
    ask(configuring, 0x11, 255)
    ask(configuring, 0x04, WAITING)
    assert not scan(configuring, 0, 0x80, 0, 0)  # it has one up to the reset


@pytest.mark.parametrize("reset", [RESET_NODE, RESET_COMMUNICATION])
def test_new_node_id_holds_from_the_next_reset_on(configuring: Bench, reset: int) -> None:
    assert ask(configuring, 0x11, 9) == [frame(0x11, 0)]
    assert configuring.read(0x1200, 1) == 0x605
    assert configuring.nmt(reset) == [(0x709, b"\x00")]
    assert configuring.nmt(RESET_NODE, NODE_ID) == []
    read = bytes.fromhex("40 0012 01 00000000")
    assert configuring.give(HEARTBEAT - 0x100, read) == []
    assert configuring.give(0x609, read) == [(0x589, bytes.fromhex("43 0012 01 09060000"))]


def test_power_off_takes_what_is_not_stored(configuring: Bench) -> None:
    ask(configuring, 0x11, 9)
    configuring.drive.switch_off()
    assert configuring.drive.boot() == [(HEARTBEAT, b"\0")]
    assert ask(configuring, 0x5E) == []  # in WAITING
    ask(configuring, 0x04, CONFIGURATION)
    ask(configuring, 0x11, 9)
    assert configuring.nmt(RESET_NODE) == [(0x709, b"\0")]
    assert configuring.drive.boot() == [(HEARTBEAT, b"\0")]
    ask(configuring, 0x04, CONFIGURATION)
    ask(configuring, 0x11, 9)
    assert ask(configuring, 0x17) == [frame(0x17)]
    assert configuring.drive.boot() == [(0x709, b"\0")]


def test_objects_of_the_simulation_stay_with_another_node_id() -> None:
    simulation = Simulation(objects={"0x6072": 750})
    drive = make_drive(DriveSettings(node_id=NODE_ID, eds=EDS), simulation, 0.001)
    drive.boot()
    for request in (frame(0x04, 1), frame(0x11, 9)):
        drive.process(REQUEST, request)
    assert drive.process(0x000, bytes([RESET_NODE, NODE_ID])) == [(0x709, b"\0")]
    assert drive.drive.dictionary[0x6072, 0].value == 750


@pytest.mark.parametrize("node_id", [0, 128, 254])
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


def test_having_no_node_id_is_stored(tmp_path: Path) -> None:
    simulation = Simulation(store=tmp_path / "stored.json")
    settings = DriveSettings(node_id=NODE_ID, eds=EDS)
    drive = make_drive(settings, simulation, 0.001)
    drive.boot()
    for request in (frame(0x04, 1), frame(0x11, 255), frame(0x17)):
        drive.process(REQUEST, request)
    after = make_drive(settings, simulation, 0.001)
    assert after.boot() == []
    assert after.process(REQUEST, frame(0x4C)) == [(RESPONSE, frame(0x50))]
    assert after.process(REQUEST, frame(0x04, 1)) == []
    after.process(REQUEST, frame(0x11, NODE_ID))
    assert after.process(REQUEST, frame(0x04, 0)) == [(HEARTBEAT, b"\0")]
    assert make_drive(settings, simulation, 0.001).boot() == []  # it was not stored


def test_store_that_cannot_be_written(tmp_path: Path) -> None:
    bench = Bench(store=tmp_path / "none" / "stored.json")
    ask(bench, 0x04, CONFIGURATION)
    assert ask(bench, 0x17) == [frame(0x17, 2)]
