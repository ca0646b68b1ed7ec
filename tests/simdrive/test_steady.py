"""Steady operation: the drive answers from compiled code as it does service by service."""

import random
import struct
from typing import Any

import pytest
from simdrive_bench import (
    CONTROLWORD,
    EDS,
    EMCY,
    NODE_ID,
    PERIOD_S,
    RPDO,
    SDO_REQUEST,
    SYNC,
    TARGET_TORQUE,
    TPDO,
    Bench,
)

from canwall.config import Drive, Fault, Hand, Simulation
from canwall.simdrive import FaultyDrive, Frame, make_drive

STEPS = 6000
#: A fault that never comes: the drive takes every frame service by service.
NEVER = Fault(kind="lost", at_s=1e6)
SDO_READS = (0x6041, 0x6064, 0x606C, 0x6071, 0x6074, 0x6077, 0x6078)


class MadeBench(Bench):
    """A master's hands on a drive as the configuration describes it."""

    def __init__(self, simulation: Simulation) -> None:
        self.drive: Any = make_drive(Drive(node_id=NODE_ID, eds=EDS), simulation, PERIOD_S)
        self.sent = self.drive.boot()

    @property
    def steady(self) -> bool:
        return bool(self.drive.drive.state.fields.steady)


def enabled(simulation: Simulation) -> MadeBench:
    bench = MadeBench(simulation)
    bench.configure_cycle()
    bench.enable()
    return bench


def frames_of(drive: FaultyDrive, action: str, draw: random.Random) -> list[Frame]:
    match action:
        case "sync":
            return drive.process(SYNC, b"")
        case "torque":
            return drive.process(RPDO[3], struct.pack("<Hh", 0x0F, draw.randint(-2500, 2500)))
        case "rated torque":
            data = struct.pack("<Hh", 0x0F, draw.randint(-900, 900))
            return drive.process(RPDO[3], data)
        case "controlword":
            return drive.process(RPDO[3], struct.pack("<Hh", draw.choice((6, 7, 15, 0x10F)), 500))
        case "recover":
            return [
                frame
                for word in (0x80, 0x06, 0x07, 0x0F)
                for can_id, data in ((RPDO[3], struct.pack("<Hh", word, 0)), (SYNC, b""))
                for frame in drive.process(can_id, data)
            ]
        case "tick":
            return drive.tick(draw.choice((0.0004, 0.001, 0.0035)))
        case "read":
            request = struct.pack("<BHB4x", 0x40, draw.choice(SDO_READS), 0)
            return drive.process(SDO_REQUEST, request)
        case "write":
            index, value = draw.choice(((0x6072, 700), (0x6072, 3000), (0x6071, 40), (0x60E0, 800)))
            return drive.process(SDO_REQUEST, struct.pack("<BHBhxx", 0x2B, index, 0, value))
        case "long":
            return drive.process(RPDO[3], struct.pack("<Hhx", 0x0F, draw.randint(-900, 900)))
        case "short":
            return drive.process(RPDO[3], b"\x0f")
        case "counted":
            return drive.process(SYNC, b"\x01")
        case "foreign":
            return drive.process(draw.randint(0x182, 0x57F) | 1, draw.randbytes(4))
    raise AssertionError(action)


ACTIONS = {
    "sync": 400,
    "rated torque": 300,
    "torque": 40,
    "tick": 200,
    "read": 20,
    "write": 4,
    "controlword": 3,
    "recover": 12,
    "short": 1,
    "long": 1,
    "counted": 1,
    "foreign": 10,
}


@pytest.mark.parametrize(
    "simulation",
    [
        {},
        {"overload_s": 0.02, "velocity_filter_hz": 80.0},
        {"current_bandwidth_hz": 400.0, "torque_step_nm": 0.002},
        {"drive_cycle_s": 0.0004, "clock_ppm": 100.0, "current_bandwidth_hz": 1600.0},
        {"hand": Hand(grip=False, strikes=5)},
        {"objects": {"0x607E": 0xE0}},
    ],
    ids=lambda changes: ", ".join(changes) or "plain",
)
def test_frames_are_those_of_the_services(simulation: dict[str, Any]) -> None:
    ours = enabled(Simulation(**simulation))
    theirs = enabled(Simulation(**simulation, fault=(NEVER,)))
    for bench in (ours, theirs):
        bench.write(0x1006, 0, 5000, 4)
        bench.write(0x1007, 0, 4000, 4)
        bench.write(0x1402, 5, 20, 2)
        bench.write(0x1017, 0, 10, 2)
        bench.sync()
    draws = [random.Random(7), random.Random(7)]
    choose = random.Random(8)
    steady = 0
    for action in choose.choices(list(ACTIONS), list(ACTIONS.values()), k=STEPS):
        steady += ours.steady
        assert not theirs.steady
        ours_sent, theirs_sent = (
            frames_of(bench.drive, action, draw)
            for bench, draw in zip((ours, theirs), draws, strict=True)
        )
        assert ours_sent == theirs_sent, action
    assert steady > STEPS / 3


def test_sync_that_has_to_carry_its_counter_is_for_the_services() -> None:
    bench = MadeBench(Simulation())
    bench.configure_cycle()
    bench.write(0x1019, 0, 10, 1)
    bench.enable()
    for counter in (1, 2, 3):
        ((can_id, _),) = bench.give(SYNC, bytes([counter]))
        assert can_id == TPDO[3]
    assert not bench.steady
    assert [can_id for can_id, _ in bench.sync()] == [EMCY]


def test_of_a_torque_that_is_mapped_twice_the_last_counts() -> None:
    bench = enabled(Simulation(ideal=True).with_ideal_servo())
    bench.configure_pdo(0x1402, RPDO[3], 1, [CONTROLWORD, TARGET_TORQUE, TARGET_TORQUE])
    bench.sync()
    for torque in (100, 200):
        bench.give(RPDO[3], struct.pack("<Hhh", 0x0F, 700, torque))
        assert bench.steady
        assert bench.cycle()[2] == torque


def test_fault_from_outside_ends_it() -> None:
    bench = enabled(Simulation())
    bench.sync()
    bench.cycle()
    assert bench.steady
    bench.drive.drive.axis.sto(True)
    assert not bench.steady
