"""Slowing down beyond the table of cases: no SYNC, a hand, a load, vendors' dictionaries."""

import math
import struct
from pathlib import Path

import pytest
from bus_bench import COUNTS_PER_RAD, PERIOD_S, BusBench
from simdrive_bench import EDS, NODE_ID, PRE_OPERATIONAL, START, SYNC
from vendors import FOLDER, VENDORS, ConfiguredBench, path_of

from canwall.config import Drive, Hand, Simulation
from canwall.eds import DictionaryError
from canwall.simdrive import Dictionary, ServoDrive, make_drive

STANDSTILL_RAD_S = 2.0 * math.pi / 60.0


def enable(bench: BusBench) -> None:
    bench.wait()
    bench.write(0x6060, 10)
    bench.nmt(START)
    for controlword in (0x06, 0x07, 0x0F):
        bench.write(0x6040, controlword)
    bench.sync()


def test_drive_whose_master_is_gone_comes_to_rest_without_sync() -> None:
    bench = BusBench()
    enable(bench)
    bench.flywheel.speed_rad_s = 20.0
    bench.nmt(PRE_OPERATIONAL)
    for _ in range(60):
        bench.wait()
    assert bench.flywheel.speed_rad_s == 20.0, "the SYNC may yet come"
    assert bench.read(0x6041) & 0x4F == 0x0F
    for _ in range(40):
        bench.wait()
    assert abs(bench.flywheel.speed_rad_s) < STANDSTILL_RAD_S
    assert bench.read(0x6041) & 0x4F == 0x08
    still = bench.flywheel.position_rad
    for _ in range(200):
        bench.wait()
    assert bench.flywheel.position_rad == still
    bench.close()


@pytest.mark.parametrize("load", [0.7, 1.6, 36.0])
def test_load_that_the_controller_is_not_tuned_to_comes_to_rest(load: float) -> None:
    """Drive alone 1e-4 kg·m²; lighter, with a finger's mass, with an arm's."""
    bench = BusBench()
    bench.flywheel.inertia_kg_m2 *= load
    enable(bench)
    bench.flywheel.speed_rad_s = 10.0
    bench.write(0x605A, 6)
    bench.write(0x6040, 2)
    for _ in range(1000):
        bench.sync()
    assert abs(bench.flywheel.speed_rad_s) < STANDSTILL_RAD_S
    assert bench.read(0x6041) == 0x0617
    bench.close()


def test_drive_that_cannot_brake_gives_up_after_five_seconds() -> None:
    bench = BusBench()
    enable(bench)
    bench.write(0x6072, 0)
    bench.flywheel.speed_rad_s = 10.0
    bench.write(0x6040, 2)
    for _ in range(4950):
        bench.sync()
    assert bench.read(0x6041) & 0x6F == 0x07
    for _ in range(100):
        bench.sync()
    assert bench.read(0x6041) & 0x6F == 0x40
    bench.close()


def test_handle_in_a_hand_is_held_after_a_quick_stop() -> None:
    """The hand goes on to press; the drive that stays in QUICK STOP ACTIVE does not let it."""
    simulation = Simulation(hand=Hand(strikes=1, first_strike_s=0.01, press_s=2.0))
    drive = make_drive(Drive(node_id=NODE_ID, eds=EDS), simulation, PERIOD_S)
    drive.boot()
    drive.tick(PERIOD_S)

    def write(index: int, value: int, size: int) -> None:
        data = value.to_bytes(4, "little")
        drive.process(0x600 + NODE_ID, struct.pack("<BHB", 0x23 | 4 - size << 2, index, 0) + data)

    write(0x6060, 10, 1)
    write(0x605A, 6, 2)
    for controlword in (0x06, 0x07, 0x0F):
        write(0x6040, controlword, 2)
    for _ in range(60):
        drive.process(SYNC, b"")
    motion = drive.drive._motion
    assert motion.speed_counts_per_s() < -1.0 * COUNTS_PER_RAD
    write(0x6040, 2, 2)
    for _ in range(100):
        drive.process(SYNC, b"")
    stopped = motion.counts()
    assert abs(motion.speed_counts_per_s()) < 0.5 * COUNTS_PER_RAD
    for _ in range(900):
        drive.process(SYNC, b"")
    assert abs(motion.counts() - stopped) < 0.05 * COUNTS_PER_RAD
    assert abs(motion.speed_counts_per_s()) < STANDSTILL_RAD_S * COUNTS_PER_RAD


def test_braking_along_the_voltage_limit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.dcf"
    text = EDS.read_text()
    head, tail = text.split("[605A]", 1)
    path.write_text(head + "[605A]" + tail.replace("DefaultValue=2", "DefaultValue=4", 1))
    with pytest.raises(DictionaryError, match=r"0x605A:00 4: braking along the voltage limit"):
        ServoDrive(Dictionary.load(path, NODE_ID), NODE_ID, BusBench().flywheel, PERIOD_S)


def vendor_bench(file: str) -> ConfiguredBench:
    bench = ConfiguredBench(path_of(file))
    bench.enable()
    bench.sync()
    return bench


def test_maxon_quick_stop_brakes_in_rpm_per_second_and_stays() -> None:
    bench = vendor_bench("maxon_epos4_0x1018.eds")
    assert bench.read(0x605A) == 6
    bench.write(0x6085, 0, 20_000, 4)
    bench.write(0x6071, 0, 200, 2)
    for _ in range(15):
        bench.sync()
    motion, counts_per_rad = bench.drive.drive._motion, 4000 / (2 * math.pi)
    assert motion.speed_counts_per_s() > 3.0 * counts_per_rad
    bench.write(0x6071, 0, 0, 2)
    bench.write(0x6040, 0, 2, 2)
    for _ in range(20):  # 20000 rpm/s are 2094 rad/s²
        bench.sync()
    assert abs(motion.speed_counts_per_s()) < 2.0 * counts_per_rad
    for _ in range(300):
        bench.sync()
    assert bench.read(0x6041) & 0x6F == 0x07


def test_ingenia_stays_in_quick_stop_and_has_no_deceleration_to_begin_with() -> None:
    bench = vendor_bench("ingenia_eve-net-c_1.8.1.eds")
    assert bench.read(0x605A) == 5
    assert bench.read(0x6084) == 0
    bench.write(0x6071, 0, 100, 2)
    bench.sync()
    bench.write(0x6040, 0, 2, 2)
    for _ in range(3):
        bench.sync()
        assert bench.read(0x6041) & 0x6F == 0x07
        assert bench.read(0x6077) == 0
    bench.write(0x6040, 0, 0x0F, 2)
    assert bench.read(0x6041) & 0x6F == 0x27


@pytest.mark.parametrize("file", ["maxon_epos4_0x1018.eds", "nanotec_C5-E-2-09.eds"])
def test_velocity_is_in_the_unit_of_0x60a9(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = vendor_bench(file)
    assert bench.read(0x60A9) == 0x00B44700  # revolutions per minute
    counts_per_s = 10.0 * 4000 / (2 * math.pi)
    motion = bench.drive.drive._motion
    monkeypatch.setattr(motion, "speed_counts_per_s", lambda: counts_per_s)
    bench.sync()
    assert bench.read(0x606C, signed=True) == round(10.0 * 60 / (2 * math.pi))
    bench.write(0x60A9, 0, 0xFDB44700, 4)  # thousandths of them
    bench.sync()
    assert bench.read(0x606C, signed=True) == round(10_000.0 * 60 / (2 * math.pi))


@pytest.mark.parametrize("vendor", VENDORS, ids=lambda vendor: vendor.file)
def test_option_codes_of_vendors_can_be_written_back(vendor: object) -> None:
    file = vendor.file  # type: ignore[attr-defined]
    if not (FOLDER / file).is_file():
        pytest.skip(f"{FOLDER} has no {file}")
    bench = ConfiguredBench(path_of(file))
    for index in range(0x605A, 0x605F):
        if (index, 0) in bench.drive.drive._dictionary:
            bench.write(index, 0, bench.read(index, signed=True), 2)
