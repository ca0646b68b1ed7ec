"""The commands: what they say, with which exit code, and that bad input touches nothing."""

import contextlib
import importlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from can.interfaces.virtual import VirtualBus
from commands import COMMAND, call, command, config_file
from rig import eds_without

from canwall import cli, config
from canwall.errors import InputError, RunFailedError

UNIXCAN_CONFIG = config.shipped("config/unixcan.toml")
EDS = '"../eds/canwall-drive.eds"'


#: An embedded drive is on python-can's virtual bus, where a test can listen.
ON_VIRTUAL_BUS = {'exchange = "auto" ': 'exchange = "python-can" '}


@pytest.fixture
def listener() -> Iterator[VirtualBus]:
    """On the embedded bus from the beginning: what anybody sends can be heard."""
    with VirtualBus("canwall") as bus:
        yield bus


class Said:
    """Exit code and output of one command."""

    def __init__(self, code: object, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    @property
    def line(self) -> str:
        """The one line on stderr, without the name of the program."""
        (line,) = self.err.splitlines()
        assert line.startswith("canwall: ")
        return line.removeprefix("canwall: ")


@pytest.fixture
def say(capfd: pytest.CaptureFixture[str]) -> "Say":
    return Say(capfd)


class Say:
    """Runs a command in this process."""

    def __init__(self, capfd: pytest.CaptureFixture[str]) -> None:
        self._capfd = capfd

    def __call__(self, *arguments: object) -> Said:
        return Said(call(*arguments), *self._capfd.readouterr())


# Usage


def test_help_shows_units_and_keys(say: Say) -> None:
    ball, change = say("ball", "--help").out, say("change", "--help").out
    assert all(unit in ball for unit in ("[N/m]", "[kg]", "[m/s²]", "[s]"))
    assert "[[schedule]]" in change


def test_no_command_shows_the_help() -> None:
    done = command()
    for name in ("run", "drive", "plot"):
        assert name in done.stdout
    assert (done.returncode, done.stderr) == (2, "")


def test_help() -> None:
    done = command("--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "Render the wall" in done.stdout


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("run", ["CONFIG", "--law", "--stiffness", "--damping", "--duration", "--output"]),
        ("drive", ["CONFIG"]),
        ("plot", ["DIR|FILE.nc"]),
    ],
)
def test_help_of_a_command(say: Say, name: str, words: list[str]) -> None:
    said = say(name, "--help")
    assert (said.code, said.err) == (0, "")
    assert all(word in said.out for word in words)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--colour"], "No such option: --colour"),
        (["run", "--stifness", "3"], "No such option: --stifness; did you mean --stiffness?"),
        (["walk"], "No such command 'walk'"),
        (["run", "--stiffness", "soft"], "Invalid value for '--stiffness'"),
        (["drive", "one.toml", "two.toml"], "Got unexpected extra argument"),
        (["run", "one.toml", "two.toml"], "one.toml: no such file"),
        (["plot"], "Missing argument 'DIR|FILE.nc'"),
    ],
)
def test_bad_usage(say: Say, arguments: list[str], line: str) -> None:
    said = say(*arguments)
    assert said.code == 2
    assert said.out == ""
    assert said.line.startswith(line)


# Bad input


def bad_toml(path: Path) -> Path:
    path.write_text("[bus\n")
    return path


def bad_eds(path: Path) -> Path:
    path.write_bytes(b"\x94 not an EDS")
    return path


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"cycle_s = 0.001": "cycle_s = 0"}, "bus.cycle_s: has to be greater than 0"),
        ({"node_id = 5": "node_id = 200"}, "drive.node_id: has to be less than or equal to 127"),
        ({'law = "mean_force"         #': 'law = "none" #'}, "wall.law: unknown law 'none'"),
        ({"stiffness_nm_per_rad = 50.0": "stifness = 50.0"}, "wall.stifness: unknown key"),
        ({"duration_s = 4.2": "duration_s = -1"}, "run.duration_s: has to be greater than 0"),
        ({'interface = "virtual"': 'interface = "none"'}, "bus.interface = 'none'"),
        (
            {'interface = "virtual"': 'interface = "socketcan"', '"canwall"': '"can-none"'},
            "bus.interface = 'socketcan', bus.channel = 'can-none'",
        ),
        (
            {'interface = "virtual"': 'interface = "unixcan"', '"canwall"': '"/none/bus"'},
            "bus.interface = 'unixcan', bus.channel = '/none/bus'",
        ),
        ({EDS: '"none.eds"'}, "none.eds: no such EDS or DCF"),
        ({EDS: '"bad.eds"'}, "bad.eds: "),
        ({EDS: '"no6064.eds"'}, "no6064.eds: lacks object 0x6064"),
        ({EDS: '"no6077.eds"'}, "no6077.eds: object 0x6077"),
    ],
)
def test_bad_configuration(
    say: Say, listener: VirtualBus, tmp_path: Path, changes: dict[str, str], line: str
) -> None:
    bad_eds(tmp_path / "bad.eds")
    eds_without(tmp_path / "no6064.eds", "6064")
    eds_without(tmp_path / "no6077.eds", "6077")
    file = config_file(tmp_path / "config.toml", ON_VIRTUAL_BUS | changes)
    said = say("run", file, "--output", tmp_path / "run")
    assert said.code == 2
    assert line in said.line
    assert said.out == ""
    assert not (tmp_path / "run").exists()
    assert nothing_but_boot_up(listener)


def nothing_but_boot_up(listener: VirtualBus) -> bool:
    heard = []
    while (frame := listener.recv(0)) is not None:
        heard.append(frame.arbitration_id)
    return set(heard) <= {0x705}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["none.toml"], "none.toml: no such file"),
        (["."], "cannot be read: Is a directory"),
        (["bad.toml"], "bad.toml: not valid TOML"),
        (["--law", "none"], "wall.law: unknown law 'none'; known are standard"),
        (["--law", "none.py:none"], "none.py"),
        (["--stiffness", "-1"], "wall.stiffness_nm_per_rad: has to be greater than or equal to 0"),
        (["--duration", "0"], "run.duration_s: has to be greater than 0"),
        (["--output", ""], "Invalid value for '--output': is empty; give a folder"),
        (["--output", "bad.toml"], "bad.toml: cannot be written"),
        (["--output", "taken"], "taken: holds signals.parquet already; choose another --output"),
    ],
)
def test_bad_arguments(
    say: Say,
    listener: VirtualBus,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    line: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    bad_toml(tmp_path / "bad.toml")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "signals.parquet").touch()
    if arguments[0].startswith("--"):
        arguments = [str(config_file(tmp_path / "c.toml", ON_VIRTUAL_BUS)), *arguments]
    before = sorted(tmp_path.rglob("*"))
    said = say("run", *arguments)
    assert said.code == 2
    assert line in said.line
    assert said.out == ""
    assert sorted(tmp_path.rglob("*")) == before
    assert nothing_but_boot_up(listener)


@pytest.mark.slow
def test_bad_input_in_a_process_of_its_own(tmp_path: Path) -> None:
    done = command("run", "--law", "none", "--output", tmp_path / "run")
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("canwall: wall.law: unknown law 'none'")


def test_bus_of_another_process_hears_nothing_of_bad_input(say: Say, tmp_path: Path) -> None:
    channel = tmp_path / "bus"
    changes = {"/tmp/canwall.sock": str(channel), 'law = "mean_force"': 'law = "none"'}
    file = config_file(tmp_path / "c.toml", changes, UNIXCAN_CONFIG)
    with can.Bus(interface="unixcan", channel=str(channel)) as bus:
        assert say("run", file, "--output", tmp_path / "run").code == 2
        assert bus.recv(0) is None


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({}, "bus.interface = 'virtual' ends at this process"),
        ({'"virtual"': '"unixcan"', '"canwall"': '"/none/bus"'}, "bus.channel = '/none/bus'"),
        ({'"virtual"': '"unixcan"', EDS: '"none.eds"'}, "none.eds: "),
    ],
)
def test_drive_with_bad_input(say: Say, tmp_path: Path, changes: dict[str, str], line: str) -> None:
    file = config_file(tmp_path / "config.toml", changes)
    said = say("drive", file)
    assert said.code == 2
    assert line in said.line


def test_drive_that_nothing_describes(say: Say, tmp_path: Path) -> None:
    file = config_file(tmp_path / "config.toml", {'"virtual"': '"unixcan"'})
    text = file.read_text()
    first, last = text.index("\n[simulation]"), text.index("\n[[schedule]]")
    file.write_text(text[:first] + text[last:])
    said = say("drive", file)
    assert said.code == 2
    assert said.line == "[simulation] is missing: there is no drive to simulate"


# Failures while it runs


@pytest.mark.parametrize(
    ("error", "code", "err"),
    [
        (RunFailedError("the drive is gone"), 1, "canwall: the drive is gone\n"),
        (can.CanOperationError("bus off"), 1, "canwall: bus off\n"),
        (KeyboardInterrupt(), 130, "canwall: interrupted\n"),
    ],
)
def test_exit_codes(
    say: Say, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, err: str
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise error

    monkeypatch.setattr(importlib.import_module("canwall.run"), "run_together", fail)
    said = say("run")
    assert (said.code, said.err) == (code, err)


@pytest.mark.parametrize("error", [RunFailedError("gone"), InputError("gone")])
def test_what_is_not_in_order_after_an_error_is_told(
    say: Say, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    error.add_note("not restored")

    def fail(*args: object, **kwargs: object) -> None:
        raise error

    monkeypatch.setattr(importlib.import_module("canwall.run"), "run_together", fail)
    said = say("run")
    assert (said.code, said.err) == (1, "canwall: gone\ncanwall: not restored\n")


def test_what_is_wrong_in_a_program_is_not_hidden(
    say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(importlib.import_module("canwall.run"), "run_together", fail)
    with pytest.raises(ZeroDivisionError):
        cli.guarded(lambda: cli.app(["run"], standalone_mode=False))


# Progress


def on_a_terminal(*arguments: object) -> str:
    """Return what a command writes to stderr when that is a terminal."""
    ours, theirs = os.openpty()
    with subprocess.Popen(
        [COMMAND, *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=theirs,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
    ):
        os.close(theirs)
        written = b""
        with contextlib.suppress(OSError):  # the end of a terminal
            while part := os.read(ours, 4096):
                written += part
    os.close(ours)
    return written.decode()


@pytest.mark.slow
def test_progress_is_shown_on_a_terminal(tmp_path: Path) -> None:
    written = on_a_terminal("run", "--duration", 0.3, "--output", tmp_path / "run")
    assert "drawing" in written
    assert "of 0.3 s" in written


@pytest.mark.slow
def test_progress_makes_room_for_an_error(tmp_path: Path) -> None:
    written = on_a_terminal("run", "--law", "none", "--output", tmp_path / "run")
    erase_line = "\x1b[2K"
    assert "preparing" in written
    assert "preparing" not in written[written.rindex(erase_line) :]
    assert "canwall: wall.law: unknown law 'none'" in written[written.rindex(erase_line) :]
