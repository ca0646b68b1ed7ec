"""`canwall sweep --table`: Markdown on standard output, progress on standard error."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from scipy import stats

from canwall import cli, config
from canwall.sweep import LAW_TABLES, law_tables, make_plan, read_sweep, sweep
from canwall.sweep.axes import NAMED

SERVO = config.shipped("config/sim.toml")


def rows_of(output: str) -> list[list[str]]:
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in output.splitlines()
        if line.startswith("|") and not line.startswith("|---")
    ]


def run(*arguments: object) -> int:
    return cli.guarded(lambda: cli.app([*map(str, arguments)], standalone_mode=False))


def copy_of_servo(folder: Path, text: str, other: str) -> Path:
    """config/sim.toml with another text in place of this one."""
    file = folder / "servo.toml"
    content = SERVO.read_text().replace("../eds", str(SERVO.parents[1] / "eds"))
    file.write_text(content.replace(text, other))
    return file


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer strikes, dampings and conditions."""
    monkeypatch.setattr(law_tables, "DAMPINGS", (0.05, 0.4))
    axes = {
        "laws": {"servo": ["1600Hz"], "friction": [0.02], "delay_error": [-0.3, 0.0]},
        "cap": {"servo": ["800Hz"], "friction": [0.0], "delay_error": [0.0]},
        "bench": {"servo": ["800Hz"], "friction": [0.0], "delay_error": [0.0]},
        "first-strike": {"servo": ["1600Hz"], "friction": [0.02]},
        "shaft": {"simulation.shaft_hz": [400.0]},
    }
    for name, few in axes.items():
        fewer = LAW_TABLES[name].axes | few | {"speed": [1.0], "phase": [0.35]}
        table = LAW_TABLES[name]
        monkeypatch.setitem(LAW_TABLES, name, replace(table, axes=fewer, draws=min(table.draws, 2)))


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_k_limits_are_those_of_a_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Axes of the file would be further dimensions of the table.
    file = copy_of_servo(tmp_path, "[sweep]", "")
    file.write_text(file.read_text() + '\n[sweep]\nrate = "100:1000:10"\n')
    asked = ("--law", "mean_force", "--operator", "finger", "--output", tmp_path / "laws.nc")
    assert run("sweep", file, "--table", "laws", *asked) == 0
    said = capsys.readouterr()
    assert said.err == ""
    written = read_sweep(tmp_path / "laws.nc")
    assert list(written["law"].values) == ["standard", "damped", "mean_force"]
    worst, known, off = (rows_of(part) for part in re.split(r"\n\n(?=1600|Delay)", said.out))
    assert [row[0] for row in known[1:]] == ["standard", "damped", "mean_force"]
    assert float(worst[3][1].partition("*; ")[0].strip("*")) == pytest.approx(
        written["worst_normalised"].sel(law="mean_force").min().item(), rel=5e-3
    )
    assert [row[0] for row in off[1:]] == ["mean_force, 1600 Hz + 0.25 ms"]
    # The same walls, one by one, without a cap and with what each law may know.
    settings = config.load(SERVO)
    wall = settings.wall.model_copy(update={"cap": 0.0})
    knowing = settings.model_copy(update={"wall": wall})
    plain = settings.model_copy(
        update={
            "wall": wall.model_copy(update={"damping_ratio": 0.0}),
            "operator": settings.operator.model_copy(update={"adapt": False}),
        }
    )
    axes = {
        **{"operator": "finger", "model": "drive", "servo": "1600Hz", "friction": 0.02},
        **{"speed": 1.0, "phase": 0.35, "press": 1.2},
    }
    for base, law, more, row in (
        (plain, "standard", {}, known[1]),
        (plain, "damped", {"damping_normalised": [0.05, 0.4]}, known[2]),
        (knowing, "mean_force", {}, known[3]),
    ):
        alone = sweep(make_plan(base, {"law": law, **axes, **more}), tmp_path / f"{law}.nc")
        best = alone["worst_normalised"].max().item()
        assert f"**{best:.3g}**" in row[1]
        assert f"; {best * (1e-4 + 0.02 * 0.08**2) / 1e-6:.3g}" in row[1]
        assert written["worst_normalised"].sel(law=law, delay_error=0.0).item() == best
    late = sweep(
        make_plan(knowing, {"law": "mean_force", **axes, "delay_error": -0.3}), tmp_path / "d.nc"
    )
    assert off[1][1] == f"{late['worst_normalised'].item():.3g}"


@pytest.mark.slow
@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    ("estimator", "fewest", "most"), [("", 0, 3), ("force_walk_nm_per_sqrt_s = 0.2\n", 6, 6)]
)
def test_cap_is_what_is_in_force(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    estimator: str,
    fewest: int,
    most: int,
) -> None:
    """A grip of 4.2e-4 kg·m² on a wall that takes it for a free handle of 1e-4 kg·m².

    A third of such strikes chatter, with a plain filter all.
    """
    file = copy_of_servo(tmp_path, "adapt = true", "adapt = false")
    file.write_text(file.read_text().replace("[estimator]\n", f"[estimator]\n{estimator}"))
    assert run("sweep", file, "--table", "cap", "--operator", "grip") == 0
    head, *rows = rows_of(capsys.readouterr().out)
    assert head == ["", "grip"]
    failed = [row[1].split(" of ") for row in rows if "failed" in row[0]]
    assert [strikes for _, strikes in failed] == ["2"] * len(law_tables.CAPS)
    assert fewest <= sum(int(number) for number, _ in failed) <= most
    least = [float(row[1]) for row in rows if "least" in row[0]]
    assert least == pytest.approx([cap / 4.2 for cap in law_tables.CAPS], rel=5e-3)
    felt = np.array([float(row[1]) for row in rows if "comes to rest" in row[0]])
    median, most_strikes = felt.reshape(len(law_tables.CAPS), 2).T
    assert (median <= most_strikes).all()
    assert (most_strikes > 0.1).all() or not estimator


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_benches_are_sweeps_with_other_axes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    benches: dict[str, Any] = {"as it is": {}, "coarse and slow": {"counts": 10_000, "rate": 500.0}}
    few = replace(
        LAW_TABLES["bench"],
        benches={n: {a: (v,) for a, v in axes.items()} for n, axes in benches.items()},
    )
    monkeypatch.setitem(LAW_TABLES, "bench", few)
    assert run("sweep", SERVO, "--table", "bench", "--operator", "grip") == 0
    head, *rows = rows_of(capsys.readouterr().out)
    assert head == ["", "grip", "failed", "of"]
    axes: dict[str, Any] = {"law": "mean_force", "operator": "grip", "model": "drive"}
    axes |= {"servo": "800Hz", "friction": 0.0, "press": 1.2}
    for row, (name, more) in zip(rows, benches.items(), strict=True):
        shares, failed = [], 0
        for i, strike in enumerate(law_tables.drawn_strikes(2)):
            one = sweep(
                make_plan(config.load(SERVO), {**axes, **more, **strike}),
                tmp_path / f"{name}{i}.nc",
            )
            most = min(strike["stiffness"], (1e-4 + 0.05 * 0.08**2) * more.get("rate", 1000.0) ** 2)
            shares.append(one["stiffness_in_force"].item() / most)
            failed += int(one["chatters"].item())
        percent = f"{50.0 * failed:.1f} %"
        assert row == [name, f"{percent}; {np.median(shares):.3g}", f"**{percent}**", "2"]


def test_strikes_with_a_cap_are_spread_over_all_walls_speeds_and_phases() -> None:
    drawn = list(law_tables.drawn_strikes(law_tables.DRAWS))
    assert drawn == list(law_tables.drawn_strikes(law_tables.DRAWS))
    for name, low, high in (("stiffness", 30.0, 5000.0), ("speed", 0.2, 2.0)):
        place = np.log([strike[name] / low for strike in drawn]) / np.log(high / low)
        assert stats.kstest(place, "uniform").pvalue > 0.9
    assert stats.kstest([strike["phase"] for strike in drawn], "uniform").pvalue > 0.9


@pytest.mark.slow
@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("table", ["first-strike", "shaft"])
def test_other_tables(table: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("sweep", SERVO, "--table", table, "--operator", "none") == 0
    head, *rows = rows_of(capsys.readouterr().out)
    assert head == ["", "none"]
    for name, cell in rows:
        # A handle that leaves and turns back within the samples after it has a negative exit.
        least = -1.0 if "exit" in name else 0.0
        assert cell == "–" or float(re.findall(r"[\d.e-]+", cell)[0]) >= least


@pytest.mark.slow
@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("table", ["cap", "shaft"])
def test_a_table_has_no_figures(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = tmp_path / "table.nc"
    assert run("sweep", SERVO, "--table", table, "--operator", "none", "--output", result) == 0
    capsys.readouterr()
    assert run("plot", result) == 2
    said = capsys.readouterr().err
    assert said.endswith(f": a table has no figures; canwall sweep --table {table} prints it\n")
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--stiffness", "1:9:3", "--resume"], "leave out --stiffness, --resume"),
        (["--rate", "1000"], "leave out --rate"),
        (["--damping", "0"], "leave out --damping"),
        (["--axis", "speed=1"], "leave out --axis"),
        (["--law", "none"], "wall.law: unknown law 'none'"),
        (["--operator", "giant"], "sweep axis operator: has to be one of none, fingertip"),
        (["--through", "air"], "--through air: has to be sim or bus"),
        (["--output", "there.nc"], "there.nc: exists already; choose another --output"),
        (["--output", "new.txt"], "new.txt: has to end in .nc, by which the result of a sweep"),
        (["--output", "no/new.nc"], "no/new.nc: cannot be written: No such file or directory"),
        (["--workers", "2", "--dask", "nowhere"], "--workers and --dask: keep one"),
        pytest.param(
            ["--dask", "nowhere"], "--dask nowhere: no scheduler there", marks=pytest.mark.slow
        ),
    ],
)
def test_options_without_a_meaning_for_the_table(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    line: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.nc").touch()
    assert run("sweep", "--table", "laws", *arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.splitlines()) == 1
    assert line in said.err
    assert [path.name for path in tmp_path.iterdir()] == ["there.nc"]


def test_unknown_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("sweep", "--table", "log") == 2
    assert capsys.readouterr().err == (
        "canwall: --table log: has to be one of laws, cap, bench, first-strike, shaft\n"
    )


def test_an_axis_without_values_is_not_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run("sweep", "--stiffness", "", "--output", str(tmp_path / "x.nc")) == 2
    assert capsys.readouterr().err == "canwall: sweep axis stiffness: has no values\n"
    assert run("sweep", "--stiffness", "", "--table", "laws") == 2
    assert "leave out --stiffness" in capsys.readouterr().err


def test_every_axis_is_in_the_help() -> None:
    program: Any = typer.main.get_command(cli.app)
    options = {option.name: option for option in program.commands["sweep"].params}
    assert set(NAMED) - set(options) <= set(re.findall(r"\w+", options["axis"].help))


def test_a_sweep_needs_a_file_for_its_result(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("sweep") == 2
    assert capsys.readouterr().err == (
        "canwall: --output is missing: give the FILE.nc of the result\n"
    )
