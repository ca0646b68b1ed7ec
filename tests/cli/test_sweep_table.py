"""`canwall sweep --table`: K-limits as Markdown on standard output, progress on standard error."""

from pathlib import Path

import pytest
from commands import config_file

from canwall import cli
from canwall.sweep import k_limit_table

#: Cells of the documented table, without what depends on the dampings that are searched.
STANDARD, HALF_SAMPLE = "18.1; **0.11**; 1×; ", "230; **1.41**; 12.7×; "


def rows_of(output: str) -> list[list[str]]:
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in output.splitlines()
        if line.startswith("|")
    ]


def run(*arguments: object) -> int:
    return cli.guarded(lambda: cli.app([*map(str, arguments)], standalone_mode=False))


@pytest.mark.slow
def test_table_of_two_laws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(k_limit_table, "DAMPINGS", (0.05, 0.5))
    # Axes of the file would be further dimensions of the table.
    file = config_file(tmp_path / "config.toml")
    file.write_text(file.read_text() + '\n[sweep]\nrate = "100:1000:10"\n')
    laws = ("--law", "half_sample", "--law", "damped", "--law", "standard")
    assert run("sweep", file, "--table", *laws, "--operator", "finger") == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert [line for line in said.out.splitlines() if line.startswith("With")] == [
        "With the model matched:",
        "With a model that knows only the drive:",
    ]
    rows = rows_of(said.out)
    assert len(rows) == 2 * 5
    head, rule, half_sample, damped, standard = rows[:5]
    assert (head, rule) == (["law", "finger"], ["---", "---"])
    assert [row[0] for row in (half_sample, damped, standard)] == [
        *("half_sample", "damped", "standard"),
    ]
    assert half_sample[1].startswith(HALF_SAMPLE)
    assert standard[1].startswith(STANDARD)
    # At the better of the two dampings, relative to the standard wall and to itself.
    assert damped[1] == "33.8; **0.206** at 0.5; 1.87×; 1×"
    assert rows[7][1].startswith("103; **0.629**; 5.7×; ")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--output", "a.nc"], "--table has fixed axes and writes no file: leave out --output"),
        (["--stiffness", "1:9:3", "--resume"], "leave out --stiffness, --resume"),
        (["--rate", "1000"], "leave out --rate"),
        (["--damping", "0"], "leave out --damping"),
        (["--axis", "speed=1"], "leave out --axis"),
        (["--law", "none"], "wall.law: unknown law 'none'"),
        (["--operator", "giant"], "sweep axis operator: has to be one of none, finger"),
        (["--through", "air"], "--through air: has to be sim or bus"),
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
    assert run("sweep", "--table", *arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.splitlines()) == 1
    assert line in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_sweep_needs_a_file_for_its_result(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("sweep") == 2
    assert capsys.readouterr().err == (
        "canwall: --output is missing: give the FILE.nc of the result\n"
    )
