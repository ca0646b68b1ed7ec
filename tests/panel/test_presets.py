"""Presets in a file: kept whole, refused where they are damaged."""

from pathlib import Path

import pytest

from canwall.config import ConfigError, WallChange
from canwall.panel.messages import validated
from canwall.panel.presets import Presets, default_path

SOFT = WallChange(stiffness_nm_per_rad=5.0, damping_ratio=0.5)
STIFF = WallChange(law="mean_force", options={"share": 0.5}, tension="clamp")


def test_presets_are_there_for_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "new" / "presets.toml"
    Presets(path).save("soft", SOFT)
    Presets(path).save('stiff "é" .x', STIFF)
    assert Presets(path).all() == {"soft": SOFT, 'stiff "é" .x': STIFF}
    Presets(path).save("soft", STIFF)
    Presets(path).remove('stiff "é" .x')
    assert Presets(path).all() == {"soft": STIFF}
    assert [file.name for file in path.parent.iterdir()] == ["presets.toml"]
    with pytest.raises(ConfigError, match="sofd: no preset of this name; did you mean soft"):
        Presets(path).get("sofd")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"[soft", "not valid TOML"),
        (b"\xff", "not valid TOML"),
        (b"soft = 1", "preset soft: has to be a table, not 1"),
        (b"[soft]\nstiffness = 1", "preset soft: stiffness: unknown key"),
        (b"[soft]\nstiffness_nm_per_rad = -1", "has to be"),
        (b'[soft]\nlaw = "\\u0000"', "NUL"),
        (b"a = " + b"[" * 5000, "presets.toml"),
    ],
)
def test_a_damaged_file_is_one_line_and_left_alone(
    tmp_path: Path, content: bytes, says: str
) -> None:
    path = tmp_path / "presets.toml"
    path.write_bytes(content)
    for use in (Presets(path).all, lambda: Presets(path).save("new", SOFT)):
        with pytest.raises(ConfigError) as raised:
            use()
        assert says in str(raised.value)
        assert str(path) in str(raised.value)
    assert path.read_bytes() == content


def test_names_and_folders_that_cannot_be(tmp_path: Path) -> None:
    for name in ("", " a", "a\n", "a" * 61):
        with pytest.raises(ConfigError, match="has to have 1 to 60 letters"):
            Presets(tmp_path / "p.toml").save(name, SOFT)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be"):
        Presets(tmp_path / "file" / "p.toml").save("a", SOFT)


def test_a_request_without_a_name() -> None:
    with pytest.raises(ConfigError, match="name: has to be a text that is not empty, not ''"):
        validated({"do": "preset_save", "name": ""})


def test_the_users_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert default_path() == tmp_path / "canwall" / "presets.toml"
