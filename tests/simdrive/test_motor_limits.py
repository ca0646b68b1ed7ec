"""Limits of the motor and its travel: current, I²t, limit switches, STO, DC link."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from bus_bench import COUNTS_PER_RAD, PERIOD_S, RATED_NM, BusBench
from canopen import SdoAbortedError
from simdrive_bench import EDS, NODE_ID, START, Bench

from canwall.config import Drive as DriveSettings
from canwall.config import Simulation
from canwall.simdrive import make_drive
from canwall.simdrive.profile.hardware import Hardware

WARNING, LIMITED, VOLTAGE = 1 << 7, 1 << 11, 1 << 4
MakeBench = Callable[[Hardware], BusBench]


@pytest.fixture
def enabled() -> Iterator[MakeBench]:
    """Makes benches with a drive that is enabled in mode 10, its clock running."""
    with ExitStack() as stack:

        def make(hardware: Hardware) -> BusBench:
            bench = BusBench(hardware)
            stack.callback(bench.close)
            bench.wait()
            bench.write(0x6060, 10)
            bench.nmt(START)
            for controlword in (0x06, 0x07, 0x0F):
                bench.write(0x6040, controlword)
            bench.sync()
            return bench

        yield make


def pull(bench: BusBench, torque: int, periods: int) -> list[int]:
    """Torque that the motor has in each of some periods."""
    bench.write(0x6071, torque)
    given = []
    for _ in range(periods):
        bench.sync()
        given.append(round(bench.flywheel.pulled_nm / RATED_NM * 1000))
    return given


@pytest.mark.parametrize("torque", [3000, -3000])
def test_peak_torque_lasts_for_overload_s_and_falls_back(enabled: MakeBench, torque: int) -> None:
    bench = enabled(Hardware(overload_s=0.05))
    given = pull(bench, torque, 80)
    assert set(given[:50]) == {torque}
    assert set(given[51:]) == {torque // 3}
    status = bench.read(0x6041)
    assert status & WARNING
    assert status & LIMITED


def test_budget_is_that_of_the_square_of_the_torque(enabled: MakeBench) -> None:
    bench = enabled(Hardware(overload_s=0.05))
    given = pull(bench, 2000, 200)
    # (3² − 1²)·50 ms at (2² − 1²) each.
    lasted = sum(torque == 2000 for torque in given)
    assert lasted * PERIOD_S == pytest.approx(0.05 * 8 / 3, abs=2 * PERIOD_S)
    assert not set(given[lasted + 1 :]) - {1000}
    excess = sum(torque**2 - 1000**2 for torque in given) * PERIOD_S
    assert excess <= (3000**2 - 1000**2) * 0.05 * (1 + 1e-6)


def test_budget_fills_again_at_less_than_rated_torque(enabled: MakeBench) -> None:
    bench = enabled(Hardware(overload_s=0.02))
    pull(bench, 3000, 30)
    assert bench.read(0x6041) & WARNING
    pull(bench, 0, 170)  # 8 times as long as the overload
    assert not bench.read(0x6041) & WARNING
    assert set(pull(bench, 3000, 19)) == {3000}


def test_peak_torque_of_the_hardware(enabled: MakeBench) -> None:
    bench = enabled(Hardware(peak_torque_nm=2 * RATED_NM))
    assert set(pull(bench, 2500, 3)) == {2000}
    assert bench.read(0x6041) & LIMITED


def test_peak_torque_of_the_configuration() -> None:
    bench = Bench()
    simulation = Simulation(peak_torque_nm=1.5 * RATED_NM).with_ideal_servo()
    bench.drive = make_drive(  # type: ignore[assignment]
        DriveSettings(node_id=NODE_ID, eds=EDS), simulation, PERIOD_S
    )
    bench.drive.boot()
    bench.configure_cycle()
    bench.enable()
    bench.command(0x0F, 3000)
    assert bench.cycle()[2] == 1500


@pytest.mark.parametrize("rated_mnm", [1, 200, 637, 5000, 2**32 - 1])
def test_peak_torque_stays_where_the_bus_changes_its_unit(
    enabled: MakeBench, rated_mnm: int
) -> None:
    bench = enabled(Hardware(peak_torque_nm=2 * RATED_NM))
    bench.drive.dictionary[0x6076, 0].access = "rw"  # as many drives have it
    given = set(pull(bench, 2000, 3))
    assert given == {2000}
    bench.write(0x6076, rated_mnm)
    bench.write(0x6071, 32767)
    bench.sync()
    assert abs(bench.flywheel.pulled_nm) <= 2 * RATED_NM * (1 + 1e-9)
    assert bench.read(0x6077) * rated_mnm * 1e-6 == pytest.approx(bench.flywheel.pulled_nm)


def test_torque_beyond_what_its_object_holds_is_shown_as_the_largest(enabled: MakeBench) -> None:
    bench = enabled(Hardware())
    bench.drive.axis.show_torque(-40 * RATED_NM)
    assert bench.drive.dictionary[0x6077, 0].upload() == (-32767).to_bytes(2, "little", signed=True)


def test_max_current_limits_as_max_torque_does(enabled: MakeBench) -> None:
    bench = enabled(Hardware())
    bench.write(0x6073, 400)
    assert set(pull(bench, -900, 3)) == {-400}
    assert bench.read(0x6078) == bench.read(0x6077) == -400
    assert bench.read(0x6075) == 5000


@pytest.mark.parametrize("direction", [1, -1])
def test_limit_switch_takes_the_torque_into_it_away(enabled: MakeBench, direction: int) -> None:
    bench = enabled(
        Hardware(negative_limit=-1.0 * COUNTS_PER_RAD, positive_limit=1.0 * COUNTS_PER_RAD)
    )
    assert bench.read(0x60FD) == 0
    bench.flywheel.position_rad = direction * 1.01
    bench.sync()
    assert bench.read(0x60FD) == (2 if direction > 0 else 1)
    assert bench.read(0x6041) & LIMITED
    assert pull(bench, direction * 500, 2)[1:] == [0]
    assert pull(bench, -direction * 500, 2)[1:] == [-direction * 500]
    bench.flywheel.position_rad = 0.0
    bench.sync()
    assert bench.read(0x60FD) == 0
    assert not bench.read(0x6041) & LIMITED
    assert pull(bench, direction * 500, 2)[1:] == [direction * 500]


def test_limit_switch_where_the_torque_is_counted_the_other_way(enabled: MakeBench) -> None:
    bench = enabled(Hardware(positive_limit=1.0 * COUNTS_PER_RAD))
    bench.write(0x607E, 1 << 5)
    bench.flywheel.position_rad = 1.01
    bench.sync()
    assert pull(bench, -500, 2)[1:] == [0]
    assert pull(bench, 500, 2)[1:] == [-500]


def test_home_switch(enabled: MakeBench) -> None:
    bench = enabled(Hardware(home=(-0.1 * COUNTS_PER_RAD, 0.1 * COUNTS_PER_RAD)))
    bench.sync()
    assert bench.read(0x60FD) == 4
    assert not bench.read(0x6041) & LIMITED


def test_safe_torque_off_is_an_external_error(enabled: MakeBench) -> None:
    bench = enabled(Hardware())
    assert pull(bench, 500, 2)[1:] == [500]
    bench.drive._pds.sto(True)
    assert bench.read(0x6077) == 0
    assert bench.read(0x60FD) == 8
    assert bench.read(0x603F) == 0x9000
    assert bench.emergencies() == [0x9000]
    assert pull(bench, 500, 2) == [0, 0]


def test_undervoltage_without_operation_is_an_error_that_goes(enabled: MakeBench) -> None:
    bench = enabled(Hardware(dc_link_v=24.0))
    bench.write(0x6040, 0)
    assert bench.read(0x6079) == 24000
    bench.drive._pds.undervoltage(True)
    assert bench.read(0x6079) == 0
    assert not bench.read(0x6041) & VOLTAGE
    assert bench.read(0x1001) == 0x05
    bench.drive._pds.undervoltage(False)
    bench.turn()
    assert bench.read(0x1001) == 0
    assert bench.read(0x6041) & VOLTAGE
    assert bench.emergencies() == [0x3220, 0x0000]


def test_fault_of_an_injector(enabled: MakeBench) -> None:
    bench = enabled(Hardware())
    bench.drive._pds.fault(0x4310, (0x2200, 0))
    assert bench.read(0x6041) & 0x4F == 0x0F
    assert bench.read(0x1001) == 0x09
    bench.wait()
    bench.write(0x6040, 0x80)
    assert bench.read(0x603F) == 0
    assert bench.emergencies() == [0x4310, 0x0000]


def test_polarity_of_position_velocity_and_torque(enabled: MakeBench) -> None:
    bench = enabled(Hardware())
    bench.flywheel.position_rad, bench.flywheel.speed_rad_s = 0.5, 2.0
    bench.sync()
    bench.flywheel.speed_rad_s = 2.0
    position, velocity = bench.read(0x6064), bench.read(0x606C)
    assert velocity == round(2.0 * COUNTS_PER_RAD)
    for polarity, signs in ((0x80, (-1, 1)), (0x40, (1, -1)), (0xC0, (-1, -1)), (0, (1, 1))):
        bench.write(0x607E, polarity)
        bench.flywheel.position_rad, bench.flywheel.speed_rad_s = 0.5, 2.0
        bench.sync()
        shown = bench.read(0x6064), bench.read(0x606C)
        assert shown == (signs[0] * position, signs[1] * velocity)
    bench.write(0x607E, 0x20)
    assert pull(bench, 300, 2)[1:] == [-300]
    assert bench.read(0x6077) == 300
    with pytest.raises(SdoAbortedError, match="06090031"):
        bench.write(0x607E, 0xF0)


@pytest.mark.parametrize("polarity", [0x00, 0x80])
@pytest.mark.parametrize("offset", [0, 12345, -500])
def test_homing_makes_the_position_the_home_offset(
    enabled: MakeBench, polarity: int, offset: int
) -> None:
    bench = enabled(Hardware())
    bench.write(0x607E, polarity)
    bench.write(0x607C, offset)
    bench.flywheel.position_rad = 1.0
    bench.sync()
    bench.write(0x6060, 6)
    assert bench.read(0x6064) != offset
    bench.write(0x6040, 0x1F)
    assert bench.read(0x6064) == offset
    bench.flywheel.position_rad = 1.0 + 100 / COUNTS_PER_RAD
    bench.sync()
    assert bench.read(0x6064) == offset + (-100 if polarity else 100)
