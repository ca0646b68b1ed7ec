"""The DBC of a bus: what cantools decodes of a recorded run by it is what the record has."""

from pathlib import Path

import cantools
import numpy as np
import pytest
from commands import Record, command
from rig import SIM_CONFIG, RigFactory

from canwall.bench.dbc import MappedDrive, dbc_text


@pytest.fixture(scope="session")
def dbc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dbc") / "bus.dbc"
    done = command("dbc", SIM_CONFIG, "--output", path)
    assert (done.returncode, done.stderr) == (0, "")
    return path


@pytest.mark.slow
def test_decodes_a_recorded_run(dbc: Path, four_strikes: Record) -> None:
    database = cantools.database.load_file(dbc)
    decoded: dict[str, list[dict[str, float]]] = {}
    for frame in four_strikes.frames:
        if frame.arbitration_id in (0x185, 0x205):
            message = database.get_message_by_frame_id(frame.arbitration_id)
            decoded.setdefault(message.name, []).append(message.decode(bytes(frame.data)))
    tpdos, rpdos = decoded["Drive5_TPDO1"], decoded["Drive5_RPDO1"]

    def column(frames: list[dict[str, float]], name: str) -> list[float]:
        return [frame[name] for frame in frames]

    received = four_strikes.column("received").astype(bool)
    assert column(tpdos, "Statusword") == four_strikes.column("statusword")[received].tolist()
    for name, recorded, tolerance in (
        ("Position_actual_value", "position_rad", 1e-9),
        ("Torque_actual_value", "torque_actual", 1e-9),
    ):
        expected = four_strikes.column(recorded)[received]
        np.testing.assert_allclose(column(tpdos, name), expected, rtol=0.0, atol=tolerance)
    rows = four_strikes.signals.num_rows
    words = four_strikes.column("controlword").tolist()
    assert column(rpdos, "Controlword")[-rows:] == words
    torques = four_strikes.column("torque_cmd")
    np.testing.assert_allclose(column(rpdos, "Target_torque")[-rows:], torques, atol=1e-9)


@pytest.mark.slow
def test_names_units_and_the_rest_of_the_bus(dbc: Path) -> None:
    database = cantools.database.load_file(dbc)
    assert database.get_message_by_frame_id(0x080).name == "SYNC"
    position = database.get_message_by_name("Drive5_TPDO1").get_signal_by_name(
        "Position_actual_value"
    )
    assert (position.unit, position.comment) == ("rad", "0x6064:00")
    assert position.scale == pytest.approx(2.0 * np.pi / 131072)
    torque = database.get_message_by_name("Drive5_RPDO1").get_signal_by_name("Target_torque")
    assert (torque.unit, torque.is_signed) == ("Nm", True)
    emcy = database.get_message_by_frame_id(0x085).decode(bytes.fromhex("2023054203000000"))
    assert emcy["Error_code"] == 0x2320
    heartbeat = database.get_message_by_frame_id(0x705).decode(b"\x05")
    assert heartbeat["NMT_state"] == "Operational"
    assert max(len(signal.name) for m in database.messages for signal in m.signals) <= 32


@pytest.mark.slow
def test_file_that_cannot_be_written(tmp_path: Path) -> None:
    done = command("dbc", SIM_CONFIG, "--output", tmp_path / "none" / "bus.dbc")
    assert done.returncode == 2
    assert done.stderr.endswith("none/bus.dbc: cannot be written: No such file or directory\n")


@pytest.mark.slow
def test_drives_that_cannot_be_on_one_bus(tmp_path: Path) -> None:
    done = command("dbc", SIM_CONFIG, SIM_CONFIG, "--output", tmp_path / "bus.dbc")
    assert done.returncode == 2
    assert done.stderr == "canwall: drive.node_id: [5, 5]: every drive needs one of its own\n"


def test_objects_of_one_name_are_told_apart(make_rig: RigFactory) -> None:
    rig = make_rig()
    setup, dictionary = rig.set_up(), rig.node.dictionary
    for field in setup.tpdo.fields:
        dictionary[field.index].name = "Actual value"
    text = dbc_text([MappedDrive(5, dictionary, setup, ())])
    signals = cantools.database.load_string(text).get_message_by_name("Drive5_TPDO1").signals
    _, *others = setup.tpdo.fields
    assert sorted(signal.name for signal in signals) == sorted(
        ["Actual_value", *(f"Actual_value_{field.index:04X}_00" for field in others)]
    )
