"""The draft of `canwall init` is TOML, and asks for no more than the drive gives."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import pytest
from rig import RigFactory, settings_with

from canwall import config
from canwall.bench.draft import DriveFacts, draft, read_drive
from canwall.config import Settings, with_overrides

VENDORS = Path(__file__).parents[3] / "shared" / "vendor-eds"


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


def vendor_settings(name: str, changes: dict[str, Any]) -> Settings:
    path = config.catalogue()[name]
    eds = VENDORS / config.load(path).drive.eds.name
    if not eds.is_file():
        pytest.skip(f"{VENDORS} has no {eds.name}")
    handle = {"simulation.hand.rest_rad": 2.0}
    return with_overrides(config.load(path, {"drive.eds": eds}), handle | changes)


@pytest.mark.parametrize("counts", [None, 131072.0])
def test_position_in_the_unit_that_the_drive_still_has(
    make_rig: RigFactory, counts: float | None
) -> None:
    """C5-E: 0x6064 in tenths of a degree, and in increments once its parameters are written."""
    rig = make_rig(vendor_settings("nanotec", {"drive.counts_per_rev": counts}))
    facts = read_drive(rig.link, rig.settings.drive)
    assert facts.position_rad == pytest.approx(2.0, abs=2e-3)
    assert facts.scales.units.counts_per_rev == 131072.0


def test_torque_limit_as_the_parameters_have_it(make_rig: RigFactory) -> None:
    """EVE-NET: 0x6073 is 40 per mille until its parameters are written."""
    rig = make_rig(vendor_settings("ingenia", {}))
    facts = read_drive(rig.link, rig.settings.drive)
    assert facts.scales.torque_limit_nm == pytest.approx(3.0)
