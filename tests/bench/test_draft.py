"""The draft of `canwall init` is TOML, and asks for no more than the drive gives."""

import dataclasses
import tomllib
from pathlib import Path

import pytest
from rig import RigFactory, settings_with

from canwall.bench.draft import DriveFacts, draft, read_drive


def test_negative_parameters(make_rig: RigFactory, tmp_path: Path) -> None:
    setup = make_rig().set_up()
    assert setup.identity
    assert setup.scales
    parameters = {"0x607C": -5, "0x6085": 1000}
    settings = settings_with()
    drive = settings.drive.model_copy(update={"parameters": parameters})
    facts = DriveFacts(setup.identity, setup.scales, 0.0)
    text = draft(settings.bus, drive, facts, "A drive", 1e-4, tmp_path / "first.toml")
    assert tomllib.loads(text)["drive"]["parameters"] == parameters


def test_no_more_torque_than_the_drive_gives(make_rig: RigFactory, tmp_path: Path) -> None:
    setup = make_rig().set_up()
    assert setup.identity
    assert setup.scales
    scales = dataclasses.replace(setup.scales, torque_limit_nm=0.0257)
    settings = settings_with()
    facts = DriveFacts(setup.identity, scales, 0.0)
    text = draft(settings.bus, settings.drive, facts, "A drive", 1e-4, tmp_path / "first.toml")
    assert tomllib.loads(text)["limits"]["torque_nm"] == 0.025
    assert "# all that the drive gives" in text


def test_gear_of_any_ratio(make_rig: RigFactory) -> None:
    """There is no limit of the torque yet that the rated torque would have to suit."""
    rig = make_rig()
    drive = rig.settings.drive.model_copy(update={"gear_ratio": 160.0})
    assert read_drive(rig.link, drive).rated_torque_nm == pytest.approx(160.0 * 0.637)
