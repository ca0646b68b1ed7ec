"""Effects of a SYNC and their order; torque, its limits and their bits in the statusword."""

import math
import struct

import pytest
from simdrive_bench import (
    CONTROLWORD,
    MODE,
    NOT_VALID,
    PERIOD_S,
    PRE_OPERATIONAL,
    RPDO,
    START,
    STOP,
    TARGET_TORQUE,
    Bench,
)

from canwall.config import Simulation
from canwall.simdrive.mechanics.actuator import Actuator
from canwall.simdrive.mechanics.motion import ServoMotion

RATED_NM = 0.637
ENABLED = 0x1237
LIMITED = 1 << 11


@pytest.fixture
def cyclic(bench: Bench) -> Bench:
    """Enabled, with RPDO3 and TPDO3 on every SYNC, and nothing written down yet."""
    bench.configure_cycle()
    bench.nmt(START)
    for controlword in (0x00, 0x06, 0x07, 0x0F):
        bench.command(controlword)
        bench.sync()
    bench.motion.calls.clear()
    return bench


def test_torque_takes_effect_with_the_next_sync(cyclic: Bench) -> None:
    cyclic.command(0x0F, 500)
    assert cyclic.read(0x6077) == 0
    assert cyclic.motion.calls == []
    start = cyclic.motion.position

    assert cyclic.cycle() == (ENABLED, start + 7, 500)
    assert cyclic.cycle() == (ENABLED, start + 14, 500)
    cyclic.command(0x0F, -250)
    assert cyclic.cycle() == (ENABLED, start + 21, -250)
    cyclic.cycle()

    torques = [call[1] for call in cyclic.motion.calls if call[0] == "advance"]
    assert torques == pytest.approx([0.0, 0.5 * RATED_NM, 0.5 * RATED_NM, -0.25 * RATED_NM])


def test_a_period_passes_before_its_end_is_sampled(cyclic: Bench) -> None:
    cyclic.command(0x0F, 1000)
    position = cyclic.motion.position
    cyclic.cycle()
    cyclic.cycle()
    assert cyclic.motion.calls == [
        ("advance", 0.0, PERIOD_S),
        ("counts", position + 7),
        ("advance", pytest.approx(RATED_NM), PERIOD_S),
        ("counts", position + 14),
    ]


def test_no_period_has_passed_at_the_first_sync(bench: Bench) -> None:
    bench.motion.calls.clear()
    bench.sync()
    assert bench.motion.calls == [("counts", bench.motion.position)]


def test_controlword_takes_effect_with_the_same_sync(cyclic: Bench) -> None:
    cyclic.command(0x0F, 500)
    cyclic.cycle()
    cyclic.command(0x07, 500)
    status, _, torque = cyclic.cycle()
    assert (status, torque) == (0x0233, 0)
    cyclic.command(0x0F, 400)
    status, _, torque = cyclic.cycle()
    assert (status, torque) == (ENABLED, 400)


def test_last_of_several_rpdos_counts(cyclic: Bench) -> None:
    for torque in (100, 200, 300):
        cyclic.command(0x0F, torque)
    assert cyclic.cycle()[2] == 300


def test_an_rpdo_takes_effect_once(cyclic: Bench) -> None:
    cyclic.command(0x0F, 500)
    cyclic.cycle()
    cyclic.write(0x6071, 0, 123, 2)
    assert cyclic.cycle()[2] == 123


def test_quick_stop_shows_for_one_cycle(cyclic: Bench) -> None:
    cyclic.command(0x0F, 500)
    cyclic.cycle()
    cyclic.command(0x02, 500)
    assert cyclic.cycle()[::2] == (0x0217, 0)
    assert cyclic.cycle()[::2] == (0x0250, 0)


@pytest.mark.parametrize(
    ("limits", "target", "actual"),
    [
        ({}, 3000, 3000),
        ({}, 3001, 3000),
        ({}, -32768, -3000),
        ({0x6072: 400}, 401, 400),
        ({0x6072: 400}, -500, -400),
        ({0x60E0: 300}, 350, 300),
        ({0x60E0: 300}, -350, -350),
        ({0x60E1: 200}, -350, -200),
        ({0x60E1: 200}, 350, 350),
        ({0x6072: 100, 0x60E0: 300, 0x60E1: 200}, -150, -100),
        ({0x6072: 0}, 1, 0),
    ],
)
def test_limits(cyclic: Bench, limits: dict[int, int], target: int, actual: int) -> None:
    for index, limit in limits.items():
        cyclic.write(index, 0, limit, 2)
    cyclic.command(0x0F, target)
    status, _, torque = cyclic.cycle()
    assert torque == actual
    assert status == (ENABLED if actual == target else ENABLED | LIMITED)
    cyclic.motion.calls.clear()
    cyclic.command(0x0F, 0)
    assert cyclic.cycle()[0] == ENABLED
    assert cyclic.motion.calls[0] == (
        "advance",
        pytest.approx(actual * RATED_NM / 1000),
        PERIOD_S,
    )


def test_no_torque_without_mode_or_in_halt(cyclic: Bench) -> None:
    cyclic.command(0x0F, 500)
    cyclic.write(0x6060, 0, 0, 1)
    assert cyclic.cycle()[::2] == (0x0237, 0)
    cyclic.write(0x6060, 0, 10, 1)
    assert cyclic.cycle()[::2] == (ENABLED, 500)
    cyclic.command(0x10F, 500)
    assert cyclic.cycle()[::2] == (0x0237, 0)


def test_torque_is_gone_at_once_when_disabled_between_syncs(cyclic: Bench) -> None:
    cyclic.command(0x0F, 4000)
    assert cyclic.cycle()[0] & LIMITED
    cyclic.write(0x6040, 0, 0, 2)
    assert cyclic.read(0x6077) == 0
    assert cyclic.read(0x6041) == 0x0250
    cyclic.motion.calls.clear()
    cyclic.sync()
    assert cyclic.motion.calls[0] == ("advance", 0.0, PERIOD_S)


@pytest.mark.parametrize("command", [PRE_OPERATIONAL, STOP])
def test_sync_moves_the_physics_without_pdos_outside_operational(
    cyclic: Bench, command: int
) -> None:
    cyclic.command(0x0F, 500)
    cyclic.cycle()
    cyclic.nmt(command)
    cyclic.motion.calls.clear()
    assert cyclic.sync() == []
    assert cyclic.motion.calls[0] == ("advance", 0.0, PERIOD_S)


def test_torque_goes_on_outside_operational_if_0x6007_says_so(cyclic: Bench) -> None:
    cyclic.write(0x6007, 0, 0, 2)
    cyclic.command(0x0F, 500)
    cyclic.cycle()
    cyclic.nmt(PRE_OPERATIONAL)
    cyclic.command(0x0F, 900)  # no RPDO in PRE-OPERATIONAL
    cyclic.motion.calls.clear()
    assert cyclic.sync() == []
    assert cyclic.motion.calls[0] == ("advance", pytest.approx(0.5 * RATED_NM), PERIOD_S)


def test_what_was_received_before_is_not_for_a_later_operational(cyclic: Bench) -> None:
    cyclic.write(0x6007, 0, 0, 2)
    cyclic.command(0x0F, 900)
    cyclic.nmt(PRE_OPERATIONAL)
    cyclic.nmt(START)
    assert cyclic.cycle()[2] == 0


@pytest.mark.parametrize("kind", [254, 255])
def test_asynchronous_rpdo_acts_on_reception(cyclic: Bench, kind: int) -> None:
    cyclic.configure_pdo(0x1402, RPDO[3], kind, [CONTROLWORD, TARGET_TORQUE])
    cyclic.motion.calls.clear()
    cyclic.command(0x0F, 700)
    assert cyclic.read(0x6071) == 700
    assert cyclic.read(0x6077) == 700
    assert cyclic.cycle()[2] == 700
    assert cyclic.motion.calls[0] == ("advance", pytest.approx(0.7 * RATED_NM), PERIOD_S)
    cyclic.command(0x07, 700)
    assert cyclic.read(0x6041) == 0x0233


def test_rpdo_value_that_would_be_refused_leaves_the_object(cyclic: Bench) -> None:
    cyclic.configure_pdo(0x1401, RPDO[2], 255, [MODE, CONTROLWORD])
    cyclic.give(RPDO[2], struct.pack("<bH", 3, 0x07))
    assert cyclic.read(0x6061) == 10
    assert cyclic.read(0x6041) == 0x0233  # the rest of the PDO counts


def test_sync_under_another_identifier(cyclic: Bench) -> None:
    cyclic.write(0x1005, 0, 0x1F1, 4)
    cyclic.motion.calls.clear()
    assert cyclic.sync() == []
    assert cyclic.motion.calls == []
    assert len(cyclic.give(0x1F1, b"\x01")) == 1


def test_position_wraps_to_32_bits_and_velocity_saturates(cyclic: Bench) -> None:
    cyclic.motion.position = 2**31 + 5
    cyclic.motion.speed = -1e12
    assert cyclic.cycle()[1] == -(2**31) + 12
    assert cyclic.read(0x6064, signed=True) == -(2**31) + 12
    assert cyclic.read(0x606C, signed=True) == -(2**31)
    cyclic.motion.speed = -12.6
    cyclic.sync()
    assert cyclic.read(0x606C, signed=True) == -13


def test_sdo_shows_the_last_sample(cyclic: Bench) -> None:
    _, position, _ = cyclic.cycle()
    assert cyclic.read(0x6064) == position
    assert cyclic.motion.position == position


def test_position_is_there_before_the_first_sync(bench: Bench) -> None:
    assert bench.read(0x6064) == bench.motion.position


def test_configured_cycle_has_nothing_else_on_the_bus(cyclic: Bench) -> None:
    assert cyclic.read(0x1801, 1) & NOT_VALID
    cyclic.command(0x0F, 10)
    assert [can_id for can_id, _ in cyclic.sync()] == [0x385]


def test_actual_torque_is_what_the_current_loop_delivers() -> None:
    """0x6074 shows the demand at once, 0x6077 what of it has come by each SYNC."""
    bandwidth = 40.0
    simulation = Simulation(current_bandwidth_hz=bandwidth, torque_step_nm=0.0, drive_cycle_s=0.0)
    motion = ServoMotion(simulation, PERIOD_S, 131072.0)
    actuator = Actuator(motion, PERIOD_S, 0.0)
    assert not actuator.direct
    for j in range(1, 20):
        actuator.advance(0.3, 1.0)
        arrived = 0.3 * (1.0 - math.exp(-2.0 * math.pi * bandwidth * j * PERIOD_S))
        assert actuator.torque_nm(0.3) == pytest.approx(arrived, rel=1e-12)
