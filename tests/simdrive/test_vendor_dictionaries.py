"""The drive with the dictionaries of drives that can be bought."""

import struct

import canopen
import pytest
from canopen import SdoAbortedError
from simdrive_bench import (
    CONTROLWORD,
    NO_RTR,
    NODE_ID,
    NOT_VALID,
    POSITION,
    RPDO,
    START,
    STATUSWORD,
    TARGET_TORQUE,
    TPDO,
    Bench,
)
from vendors import SIMULATION, VENDORS, ConfiguredBench, Vendor, path_of

from canwall.eds import load_eds


@pytest.fixture(params=VENDORS, ids=lambda vendor: vendor.file)
def vendor(request: pytest.FixtureRequest) -> Vendor:
    assert isinstance(request.param, Vendor)
    path_of(request.param.file)
    return request.param


@pytest.fixture
def of_vendor(vendor: Vendor) -> ConfiguredBench:
    return ConfiguredBench(path_of(vendor.file))


def test_keeps_exactly_that_dictionary(vendor: Vendor, of_vendor: ConfiguredBench) -> None:
    od = load_eds(of_vendor.path, NODE_ID)
    for index in (*range(0x1000, 0x1030), *range(0x6000, 0x6600), *vendor.lacks):
        request = struct.pack("<BHB4x", 0x40, index, 0)
        try:
            of_vendor.sdo(request)
        except SdoAbortedError as abort:
            assert (abort.code == 0x06020000) == (index not in od)  # noqa: PT017
        else:
            assert index in od
    assert not any(index in od for index in vendor.lacks)


def readable(od: canopen.ObjectDictionary) -> list[tuple[int, int]]:
    """Objects up to 32 bits long that may be read."""
    variables: list[canopen.objectdictionary.ODVariable] = []
    for item in od.values():
        variables += item.values() if hasattr(item, "subindices") else [item]
    types = (*range(1, 8),)
    return [
        (one.index, one.subindex)
        for one in variables
        if one.index >= 0x1000 and one.data_type in types and one.access_type != "wo"
    ]


def test_answers_sdo(of_vendor: ConfiguredBench) -> None:
    no_error_yet = 0x1003
    for key in readable(load_eds(of_vendor.path, NODE_ID)):
        if key[0] != no_error_yet:
            of_vendor.read(*key)


def configure(bench: Bench, index: int, cob_id: int, mapping: list[int]) -> None:
    """Set up a PDO that every SYNC moves, in the order of CiA 301."""
    bench.write(index, 1, cob_id | NOT_VALID, 4)
    bench.write(index + 0x200, 0, 0, 1)
    for place, mapped in enumerate(mapping, start=1):
        bench.write(index + 0x200, place, mapped, 4)
    bench.write(index + 0x200, 0, len(mapping), 1)
    bench.write(index, 2, 1, 1)
    bench.write(index, 1, cob_id, 4)


def test_is_enabled_and_driven(vendor: Vendor, of_vendor: ConfiguredBench) -> None:
    bench = of_vendor
    bench.tick()
    configure(bench, 0x1400, RPDO[1], [CONTROLWORD, TARGET_TORQUE])
    configure(bench, 0x1800, NO_RTR | TPDO[1], [STATUSWORD, POSITION])
    bench.nmt(START)
    for mode in vendor.modes:
        torque = 50
        bench.write(0x6060, 0, mode, 1)
        assert bench.read(0x6061) == mode
        if mode == 4:
            bench.write(0x6087, 0, 25_000, 4)
        for controlword in (0x06, 0x07, 0x0F, 0x0F, 0x0F):
            bench.give(RPDO[1], struct.pack("<Hh", controlword, torque))
            frames = dict(bench.sync())
        status, _ = struct.unpack("<Hi", frames[TPDO[1]])
        assert status & 0x6F == 0x27
        assert bench.read(0x6077) == torque
        bench.give(RPDO[1], struct.pack("<Hh", 0x00, 0))
        bench.sync()
    assert {code for code, _ in bench.emergencies()} == set()


@pytest.mark.parametrize("mode", [1, 3, 5, 7, 8, 9])
def test_modes_without_torque_are_refused(of_vendor: ConfiguredBench, mode: int) -> None:
    if mode == of_vendor.read(0x6060):
        of_vendor.write(0x6060, 0, mode, 1)  # the power-on mode may be gone back to
        return
    with pytest.raises(SdoAbortedError, match="06090030"):
        of_vendor.write(0x6060, 0, mode, 1)


def test_supported_modes_are_shown(vendor: Vendor, of_vendor: ConfiguredBench) -> None:
    shown = of_vendor.read(0x6502)
    if load_eds(of_vendor.path, NODE_ID)[0x6502].default is None:
        assert shown == sum(1 << mode - 1 for mode in (*vendor.modes, 6))


def test_units(vendor: Vendor, of_vendor: ConfiguredBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = of_vendor
    torques: list[float] = []
    motion = bench.drive.drive._motion
    monkeypatch.setattr(motion, "advance", lambda torque_nm, _: torques.append(torque_nm))
    bench.enable()
    bench.write(0x6071, 0, 100, 2)
    bench.sync()
    bench.sync()
    assert torques[-1] == pytest.approx(0.1 * vendor.rated_torque_mnm / 1000)
    turn = SIMULATION.hand.rest_rad / 6.283185307179586
    # Rounded to increments of the encoder, then to the drive's unit (Nanotec: 0x60A8, 0.1 degree).
    assert bench.read(0x6064) == pytest.approx(turn * vendor.counts_per_rev, abs=0.96)
    if vendor.rated_torque_mnm == 1250 and 0x6076 not in vendor.lacks:
        assert bench.read(0x6076) == 1250


@pytest.mark.parametrize(
    ("index", "value", "size", "factor"),
    [(0x60A8, 0x00B50000, 4, 4000 / 3600), (0x607E, 0x80, 1, -1.0)],
)
def test_position_follows_its_unit_before_a_sync(
    index: int, value: int, size: int, factor: float
) -> None:
    bench = ConfiguredBench(path_of("nanotec_C5-E-2-09.eds"))
    before = bench.read(0x6064, signed=True)
    bench.write(index, 0, value, size)
    assert bench.read(0x6064, signed=True) == pytest.approx(factor * before, abs=0.6)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_four_pdos_each_way_in_the_order_of_cia_301(
    of_vendor: ConfiguredBench, number: int
) -> None:
    bench = of_vendor
    for communication, cob_id, mapped in (
        (0x1400 + number - 1, RPDO[number], CONTROLWORD),
        (0x1800 + number - 1, NO_RTR | TPDO[number], STATUSWORD),
    ):
        mapping = communication + 0x200
        begins_empty = not (bench.read(communication, 1) & NOT_VALID or bench.read(mapping, 0))
        configure(bench, communication, cob_id, [mapped])
        for index, subindex, value, size in (
            (mapping, 0, 0, 1),  # while it is valid
            (mapping, 1, mapped, 4),
            (communication, 1, cob_id ^ 0x20, 4),
        ):
            with pytest.raises(SdoAbortedError, match="08000022"):
                bench.write(index, subindex, value, size)
        bench.write(communication, 1, NOT_VALID | cob_id, 4)
        with pytest.raises(SdoAbortedError, match="08000022"):
            bench.write(mapping, 1, mapped, 4)  # while the number of entries is not 0
        bench.write(mapping, 0, 0, 1)
        if begins_empty:  # so it may be so again
            continue
        with pytest.raises(SdoAbortedError, match="08000022"):
            bench.write(communication, 1, cob_id, 4)  # valid with nothing in it
        assert bench.read(communication, 1) == NOT_VALID | cob_id
