"""Size of a count: factor group and units of CiA 402-2, or the name of the missing key."""

import math

import pytest
from canopen.objectdictionary import ODRecord, ODVariable, datatypes
from rig import Rig, RigFactory, settings_with

from canwall.drive import DriveError


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with({"drive.wait_s": 0.0}))


def pretend_at(rig: Rig, index: int, values: dict[int, int]) -> None:
    """The drive has this record with these values, by sub-index."""
    record = ODRecord("pretended", index)
    for subindex, value in values.items():
        variable = ODVariable(f"part {subindex}", index, subindex)
        variable.data_type = datatypes.UNSIGNED32
        record.add_member(variable)
        rig.tampering.invented[(index, subindex)] = value
    rig.node.dictionary.add_object(record)


def pretend(rig: Rig, index: int, *values: int) -> None:
    """The drive has this object with these values: one at sub-index 0, or a pair at 1 and 2."""
    subindices = [0] if len(values) == 1 else [1, 2]
    if index in rig.node.dictionary:
        del rig.node.dictionary[index]
    if len(values) == 1:
        variable = ODVariable("pretended", index)
        variable.data_type = datatypes.UNSIGNED32
        rig.node.dictionary.add_object(variable)
    else:
        record = ODRecord("pretended", index)
        for subindex in subindices:
            variable = ODVariable("part", index, subindex)
            variable.data_type = datatypes.UNSIGNED32
            record.add_member(variable)
        rig.node.dictionary.add_object(record)
    for subindex, value in zip(subindices, values, strict=True):
        key = index, subindex
        rig.tampering.invented[key] = value


@pytest.mark.parametrize(
    ("unit", "counts"),
    [
        (0xFF410000, 3600.0),
        (0x00410000, 360.0),
        (0xFD100000, 2000.0 * math.pi),
        (0xFCB40000, 10_000.0),
        (0x00B50000, 131072.0),
        (0x00000000, 131072.0),
    ],
)
def test_unit_of_position(rig: Rig, unit: int, counts: float) -> None:
    pretend(rig, 0x60A8, unit)
    assert rig.set_up().units.counts_per_rev == pytest.approx(counts)


def test_unit_that_is_no_angle(rig: Rig) -> None:
    pretend(rig, 0x60A8, 0xFD010000)  # millimetres
    with pytest.raises(DriveError, match=r"0x60A8 = 0xfd010000: neither.*drive.counts_per_rev"):
        rig.set_up()


@pytest.mark.parametrize(("feed", "counts"), [((7200, 2), 3600.0), ((1, 1), 131072.0)])
def test_feed_constant(rig: Rig, feed: tuple[int, int], counts: float) -> None:
    pretend(rig, 0x6092, *feed)
    assert rig.set_up().units.counts_per_rev == pytest.approx(counts)


def test_encoder_of_one_is_none(rig: Rig) -> None:
    rig.tampering.lies |= {(0x608F, 1): 1, (0x608F, 2): 1}
    with pytest.raises(DriveError, match=r"1/1 is not an encoder; give drive.counts_per_rev"):
        rig.set_up()


@pytest.mark.parametrize("polarity", [0x80, 0x20, 0xE0])
def test_reversed_position_or_torque(rig: Rig, polarity: int) -> None:
    pretend(rig, 0x607E, polarity)
    with pytest.raises(DriveError, match=r'drive.parameters = \{ "0x607E" = 0 \}'):
        rig.set_up()


def test_reversed_speed_does_not_matter(rig: Rig) -> None:
    pretend(rig, 0x607E, 0x40)
    rig.set_up()


@pytest.mark.parametrize("index", [0x6072, 0x6073, 0x60E0, 0x60E1])
def test_lowest_limit_counts(rig: Rig, index: int) -> None:
    pretend(rig, index, 500)
    setup = rig.set_up()
    assert setup.torque_limit_nm == pytest.approx(0.5 * 0.637)
    assert setup.scales is not None
    assert setup.scales.sources[-1] == ("0.3185 N·m at most", f"0x{index:04X} = 500")


def test_limit_of_zero_names_the_key(rig: Rig) -> None:
    pretend(rig, 0x6072, 0)
    with pytest.raises(DriveError, match=r'0x6072 = 0: the drive gives no torque.*"0x6072" = 1000'):
        rig.set_up()


# Rated torque: mN·m in CiA 402, µN·m with some drives

MAXON_VALUE, MAXON_CURRENT_MA, MAXON_CONSTANT = 512_871, 4760, 107_746
"""0x6076, 0x3001:01 and 0x3001:05 of a DCF of maxon's."""


def rated_by(rig: Rig) -> tuple[str, str]:
    scales = rig.set_up().scales
    assert scales is not None
    return scales.sources[2]


@pytest.mark.parametrize(
    ("value", "unit"), [(MAXON_VALUE, "µN·m"), (513, "mN·m")], ids=["micro", "milli"]
)
def test_maxon_shows_the_unit_by_its_own_objects(rig: Rig, value: int, unit: str) -> None:
    rig.tampering.lies |= {(0x1018, 1): 0xFB, (0x6076, 0): value}
    pretend_at(rig, 0x3001, {1: MAXON_CURRENT_MA, 5: MAXON_CONSTANT})
    found, source = rated_by(rig)
    assert float(found.split()[0]) == pytest.approx(0.512871, rel=1e-3)
    assert source == f"0x6076 = {value}, in {unit} by 0x3001:01 and 0x3001:05"


@pytest.mark.parametrize(
    ("value", "limit_nm"),
    [(MAXON_VALUE, 1.9), (MAXON_VALUE, 0.5), (637_000, 1.9), (637, 0.006), (637, 12.8)],
)
def test_rated_torque_that_does_not_suit_the_limit(
    make_rig: RigFactory, value: int, limit_nm: float
) -> None:
    rig = make_rig(settings_with({"limits.torque_nm": limit_nm}))
    rig.tampering.lies[(0x6076, 0)] = value
    with pytest.raises(
        DriveError, match=r"0x6076 = .*limits\.torque_nm.*drive.rated_torque_unit_nm"
    ):
        rig.set_up()


@pytest.mark.parametrize(("value", "limit_nm"), [(637, 0.007), (637, 1.9), (637, 12.7)])
def test_rated_torque_that_suits_the_limit(
    make_rig: RigFactory, value: int, limit_nm: float
) -> None:
    rig = make_rig(settings_with({"limits.torque_nm": limit_nm}))
    assert rig.set_up().units.rated_torque_nm == pytest.approx(0.637)


@pytest.mark.parametrize(
    ("key", "given", "rated"),
    [
        ("rated_torque_unit_nm", 1e-6, 0.512871),
        ("rated_torque_unit_nm", 1e-3, 512.871),
        ("rated_torque_nm", 0.5, 0.5),
    ],
)
def test_keys_that_settle_it(make_rig: RigFactory, key: str, given: float, rated: float) -> None:
    rig = make_rig(settings_with({f"drive.{key}": given}))
    rig.tampering.lies[(0x6076, 0)] = MAXON_VALUE
    assert rig.set_up().units.rated_torque_nm == pytest.approx(rated)
