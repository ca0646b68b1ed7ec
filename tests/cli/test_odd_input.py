"""Odd input is answered by one short line and exit code 2, wherever it is given."""

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from commands import command

from canwall.config import ConfigError, load, shipped
from canwall.errors import InputError, one_line

LONG = "x" * 5000
SHORT = 1100
SIM = shipped("config/sim.toml").read_text(encoding="utf-8")


def with_line(section: str, line: str) -> str:
    """The ready configuration with a line in a section, in place of one for the same key."""
    key = line.partition(" = ")[0]
    text = re.sub(rf"(?m)^{re.escape(key)} = .*\n", "", SIM)
    changed = re.sub(rf"(?m)^\[{section}\].*\n", lambda found: f"{found[0]}{line}\n", text, count=1)
    assert changed != text
    return changed


CONFIGURATIONS = {
    "limits.stuck_cycles: has to be greater": with_line("limits", "stuck_cycles = 0"),
    "simulation.stuck_cycles: unknown key": with_line("simulation", "stuck_cycles = 0"),
    "drive.eds: has a NUL character": with_line("drive", r'eds = "a\u0000b"'),
    "simulation.store: has a NUL": with_line("simulation", r'store = "a\u0000b"'),
    "wall.law: has a NUL": with_line("wall", r'law = "a\u0000.py:mine"'),
    "run.more_laws.0: has a NUL": with_line("run", r'more_laws = ["a\u0000.py:mine"]'),
    "drive.eds: no file has a name of": with_line("drive", f'eds = "{LONG}"'),
    "tables or arrays in each other": f"a = {'[' * 5000}{']' * 5000}",
    "a.a.a": f"{'.'.join('a' * 5000)} = 1",
    "limits.hold_cycles: an integer": with_line("limits", f"hold_cycles = 0x{'f' * 5000}"),
    "limits.emergency: has to be 'trip'": with_line("limits", f'emergency = "{LONG}"'),
    "wall.xxx": with_line("wall", f'"{LONG}" = 1'),
    r"wall.a\nb: unknown key": with_line("wall", r'"a\nb" = 1'),
    r"wall.\x1b[31m: unknown key": with_line("wall", r'"\u001b[31m" = 1'),
    "drive.parameters: 'xxx": with_line("drive", f'parameters = {{"{LONG}" = 1}}'),
    "not valid TOML": f"a = {'9' * 5000}",
}


@pytest.mark.parametrize("message", CONFIGURATIONS)
def test_configuration(tmp_path: Path, message: str) -> None:
    file = tmp_path / "c.toml"
    file.write_text(CONFIGURATIONS[message])
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert str(caught.value).startswith(f"{file}: {message}")
    assert len(str(caught.value)) < SHORT
    assert str(caught.value).isprintable()


def test_line_is_short_and_printable() -> None:
    assert one_line("no such file: a b.toml") == "no such file: a b.toml"
    assert one_line("a\nb\0\x1b[2J") == r"a\nb\x00\x1b[2J"
    assert one_line("µN·m: 'x'") == "µN·m: 'x'"
    word = f"'{LONG}'"
    assert len(one_line(f"law: {word}")) == len("law: ") + 250
    assert one_line(f"law: {word}").endswith("x'")
    assert len(str(InputError("a " * 5000))) == 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("run", LONG),
        ("run", "--law", LONG),
        ("run", "--law", f"{LONG}.py:mine"),
        ("run", "--eds", LONG),
        ("run", f"--{LONG}"),
        ("run", "--stiffness", LONG),
        ("drive", LONG),
        ("change", LONG, "stiffness_nm_per_rad=1"),
        ("change", ".", LONG),
        ("plot", LONG),
        ("ball", "--law", LONG),
        ("ball", "--law", f"{LONG}.py:mine"),
        ("ball", "--option", LONG),
        ("ball", "--output", LONG),
        ("sweep", LONG),
        ("sweep", "--law", LONG, "--output", "x.nc"),
        ("sweep", "--stiffness", LONG, "--output", "x.nc"),
        ("doctor", LONG),
        ("latency", LONG),
        ("latency", "--duration", "inf"),
        ("latency", "--output", "", "--load", "0", "--duration", "0.1"),
        ("init", "--rated-torque", "inf"),
        ("init", "--counts", "inf"),
        ("init", "--gear", "inf"),
        ("init", "--inertia", "inf"),
        ("identify", "--inertia", "inf"),
        ("identify", "--output", ""),
        ("study", "staircase", "--seconds", "inf"),
        (LONG,),
    ],
    ids=lambda arguments: " ".join(a[:12] for a in arguments),
)
def test_command(tmp_path: Path, arguments: Sequence[str]) -> None:
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("canwall: ")
    assert len(line) < SHORT
