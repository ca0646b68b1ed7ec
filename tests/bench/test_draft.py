"""The draft of `canwall init` is TOML, whatever a drive needs."""

import tomllib
from pathlib import Path

from rig import RigFactory, settings_with

from canwall.bench.draft import DriveFacts, draft


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
