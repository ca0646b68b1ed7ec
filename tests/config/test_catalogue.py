"""Configurations by name, wherever one works."""

from pathlib import Path

import pytest

from canwall import config
from canwall.config import ConfigError
from canwall.config.catalogue import located


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_every_shipped_file_has_its_name() -> None:
    files = [*config.shipped("config").rglob("*.toml")]
    assert sorted(config.catalogue()) == sorted(path.stem for path in files)


@pytest.mark.parametrize("name", config.catalogue())
def test_a_name_is_as_good_as_its_path(name: str) -> None:
    path = config.catalogue()[name]
    assert config.load(Path(name)) == config.load(path)


@pytest.mark.parametrize("name", config.catalogue())
def test_a_copy_is_the_same_in_any_folder(name: str, tmp_path: Path) -> None:
    """Except for a vendor's EDS, which is looked for beside the copy."""
    path = config.catalogue()[name]
    copy = tmp_path / "copy.toml"
    copy.write_text(config.portable_text(path))
    settings, copied = config.load(path), config.load(copy)
    if path.parent.name == "drives":
        assert copied.drive.eds == tmp_path / settings.drive.eds.name
    else:
        assert copied.drive.eds == settings.drive.eds
    assert copied.wall == settings.wall
    assert config.title_of(path)


@pytest.mark.parametrize("here", ["epos4", "epos4.toml"])
def test_a_file_of_the_same_name_is_no_guess(here: str, tmp_path: Path) -> None:
    (tmp_path / here).touch()
    with pytest.raises(ConfigError, match=rf"^epos4: may be the file {here} of this folder or "):
        located(Path("epos4"))


def test_paths_stand_for_themselves(tmp_path: Path) -> None:
    (tmp_path / "epos4.toml").touch()
    (tmp_path / "mine").touch()
    for path in ("epos4.toml", "sub/epos4", str(tmp_path / "epos4"), "mine", ".", ".."):
        assert located(Path(path)) == Path(path)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("epos5", "epos5: no such file or configuration; did you mean epos4?"),
        ("xyz", "xyz: no such file or configuration; `canwall config` lists the names"),
    ],
)
def test_unknown_name(name: str, line: str) -> None:
    with pytest.raises(ConfigError) as raised:
        config.load(Path(name))
    assert str(raised.value) == line
