"""Set-up over SDO: what goes over the bus, and what the master makes of drives that misbehave."""

from pathlib import Path

import pytest
from rig import (
    SDO_ANSWER,
    SDO_REQUEST,
    Object,
    Rig,
    RigFactory,
    eds_without,
    multiplexer,
    settings_with,
)

from canwall.drive import DriveError, DriveSetup, Field
from canwall.run.closed_loop import cached_servo_scales

INVALID = 1 << 31
BIT_30 = 1 << 30


def writes(rig: Rig) -> list[tuple[int, int, int]]:
    """Index, subindex and value of every (expedited) download so far."""
    return [
        (*multiplexer(data), int.from_bytes(data[4:8], "little"))
        for can_id, data in rig.frames
        if can_id == SDO_REQUEST and data[0] >> 5 == 1
    ]


def error_of(rig: Rig) -> str:
    with pytest.raises(DriveError) as caught:
        rig.set_up()
    text = str(caught.value)
    assert "\n" not in text
    assert all(torque == 0 for _, torque in rig.rpdos())
    return text


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with({"drive.wait_s": 0.0}))


# PDOs


@pytest.mark.parametrize(
    ("communication", "cob_id", "mapping", "watchdog"),
    [
        (0x1800, BIT_30 | 0x185, [0x60640020, 0x60410010, 0x60770010], []),
        # Switched off once more for its deadline.
        (0x1400, 0x205, [0x60400010, 0x60710010], [(1, INVALID | 0x205), (5, 30000), (1, 0x205)]),
    ],
)
def test_pdo_is_configured_in_the_order_of_cia_301(
    rig: Rig,
    communication: int,
    cob_id: int,
    mapping: list[int],
    watchdog: list[tuple[int, int]],
) -> None:
    rig.set_up()
    objects = communication + 0x200
    assert [w for w in writes(rig) if w[0] in (communication, objects)] == [
        (communication, 1, INVALID | cob_id),
        (objects, 0, 0),
        *((objects, place, entry) for place, entry in enumerate(mapping, start=1)),
        (objects, 0, len(mapping)),
        (communication, 2, 1),
        (communication, 1, cob_id),
        *((communication, *write) for write in watchdog),
    ]
    assert rig.node.read(communication, 1) == cob_id
    assert [rig.node.read(objects, place) for place in (1, 2)] == mapping[:2]


def test_inhibit_time_and_event_timer_are_cleared(rig: Rig) -> None:
    rig.node.write(0x1800, 1, INVALID | BIT_30 | 0x185)
    rig.node.write(0x1800, 3, 300)
    rig.node.write(0x1800, 5, 20)
    rig.set_up()
    assert rig.node.read(0x1800, 3) == 0
    assert rig.node.read(0x1800, 5) == 0


def test_layout_is_what_the_drive_confirmed(rig: Rig) -> None:
    setup = rig.set_up()
    assert setup.tpdo.cob_id == 0x185
    assert setup.tpdo.length == 8
    assert setup.tpdo.fields == (
        Field(0x6064, 0, 0, 32),
        Field(0x6041, 0, 32, 16),
        Field(0x6077, 0, 48, 16),
    )
    assert setup.rpdo.cob_id == 0x205
    assert setup.rpdo.length == 4
    assert setup.rpdo.field(0x6071) == Field(0x6071, 0, 16, 16)
    assert setup.rpdo.field(0x6077) is None
    assert setup.sync_cob_id == 0x80


def test_drive_without_torque_actual_value_maps_less(rig: Rig) -> None:
    del rig.node.dictionary[0x6077]
    setup = rig.set_up()
    assert setup.tpdo.length == 6
    assert setup.tpdo.field(0x6077) is None


def test_sync_has_the_identifier_of_the_drive(rig: Rig) -> None:
    rig.node.write(0x1005, 0, 0x90)
    assert rig.set_up().sync_cob_id == 0x90


# Mode and torque


def test_ends_operational_in_torque_mode_with_zero_torque_and_disabled(rig: Rig) -> None:
    rig.node.write(0x6071, 0, 123)
    rig.set_up()
    assert rig.node.read(0x6061) == 10
    assert rig.node.read(0x6071) == 0
    assert rig.node.read(0x6041) & 0x6F == 0x40
    nmt = [data for can_id, data in rig.frames if can_id == 0]
    assert nmt == [b"\x80\x05", b"\x01\x05"]
    assert rig.rpdos() == []
    torque_is_zero = rig.frames.index((SDO_REQUEST, b"\x2b\x71\x60\x00\0\0\0\0"))
    operational = rig.frames.index((0, b"\x01\x05"))
    assert torque_is_zero < operational


# Units


def test_units_from_the_objects_of_the_drive(rig: Rig) -> None:
    rig.tampering.lies |= {
        (0x608F, 1): 4096,
        (0x608F, 2): 2,
        (0x6091, 1): 10,
        (0x6091, 2): 4,
        (0x6076, 0): 800,
    }
    units = rig.set_up().units
    assert units.counts_per_rev == pytest.approx(2048 * 2.5)
    assert units.rated_torque_nm == pytest.approx(0.8 * 2.5)


def test_configuration_goes_first(make_rig: RigFactory) -> None:
    given = {"counts_per_rev": 1000.0, "rated_torque_nm": 2.0, "gear_ratio": 3.0}
    rig = make_rig(settings_with({f"drive.{key}": value for key, value in given.items()}))
    units = rig.set_up().units
    assert units.counts_per_rev == pytest.approx(3000.0)
    assert units.rated_torque_nm == pytest.approx(6.0)
    asked = {multiplexer(data)[0] for can_id, data in rig.frames if can_id == SDO_REQUEST}
    assert not asked & {0x608F, 0x6091, 0x6076}


def test_simulated_drive_has_the_gear_that_its_master_was_given(make_rig: RigFactory) -> None:
    assert cached_servo_scales(settings_with()).gear_ratio == 1.0
    settings = settings_with({"drive.gear_ratio": 3.0})
    units = make_rig(settings).set_up().units
    simulated = cached_servo_scales(settings)
    assert simulated.gear_ratio == 3.0
    assert simulated.counts_per_rev == pytest.approx(units.counts_per_rev)


@pytest.mark.parametrize(
    ("index", "key"), [(0x608F, "drive.counts_per_rev"), (0x6076, "drive.rated_torque_nm")]
)
def test_what_the_drive_cannot_say_names_the_key(rig: Rig, index: int, key: str) -> None:
    del rig.node.dictionary[index]
    assert key in error_of(rig)


def test_no_gear_ratio_is_a_ratio_of_one(rig: Rig) -> None:
    rig.tampering.lies[(0x6091, 1)] = 7
    del rig.node.dictionary[0x6091]
    assert rig.set_up().units.counts_per_rev == pytest.approx(131072)


@pytest.mark.parametrize(
    ("zero", "words"),
    [
        ((0x608F, 1), "0x608F: 0/1 is not a scale; give drive.counts_per_rev"),
        ((0x6091, 2), "0x6091: 1/0 is not a scale; give drive.gear_ratio"),
    ],
)
def test_scale_of_zero(rig: Rig, zero: Object, words: str) -> None:
    rig.tampering.lies[zero] = 0
    assert words in error_of(rig)


def test_rated_torque_of_zero(rig: Rig) -> None:
    rig.tampering.lies[(0x6076, 0)] = 0
    assert "0x6076 = 0: give drive.rated_torque_nm" in error_of(rig)


# Drives that misbehave


@pytest.mark.slow
def test_no_answer(rig: Rig) -> None:
    rig.tampering.mute.add(SDO_ANSWER)
    text = error_of(rig)
    assert "node 5 does not answer" in text
    assert "drive.node_id" in text


def test_abort(rig: Rig) -> None:
    rig.tampering.aborts[(0x6060, 0)] = 0x06090030
    text = error_of(rig)
    assert "writing 0xa to 0x6060:00 failed" in text
    assert "0x06090030" in text


def test_drive_that_falls_silent(rig: Rig) -> None:
    rig.node.read(0x1000)
    rig.tampering.mute.add(SDO_ANSWER)
    with pytest.raises(
        DriveError, match=r"node 5: reading 0x6041:00 failed: no answer within 0\.5 s"
    ):
        rig.node.read(0x6041)


@pytest.mark.slow
def test_mode_that_does_not_come(rig: Rig) -> None:
    rig.tampering.lies[(0x6061, 0)] = 8
    assert "0x6061 shows mode 8 after mode 10 was set" in error_of(rig)


@pytest.mark.parametrize(
    ("lie", "said"),
    [
        ({(0x6071, 0): 5}, "0x6071:00: wrote 0x0, the drive keeps 0x5"),
        ({(0x1800, 2): 255}, "0x1800:02: wrote 0x1, the drive keeps 0xff"),
        ({(0x1A00, 1): 0x60630020}, "0x1A00: the drive maps 0x60630020, 0x60410010"),
        ({(0x1A00, 0): 2}, "0x1A00: the drive maps 0x60640020, 0x60410010 instead"),
        ({(0x1600, 2): 0x60720010}, "0x1600: the drive maps 0x60400010, 0x60720010 instead"),
        ({(0x1400, 1): INVALID | 0x205}, "0x1400:01: the PDO stays off"),
    ],
)
def test_what_is_read_back_differs(rig: Rig, lie: dict[Object, int], said: str) -> None:
    rig.tampering.lies |= lie
    assert said in error_of(rig)


def test_object_that_no_pdo_can_carry(rig: Rig) -> None:
    del rig.node.dictionary[0x6064]
    assert "0x6064: not in the object dictionary" in error_of(rig)


def test_object_without_known_size_cannot_be_written(rig: Rig) -> None:
    with pytest.raises(DriveError, match="0x4711:00: not in the object dictionary"):
        rig.node.write(0x4711, 0, 1)


def test_eds_without_an_object_of_the_drive(make_rig: RigFactory, tmp_path: Path) -> None:
    eds = eds_without(tmp_path / "short.eds", "6502", "1005", "6091")
    setup: DriveSetup = make_rig(settings_with({"drive.eds": str(eds)})).set_up()
    assert setup.sync_cob_id == 0x80
