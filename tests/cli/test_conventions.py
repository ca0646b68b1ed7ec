"""What programs of the command line have in common: help, version, completion, JSON, spelling."""

import io
import json
import os
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import typer
import xarray as xr
from commands import COMMAND, PATIENCE_S, Record, call, command, config_file
from rich.table import Table
from typer.core import TyperGroup

from canwall import cli, config
from canwall.cli.completion import law_names
from canwall.cli.output import _LastingConsole, print_json, print_text, say
from canwall.cli.run import _strike_table
from canwall.errors import did_you_mean
from canwall.sweep import read_sweep
from canwall.walls import LAWS

ROOT = Path(__file__).parents[2]
PROGRAM: Any = typer.main.get_command(cli.app)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> "Run":
    return Run(capfd, monkeypatch)


class Run:
    """Runs a command in this process: exit code, standard output, standard error."""

    def __init__(self, capfd: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch) -> None:
        self._capfd, self._patch = capfd, patch

    def __call__(self, *arguments: object) -> tuple[object, str, str]:
        # The name of the program is not that of the one that runs the tests.
        self._patch.setattr(sys.modules["__main__"], "__package__", None, raising=False)
        return (call(*arguments), *self._capfd.readouterr())


# Help, version


def test_version(run: Run) -> None:
    assert run("--version") == (0, f"canwall {version('canwall')}\n", "")


@pytest.mark.parametrize("name", [*PROGRAM.commands, ""])
def test_short_and_long_help(run: Run, name: str) -> None:
    short, long = (run(*filter(None, (name, option))) for option in ("-h", "--help"))
    assert short == long
    assert (short[0], short[2]) == (0, "")
    assert "Usage: canwall" in short[1]


@pytest.mark.slow
def test_as_a_module() -> None:
    words = [sys.executable, "-m", "canwall", "--version"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stdout) == (0, f"canwall {version('canwall')}\n")


#: Interrupts the process as a module is looked for.
INTERRUPTING = """\
import os, signal, sys

class Interrupt:
    def find_spec(name, *more):
        if name == os.environ["INTERRUPTED_AT"]:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt)
"""


@pytest.mark.slow
@pytest.mark.parametrize("at", ["canwall.cli", "typer", "canwall.supervised", "canwall.config"])
@pytest.mark.parametrize("start", [("-m", "canwall"), ("-c", "import sys; sys.exit(main())")])
def test_ctrl_c_during_the_start(tmp_path: Path, start: tuple[str, str], at: str) -> None:
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTING)
    option, program = start
    if option == "-c":  # as the script that is installed
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        module, function = project["scripts"]["canwall"].split(":")
        program = f"from {module} import {function}\n{program}"
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, option, program, "run"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path, "INTERRUPTED_AT": at},
        timeout=PATIENCE_S,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "canwall: interrupted\n")


def test_ctrl_c_before_there_is_a_command(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(TyperGroup, "make_context", interrupted)
    assert run("run") == (130, "", "canwall: interrupted\n")


@pytest.mark.slow
@pytest.mark.parametrize(("given", "threads"), [({}, 1), ({"OMP_NUM_THREADS": "2"}, 2)])
def test_blas_has_one_thread_unless_another_number_is_asked_for(
    given: dict[str, str], threads: int
) -> None:
    program = (
        "import canwall.cli, canwall.identify\nfrom threadpoolctl import threadpool_info\n"
        "print({p['num_threads'] for p in threadpool_info() if p['user_api'] == 'blas'})"
    )
    others = {name: value for name, value in os.environ.items() if not name.endswith("_THREADS")}
    words, environment = [sys.executable, "-c", program], others | given
    done = subprocess.run(words, capture_output=True, text=True, env=environment, check=True)
    assert done.stdout == f"{{{min(threads, len(os.sched_getaffinity(0)))}}}\n"


# Completion


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("canwall sw", ["sweep"]),
        ("canwall study st", ["staircase"]),
        ("canwall run --stif", ["--stiffness"]),
        ("canwall run --law half", ["half_sample", "half_sample+deadbeat"]),
        ("canwall sweep --law mean", ["mean_force"]),
        ("canwall ball --law rig", ["rigid"]),
        ("canwall run epo", ["epos4"]),
        ("canwall doctor mine", ["mine.toml"]),
        ("canwall run none/of", []),  # the shell offers files
    ],
)
def test_completion(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, line: str, offered: list[str]
) -> None:
    (tmp_path / "mine.toml").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_CANWALL_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(line.count(" ")))
    code, out, error = run()
    assert (code, error) == (0, "")
    assert out.split() == offered


def test_all_laws_are_completed() -> None:
    assert sorted(law_names()) == sorted(LAWS)


# Spelling


def test_closest_name() -> None:
    assert did_you_mean("half_smaple", LAWS) == "; did you mean half_sample?"
    assert did_you_mean("qqq", LAWS) == ""


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["swep"], "'sweep'"),
        (["run", "--stifness", "3"], "--stiffness"),
        (["run", "--law", "meanforce"], "mean_force"),
        (["ball", "--law", "rigd", "--output", "x.csv"], "rigid"),
        (["ball", "--law", "rigid", "--tension", "clmp", "--output", "x.csv"], "clamp"),
        (["ball", "--law", "exponential", "--option", "lenth=1", "--output", "x.csv"], "length"),
        (["sweep", "--axis", "sped=1", "--output", "x.nc"], "speed"),
        (["sweep", "--axis", "limits.torqe_nm=1", "--output", "x.nc"], "torque_nm"),
        (["sweep", "--operator", "fingr", "--output", "x.nc"], "finger"),
        (["sweep", "--axis", "servo=800hz", "--output", "x.nc"], "800Hz"),
        (["sweep", "--table", "shft"], "shaft"),
    ],
    ids=lambda given: " ".join(given) if isinstance(given, list) else "",
)
def test_misspelt_word_of_a_command(run: Run, arguments: list[str], meant: str) -> None:
    code, out, error = run(*arguments)
    (line,) = error.splitlines()
    assert (code, out) == (2, "")
    assert line.lower().replace("\u2019", "'").endswith(f"did you mean {meant}?".lower())


@pytest.mark.parametrize(
    ("line", "other", "meant"),
    [
        ("\n[simulation]", '\n[[simulation.fault]]\nkind = "silense"\n[simulation]', "silence"),
        (
            "\n[simulation.hand]",
            '\n[[simulation.hand.script]]\nmove = "aproach"\nduration_s = 1.0\n[simulation.hand]',
            "approach",
        ),
        ('interface = "virtual"', 'interface = "soketcan"', "socketcan"),
        ('law = "mean_force"         #', 'law = "mean_forse" #', "mean_force"),
    ],
)
def test_misspelt_word_of_a_configuration(
    run: Run, tmp_path: Path, line: str, other: str, meant: str
) -> None:
    file = config_file(tmp_path / "c.toml", {line: other})
    code, _, error = run("run", file, "--output", tmp_path / "run")
    assert code == 2
    assert error.endswith(f"; did you mean {meant}?\n")


# Output


def strike(law: str) -> dict[str, Any]:
    """A strike with all columns, as wide as they come."""
    return {
        **{"law": law, "stiffness": 1250.0, "mass_spread": 0.1, "contacts": 126},
        **{"stiffness_in_force": 39.54, "stiffness_in_force_least": 20.0, "mass_est_kg_m2": 2e-4},
        **{"peak_penetration_rad": 0.12345, "first_depth_rad": 0.1, "energy_out_j": 2.80556},
        **{"referent_first_depth_rad": 0.09, "felt_ripple_n": 8.44},
        **{"chatter": True, "chatter_frequency_hz": 143.0},
    }


def test_strikes_fit_into_80_columns() -> None:
    path = "/home/somebody/haptics/laws/experimental.py:a_wall_with_quite_a_long_name"
    written = io.StringIO()
    console = _LastingConsole(file=written, width=80)
    console.print(_strike_table([strike("unidirectional_damper"), strike(path)]))
    text = written.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    for value in ("1250", "39.5", "0.2", "126", "123.45", "1.11", "2805.56", "8.44", "143 Hz"):
        assert text.count(value) >= 2, value
    # The file and the function, in pieces; not the folder.
    folded = "".join(line[2:14].strip() for line in text.splitlines()[4:])
    assert "experimental.py:a_wall_with_quite_a_long_name" in folded
    assert "somebody" not in text


@pytest.mark.parametrize("no_color", [True, False])
def test_no_color(monkeypatch: pytest.MonkeyPatch, no_color: bool) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    if no_color:
        monkeypatch.setenv("NO_COLOR", "1")
    table = Table("column")
    table.add_row("in trouble", style="bold red")
    written = io.StringIO()
    _LastingConsole(file=written, force_terminal=True).print(table)
    assert ("31m" in written.getvalue()) is not no_color


def test_names_are_printed_as_they_are(capfd: pytest.CaptureFixture[str]) -> None:
    name = "[b]:x:"
    say(f"law {name}: no such file")
    print_text(name)
    assert capfd.readouterr() == (f"{name}\n", f"canwall: law {name}: no such file\n")
    written = io.StringIO()
    console = _LastingConsole(file=written, width=80)
    console.print(f"record: runs/{name}")
    console.print(_strike_table([strike(name)]))
    assert written.getvalue().count(name) == 2
    assert "[mrad]" in written.getvalue()


def test_json_has_what_json_allows(capfd: pytest.CaptureFixture[str]) -> None:
    content = {"a": float("nan"), "b": [1.0, float("inf")], "p": Path("x/:car:"), "c": "[red]µ"}
    print_json(content | {"l": "x" * 300})
    (line,) = capfd.readouterr().out.splitlines()
    assert json.loads(line) == {
        **{"a": None, "b": [1.0, None], "p": "x/:car:", "c": "[red]µ", "l": "x" * 300}
    }


@pytest.mark.slow
@pytest.mark.parametrize("words", ["config", "config sim"])
def test_result_that_cannot_be_written(words: str) -> None:
    line = f"exec {shlex.quote(COMMAND)} {words} >/dev/full"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=PATIENCE_S)
    told = "canwall: standard output cannot be written: No space left on device\n"
    assert (done.returncode, done.stderr) == (1, told)


def test_ball_as_json(run: Run, tmp_path: Path) -> None:
    code, out, error = run("ball", "--law", "rigid", "--output", tmp_path / "b.csv", "--json")
    assert (code, error) == (0, "")
    found = json.loads(out)
    assert (found["theta"], found["energy_start_j"]) == (0.1, 1.0)
    assert 0.0 <= found["energy_end_j"] < 1e-9


@pytest.mark.slow
def test_run_as_json(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done = command("run", "--duration", 0.3, "--output", folder, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout) == {"record": str(folder)} | Record(folder).summary


@pytest.mark.slow
def test_latency_as_json(tmp_path: Path) -> None:
    measured = ("--duration", "0.1", "--load", "0", "--output", tmp_path)
    done = command("latency", *measured, "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout) == json.loads((tmp_path / "latency.json").read_text())


@pytest.mark.slow
def test_sweep_as_json(tmp_path: Path) -> None:
    file = tmp_path / "s.nc"
    axes = ("--stiffness", "20,80", "--axis", "speed=1.0", "--axis", "phase=0.35")
    done = command("sweep", config.shipped("config/ideal.toml"), *axes, "--output", file, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    printed, written = xr.Dataset.from_dict(json.loads(done.stdout)), read_sweep(file)
    assert printed.sizes == written.sizes
    assert set(printed.variables) == set(written.variables)
    for name in ("chatters", "energy_out", "stiffness"):
        assert printed[name].equals(written[name])
