"""Profile torque mode (CiA 402-2): the torque goes to its target along the slope 0x6087."""

import pytest
from simdrive_bench import Bench

OPERATION_ENABLED = 0x0237
TARGET_REACHED = 1 << 10
LIMITED = 1 << 11
HALT = 1 << 8


@pytest.fixture
def ramping(bench: Bench) -> Bench:
    """Enabled in mode 4 with 10 per mille in each period."""
    bench.configure_cycle()
    bench.enable()
    bench.write(0x6060, 0, 4, 1)
    bench.write(0x6087, 0, 10_000, 4)
    return bench


def test_torque_follows_the_slope_to_its_target(ramping: Bench) -> None:
    ramping.command(0x0F, 35)
    cycles = [ramping.cycle() for _ in range(5)]
    assert [torque for _, _, torque in cycles] == [10, 20, 30, 35, 35]
    reached = [status & TARGET_REACHED for status, _, _ in cycles]
    assert reached == [0, 0, 0, TARGET_REACHED, TARGET_REACHED]
    assert cycles[0][0] == OPERATION_ENABLED
    assert ramping.read(0x6074) == 35
    assert ramping.read(0x6061) == 4
    ramping.command(0x0F, -5)
    assert [ramping.cycle()[2] for _ in range(5)] == [25, 15, 5, -5, -5]


def test_slope_below_one_per_mille_a_period(ramping: Bench) -> None:
    ramping.write(0x6087, 0, 400, 4)
    ramping.command(0x0F, 10)
    assert [ramping.cycle()[2] for _ in range(5)] == [0, 1, 1, 2, 2]


def test_halt_takes_the_torque_back_along_the_slope(ramping: Bench) -> None:
    ramping.command(0x0F, 20)
    ramping.cycle()
    ramping.cycle()
    ramping.command(0x0F | HALT, 20)
    assert [ramping.cycle()[2] for _ in range(3)] == [10, 0, 0]
    ramping.command(0x0F, 20)
    assert ramping.cycle()[2] == 10


def test_limit(ramping: Bench) -> None:
    ramping.write(0x6072, 0, 15, 2)
    ramping.command(0x0F, 40)
    cycles = [ramping.cycle() for _ in range(2)]
    assert [torque for _, _, torque in cycles] == [10, 15]
    assert [status & LIMITED for status, _, _ in cycles] == [0, LIMITED]


def test_operation_ends_when_the_torque_is_gone_and_begins_at_zero_again(ramping: Bench) -> None:
    ramping.command(0x0F, 20)
    ramping.cycle()
    ramping.cycle()
    ramping.command(0x07, 20)
    cycles = [ramping.cycle() for _ in range(3)]
    assert [(status, torque) for status, _, torque in cycles] == [
        (OPERATION_ENABLED, 10),
        (OPERATION_ENABLED, 0),
        (0x0233, 0),
    ]
    ramping.command(0x0F, 20)
    assert ramping.cycle()[2] == 10


def test_slope_does_nothing_in_cyclic_synchronous_torque_mode(ramping: Bench) -> None:
    ramping.write(0x6060, 0, 10, 1)
    ramping.command(0x0F, 500)
    assert ramping.cycle()[2] == 500
