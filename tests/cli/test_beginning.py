"""`scan`, `init` and `config`: from a simulated drive on a bus to its first configuration."""

import json
from pathlib import Path

import pytest
from commands import COMMAND, Start, call, command

from canwall import cli, config
from canwall.bench.soft_wall import soft_stiffness

OWN_EDS = config.shipped("eds/canwall-drive.eds")
#: A cycle that a busy machine holds.
PATIENT = ("--cycle", "0.004")


def vendor_file(name: str) -> Path:
    path = Path(__file__).parents[3] / "shared" / "vendor-eds" / name
    if not path.is_file():
        pytest.skip(f"{path.parent} has no {name}")
    return path


@pytest.fixture
def channel(tmp_path: Path) -> Path:
    return tmp_path / "can.sock"


@pytest.fixture
def bus_of(channel: Path) -> list[object]:
    return ["--interface", "unixcan", "--channel", channel]


def serve(start: Start, tmp_path: Path, channel: Path, name: str = "unixcan") -> None:
    """A simulated drive on the bus."""
    path = tmp_path / "drive.toml"
    text = config.portable_text(config.catalogue()[name])
    eds = config.load(Path(name)).drive.eds.name
    changes = {
        'interface = "virtual"': 'interface = "unixcan"',
        'channel = "canwall"': f'channel = "{channel}"',
        'channel = "/tmp/canwall.sock"': f'channel = "{channel}"',
    }
    if name != "unixcan":
        changes[f'eds = "{eds}"'] = f'eds = "{vendor_file(eds)}"'
    for old, new in changes.items():
        text = text.replace(old, new)
    path.write_text(text)
    drive = start(COMMAND, "drive", path)
    assert drive.stdout is not None
    assert drive.stdout.readline().startswith("simulated drive, node 5")


@pytest.mark.slow
def test_from_the_bus_to_the_first_wall(
    start: Start, tmp_path: Path, channel: Path, bus_of: list[object]
) -> None:
    """scan → init → run, in a folder of one's own."""
    serve(start, tmp_path, channel)
    done = command("scan", *bus_of, "--json")
    assert done.returncode == 0, done.stderr
    (node,) = json.loads(done.stdout)
    assert (node["node_id"], node["device_type"], node["drive"]) == (5, 0x20192, True)
    assert (node["nmt_state"], node["drive_state"]) == ("PRE-OPERATIONAL", "SWITCH ON DISABLED")
    done = command("scan", *bus_of)
    assert "PRE-OPERATIONAL" in done.stdout
    done = command("init", "--drive", OWN_EDS, *bus_of, *PATIENT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    file = tmp_path / "bench.toml"
    settings = config.load(file)
    assert settings.drive.node_id == 5
    assert settings.wall.stiffness_nm_per_rad == soft_stiffness(1e-4, 0.0, 0.004)
    assert settings.limits.torque_nm == 0.063
    # The handle rests at 0.1 rad.
    assert (settings.wall.position_rad, settings.limits.position_rad) == (0.0, (-0.9, 1.1))
    assert (settings.schedule, settings.simulation) == ((), None)
    before = file.read_bytes()
    done = command("init", "--drive", OWN_EDS, *bus_of, cwd=tmp_path)
    assert (done.returncode, file.read_bytes()) == (2, before)
    assert "bench.toml: exists; give --force" in done.stderr
    # The same wall in simulated time, in which a busy machine may take its own.
    text = file.read_text().replace('interface = "unixcan"', 'interface = "virtual"')
    file.write_text(f"{text}\n[simulation]\n")
    done = command("run", "bench.toml", "--duration", "1", "--output", "run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_drive_by_its_name(
    start: Start, tmp_path: Path, channel: Path, bus_of: list[object]
) -> None:
    """What the vendor's file has of the drive is taken over; what nobody knows is asked for."""
    serve(start, tmp_path, channel, "epos4")
    eds = vendor_file("maxon_epos4_0x1018.eds")
    output = tmp_path / "epos4-bench.toml"
    words = ["init", "--drive", "epos4", "--eds", eds, "--node", "5", *bus_of, "--output", output]
    done = command(*words)
    assert done.returncode == 2
    assert done.stderr == (
        "canwall: --counts is missing: increments of 0x6064 per turn of the motor\n"
    )
    assert not output.exists()
    done = command(*words, "--counts", 131072)
    assert done.returncode == 0, done.stderr
    settings = config.load(output)
    assert settings.drive.rated_torque_unit_nm == 1e-6
    assert settings.limits.torque_nm == 0.063
    assert "maxon EPOS4" in output.read_text()


def refused(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line with which a command refuses its arguments."""
    code = call(*arguments)
    out, err = capfd.readouterr()
    assert (code, out) == (2, "")
    (line,) = err.splitlines()
    return line.removeprefix("canwall: ")


BUS = ("--interface", "virtual", "--channel", "nobody")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["scan"], "--interface is missing: interface (socketcan, pcan, kvaser, unixcan)"),
        (["scan", "--interface", "unixcan"], "--channel is missing: channel (can0; of unixcan"),
        (["scan", "epos5"], "epos5: no such file or configuration; did you mean epos4?"),
        (["init", *BUS], "--drive is missing: drive (a name of `canwall config`, or the path"),
        (["init", "--drive", "epos4", *BUS], "--drive epos4: its file maxon_epos4_0x1018.eds is "),
        (["init", "--drive", "epos5", *BUS], "--drive epos5: neither an EDS nor one of ideal, "),
        (["init", "--drive", "sim", "--eds", "none.eds", *BUS], "--eds none.eds: no such EDS or"),
        (["init", "--drive", "sim", *BUS], "no node answers: are drive and bus on, and at this "),
        (["config", "epos5"], "epos5: no configuration of this name; did you mean epos4?"),
        (["config", "--output", "x.toml"], "--output needs the NAME of a configuration; `canwall"),
    ],
)
def test_what_is_missing(
    arguments: list[str], line: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert refused(capfd, *arguments).startswith(line)


def test_nothing_is_overwritten(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("mine")
    for arguments in (["config", "sim"], ["init", "--drive", "sim", *BUS]):
        line = refused(capfd, *arguments, "--output", file)
        assert line == f"{file}: exists; give --force to overwrite it, or another --output"
    assert file.read_text() == "mine"


def test_file_that_cannot_be_written(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "nowhere" / "mine.toml"
    assert refused(capfd, "config", "sim", "--output", file) == (
        f"{file}: cannot be written: No such file or directory; choose another --output"
    )


def test_config_prints_what_runs(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.app(["config", "sim"])
    text = capfd.readouterr().out
    assert config.parse(text, tmp_path / "any.toml") == config.load(Path("sim"))
