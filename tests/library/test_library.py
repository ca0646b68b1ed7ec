"""What `import canwall` offers, against the commands, closed forms and other readers."""

import importlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import xarray as xr
from commands import Record, command, config_file, same_signals, wait_for
from scipy.io import loadmat

import canwall
from canwall.errors import ConfigError, InputError, RunFailedError, TrippedError
from canwall.record import Phase
from canwall.record.columns import COLUMNS
from canwall.sweep.figures import draw_sweep

UNITS = {column.name: column.unit for column in COLUMNS}


# The package


@pytest.mark.slow
def test_import_is_light() -> None:
    code = "import sys, canwall; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert [name for name in loaded if name.startswith("canwall")] == ["canwall"]
    assert not {"numpy", "pydantic", "typer", "numba"} & set(loaded)


def test_functions_have_the_names_of_rooms() -> None:
    for name in ("run", "sweep"):
        room = importlib.import_module(f"canwall.{name}")
        assert room is sys.modules[f"canwall.{name}"]
        assert getattr(canwall, name) is not room
        assert callable(getattr(canwall, name))


def test_names_are_there_and_no_others() -> None:
    assert {"load", "run", "sweep", "ball", "read", "law", "errors"} <= set(dir(canwall))
    for name in canwall.__all__:
        assert getattr(canwall, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'runn'"):
        canwall.runn  # noqa: B018


def test_package_says_that_it_is_typed() -> None:
    assert (Path(canwall.__file__).parent / "py.typed").exists()


# Configurations


def test_load_takes_other_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config_file(tmp_path / "own.toml")
    (tmp_path / "own.eds").write_text("")
    monkeypatch.chdir(tmp_path)
    overrides = {
        "simulation.hand.inertia_kg_m2": 3e-4,
        "wall.law": "mine.py:mine",
        "drive.eds": "own.eds",
    }
    settings = canwall.load("own.toml", overrides)
    assert settings.simulation is not None
    assert settings.simulation.hand.inertia_kg_m2 == 3e-4
    assert settings.wall.law == f"{tmp_path}/mine.py:mine"
    assert settings.drive.eds == tmp_path / "own.eds"
    again = canwall.load(settings, {"bus.cycle_s": 0.002})
    assert (again.bus.cycle_s, again.wall) == (0.002, settings.wall)
    assert canwall.load(settings) == settings


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        ({"wall.stifness_nm_per_rad": 1.0}, "unknown key; did you mean stiffness_nm_per_rad"),
        ({"wal.law": "standard"}, r"wal.law: there is no \[wal\]"),
        ({"bus.cycle_s": -1}, "bus.cycle_s: has to be greater than 0, not -1"),
        ({"wall.law": len}, "is no law; declare a function with @canwall.law"),
    ],
)
def test_what_cannot_be_loaded_is_an_input_error(overrides: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        canwall.load(None, overrides)


def test_a_path_may_be_left_out() -> None:
    settings = canwall.load(None, {"simulation.store": None})
    assert settings == canwall.load()


@pytest.mark.parametrize(
    ("function", "given", "complaint"),
    [
        (canwall.load, {"overrides": ["wall.law"]}, "overrides: has to be a dict.*, not list"),
        (canwall.load, {"overrides": {3: 1}}, "overrides: has to be a dictionary with names"),
        (canwall.load, {"overrides": {"drive.eds": None}}, "drive.eds: has to be a path"),
        (canwall.run, {"overrides": "ab"}, "overrides: has to be a dictionary"),
        (canwall.run, {"output": 3}, "output: has to be a path, not int"),
        (canwall.run, {"law": 3}, "law: 3 is no law"),
        (canwall.sweep, {"axes": ["rate"]}, "axes: has to be a dict.*, not list"),
        (canwall.sweep, {"law": 3}, "law: 3 is no law"),
        (canwall.sweep, {"rate": {1, 2}}, "sweep axis rate: .* numbers or text .*, not set"),
        (canwall.sweep, {"output": 3}, "output: has to be a path"),
        (canwall.sweep, {"workers": "2"}, "workers: has to be a number of cores, not str"),
        (canwall.sweep, {"workers": 2.5}, "workers: has to be a number of cores, not float"),
        (canwall.sweep, {"workers": True}, "workers: has to be a number of cores, not bool"),
        (canwall.sweep, {"dask": 3}, "dask: has to be an address, not int"),
        (canwall.sweep_figures, {"dataset": "a.nc"}, "dataset: has to be the Dataset .*, not str"),
        (canwall.law_table, {"name": "laws", "workers": []}, "workers: has to be a number"),
        (canwall.law_table, {"name": 3}, "--table 3: has to be one of laws"),
        (canwall.law_table, {"name": "laws", "operator": 3}, "operator: has to be one of none"),
        (canwall.ball, {"law": "standard", "options": ["a"]}, "options: has to be a dictionary"),
        (canwall.read, {"path": 3}, "path: has to be a path, not int"),
        (canwall.attach, {"folder": 3}, "folder: has to be a path, not int"),
        (canwall.SimulatedDrive, {"eds": 3}, "eds: has to be a path, not int"),
        (canwall.SimulatedDrive, {"simulation": 3}, "simulation: has to be a dictionary"),
    ],
)
def test_argument_of_another_type(
    function: Callable[..., object], given: dict[str, object], complaint: str
) -> None:
    with pytest.raises(InputError, match=complaint):
        function(**given)


def test_a_dictionary_is_no_configuration() -> None:
    with pytest.raises(
        InputError, match=r"path or settings \(values by dotted key are overrides\), not"
    ):
        canwall.load({"wall.law": "midpoint"})  # type: ignore[arg-type]


# Runs


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> canwall.RecordedRun:
    return canwall.run(output=tmp_path_factory.mktemp("library") / "run", progress=False)


def test_run_is_that_of_the_command(run: canwall.RecordedRun, four_strikes: Record) -> None:
    assert same_signals(Record(run.folder), four_strikes)
    assert run.summary["strikes"] == four_strikes.summary["strikes"]
    assert run.settings == canwall.load()
    (guard,) = run.remarks
    assert guard.startswith("guard: the wall buzzed")
    assert run.chatter
    assert not run.trips
    assert "mean_force, standard" in repr(run)


def test_signals_have_units(run: canwall.RecordedRun) -> None:
    signals = run.signals
    assert signals.attrs["units"] == UNITS
    written = pq.read_schema(run.folder / "signals.parquet")
    assert json.loads(written.metadata[b"units"]) == UNITS
    pandas = pd.read_parquet(run.folder / "signals.parquet")
    assert pandas.attrs["units"] == UNITS
    pd.testing.assert_frame_equal(pandas, signals)
    assert run.table.schema.field("y").metadata[b"unit"] == b"rad"
    assert list(run.strikes["law"]) == ["mean_force", "standard"] * 2


def test_run_is_drawn(run: canwall.RecordedRun) -> None:
    titles = [axes.get_title(loc="left") for axes in run.plot().axes]
    assert any(title.startswith("standard, ") for title in titles)


def test_read_finds_what_there_is(run: canwall.RecordedRun, tmp_path: Path) -> None:
    read = canwall.read(str(run.folder))
    assert isinstance(read, canwall.RecordedRun)
    assert read.summary == run.summary
    assert read.table.equals(run.table)
    for nothing in (tmp_path, tmp_path / "none.nc"):
        with pytest.raises(InputError):
            canwall.read(nothing)


@pytest.mark.slow
def test_given_wall_is_that_of_the_command(tmp_path: Path) -> None:
    given = {"law": "damped", "stiffness": 20.0, "damping": 0.05}
    words = [word for name, value in given.items() for word in (f"--{name}", value)]
    done = command("run", *words, "--duration", 0.4, "--output", tmp_path / "command")
    assert done.returncode == 0
    own = canwall.run(duration=0.4, output=tmp_path / "library", progress=False, **given)  # type: ignore[arg-type]
    assert same_signals(Record(own.folder), Record(tmp_path / "command"))
    assert set(own.signals["damping"]) == {0.05}


def test_trip_is_an_exception_with_the_run(tmp_path: Path) -> None:
    with pytest.raises(TrippedError, match="speed") as caught:
        canwall.run(
            law="half_sample",
            duration=1.0,
            output=tmp_path / "run",
            overrides={"limits.speed_rad_s": 1.0},
            progress=False,
        )
    tripped = caught.value.run
    assert tripped.trips
    assert str(caught.value) == "; ".join(tripped.trips)
    assert tripped.table.num_rows == Record(tmp_path / "run").summary["cycles"]
    assert not tripped.signals["torque_cmd"].iloc[-1]


@pytest.mark.parametrize("duration", [600.0, None])
def test_interrupted_run_ends_as_the_command_does(tmp_path: Path, duration: float | None) -> None:
    folder = tmp_path / "run"
    settings = canwall.load(None, {"wall.law": "half_sample"})
    until_stopped = settings.run.model_copy(update={"duration_s": duration})
    settings = settings.model_copy(update={"run": until_stopped, "schedule": ()})

    def interrupt() -> None:
        wait_for((folder / "live.json").exists)
        os.kill(os.getpid(), 2)

    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        if duration is None:
            run = canwall.run(settings, output=folder, progress=False)
        else:
            with pytest.raises(KeyboardInterrupt, match=f"the drive is disabled; record: {folder}"):
                canwall.run(settings, output=folder, progress=False)
            read = canwall.read(folder)
            assert isinstance(read, canwall.RecordedRun)
            run = read
    finally:
        thread.join()
    assert run.summary["interrupted"]
    assert not run.summary["cut_off"]
    assert run.signals["phase"].iloc[-1] == Phase.LEAVING
    assert not run.signals["torque_cmd"].iloc[-1]


def test_run_without_a_strike_has_the_columns_of_strikes(
    run: canwall.RecordedRun, tmp_path: Path
) -> None:
    empty = canwall.run(duration=0.05, output=tmp_path / "run", progress=False)
    assert len(empty.strikes) == 0
    assert list(empty.strikes) == list(run.strikes)
    _, strikes = empty.to_csv()
    assert pd.read_csv(strikes).columns.tolist() == list(run.strikes)


def test_empty_output_is_not_the_working_directory() -> None:
    with pytest.raises(InputError, match="output: is empty"):
        canwall.run(output="")


def test_run_is_refused_where_no_signal_would_end_it() -> None:
    refused: list[str] = []

    def call() -> None:
        try:
            canwall.run(progress=False)
        except RunFailedError as error:
            refused.append(str(error))

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    assert refused == ["run: call it from the main thread; in others no signal could end the wall"]


# Export


def test_export_is_read_by_others(run: canwall.RecordedRun) -> None:
    done = command("export", run.folder, "--csv", "--mat")
    paths = [run.folder / name for name in ("signals.csv", "strikes.csv", "run.mat")]
    assert (done.returncode, done.stdout.split()) == (0, [str(path) for path in paths])
    signals, strikes = pd.read_csv(paths[0]), pd.read_csv(paths[1])
    assert {"j", "y [rad]", "stiffness [N·m/rad]", "law"} <= set(signals.columns)
    np.testing.assert_array_equal(signals["y [rad]"], run.signals["y"])
    assert list(signals["law"]) == list(run.signals["law"])
    assert list(strikes["contacts"]) == list(run.strikes["contacts"])
    mat = loadmat(paths[2], squeeze_me=True, struct_as_record=False)
    for name in ("y", "received", "counts"):
        np.testing.assert_array_equal(getattr(mat["signals"], name), run.signals[name])
    assert list(mat["laws"][mat["signals"].law - 1]) == list(run.signals["law"])
    assert mat["units"].stiffness == "N·m/rad"
    assert [strike.law for strike in mat["summary"].strikes] == list(run.strikes["law"])
    assert np.isnan(mat["summary"].trip_cycle)
    assert mat["config"] == run.settings.to_toml()


def test_export_of_a_record_without_its_configuration(
    run: canwall.RecordedRun, tmp_path: Path
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(run.folder, folder, ignore=shutil.ignore_patterns("config.toml"))
    with pytest.raises(InputError) as caught:
        canwall.read(folder).to_mat()
    assert str(caught.value) == f"{folder}: the record is incomplete: put back its config.toml"


def test_export_asks_for_a_format(run: canwall.RecordedRun) -> None:
    done = command("export", run.folder)
    assert done.returncode == 2
    assert done.stderr == "canwall: export: give --csv, --mat, or both\n"


# Laws


def spring(wall: Any) -> float:
    return -wall.stiffness * wall.y_sample if wall.y_sample < 0.0 else 0.0


@pytest.mark.slow
def test_declared_law_is_a_law(tmp_path: Path) -> None:
    own = canwall.law(spring)
    for name in (own, "spring"):
        dropped = canwall.ball(name, stiffness=4.0, periods=200)
        assert dropped.drop_attrs().identical(
            canwall.ball("standard", stiffness=4.0, periods=200).drop_attrs()
        )
    of_both = {"duration": 0.4, "stiffness": 20.0, "progress": False}
    runs = [
        canwall.run(law=law, output=tmp_path / str(i), **of_both)  # type: ignore[arg-type]
        for i, law in enumerate(("standard", own))
    ]
    assert runs[1].summary["law"] == ["spring"]
    standard, declared = (r.signals.query("phase == 1") for r in runs)
    inside = standard["y"] < 0.0
    assert inside.any()
    force = np.where(declared["y"] < 0.0, -20.0 * declared["y"], 0.0)
    np.testing.assert_allclose(declared["force"], force, rtol=1e-9, atol=1e-12)


def test_declared_law_has_options_and_is_replaced() -> None:
    @canwall.law(offset=2.0)
    def constant(wall: Any) -> float:
        return wall.options.offset

    assert set(canwall.ball(constant, periods=5)["f"].values[:-1]) == {2.0}
    assert set(canwall.ball(constant, periods=5, options={"offset": 3.0})["f"].values[:-1]) == {3.0}
    with pytest.raises(InputError, match="law constant has no option 'ofset'; did you mean offset"):
        canwall.ball(constant, options={"ofset": 1.0})

    @canwall.law(offset=4.0)
    def constant(wall: Any) -> float:
        return 2.0 * wall.options.offset

    assert set(canwall.ball("constant", periods=5)["f"].values[:-1]) == {8.0}


def test_one_line_for_a_function_that_is_no_law() -> None:
    def misspelt(wall: Any) -> float:
        return wall.stifness

    line = misspelt.__code__.co_firstlineno + 1
    with pytest.raises(InputError, match=rf"misspelt: line {line}: uses stifness, .* stiffness\?"):
        canwall.law(misspelt)

    def standard(wall: Any) -> float:
        return 0.0

    with pytest.raises(InputError, match="standard: a law of the project has this name"):
        canwall.law(standard)
    with pytest.raises(InputError, match="is no function"):
        canwall.law(len)


def test_exception_in_a_declared_law_is_told_with_its_line(tmp_path: Path) -> None:
    @canwall.law
    def raises(wall: Any) -> float:
        if wall.y < 0.0:
            raise ValueError("too deep")
        return 0.0

    with pytest.raises(TrippedError, match="ValueError: too deep"):
        canwall.run(law=raises, duration=0.5, output=tmp_path / "run", progress=False)


# Sweeps and the ball

AXES = {"speed": 1.0, "phase": [0.0, 0.5]}


@pytest.mark.slow
def test_sweep_is_what_its_file_says(tmp_path: Path) -> None:
    canwall.law(spring)
    arguments = {"law": ["standard", "spring"], "operator": "finger", "progress": False}
    stiffness = np.geomspace(10.0, 40.0, 3)
    found = canwall.sweep(None, AXES, stiffness=stiffness, damping=[0, np.int64(1)], **arguments)  # type: ignore[arg-type]
    assert dict(found.sizes) == {
        **{"law": 2, "operator": 1, "damping": 2, "stiffness": 3, "speed": 1, "phase": 2}
    }
    output = tmp_path / "sweep.nc"
    written = canwall.sweep(
        None,
        AXES,
        stiffness="10:40:3",
        damping="0,1",
        output=output,
        **arguments,  # type: ignore[arg-type]
    )
    assert found.drop_attrs().identical(written.drop_attrs())
    read = canwall.read(output)
    assert isinstance(read, xr.Dataset)
    assert read.equals(written)
    for name, variable in found.variables.items():
        assert {"units", "long_name"} <= set(variable.attrs), name
    # The same law by another name.
    standard, own = (found.sel(law=law, damping=0, drop=True) for law in ("standard", "spring"))
    xr.testing.assert_equal(standard["peak_torque"], own["peak_torque"])


@pytest.mark.slow
def test_figures_of_a_sweep() -> None:
    found = canwall.sweep(None, AXES, law="standard", stiffness="10,40", damping="0,1")
    figures = canwall.sweep_figures(found)
    assert list(figures) == ["energy", "amplitude", "frequency", "z-width"]
    assert list(figures) == [name for name, _ in draw_sweep(found)]
    with pytest.raises(InputError, match="single stiffness"):
        canwall.sweep_figures(found.isel(stiffness=[0]))


def test_figures_of_a_part_of_a_sweep() -> None:
    found = canwall.sweep(
        axes={"speed": [0.3, 0.8], "phase": 0.0},
        law="standard",
        stiffness="10:20:2",
        progress=False,
    )
    with pytest.raises(InputError, match=r"speed: no axis of this Dataset.*speed=\[…\]"):
        canwall.sweep_figures(found.isel(speed=0))
    assert canwall.sweep_figures(found.isel(speed=[0]))


def test_result_that_nobody_would_know_as_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"x\.txt: has to end in \.nc"):
        canwall.sweep(law="standard", stiffness=10.0, output=tmp_path / "x.txt", progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("workers", [0, -1])
def test_nobody_to_work(workers: int) -> None:
    with pytest.raises(InputError, match=f"workers = {workers}: has to be at least 1"):
        canwall.sweep(law="standard", stiffness=10.0, workers=workers, progress=False)


def test_law_that_others_cannot_have_is_refused() -> None:
    canwall.law(spring)
    with pytest.raises(InputError, match="law spring: is declared in this process"):
        canwall.sweep(law="spring", through="bus", progress=False)
    with pytest.raises(InputError, match="give the output of the sweep"):
        canwall.sweep(resume=True)
    with pytest.raises(InputError, match="sweep axis stiffness: is given twice"):
        canwall.sweep(None, {"stiffness": 20.0}, stiffness=10.0)


def test_ball_falls_for_a_whole_number_of_periods() -> None:
    assert canwall.ball("continuous", periods=np.int64(3)).sizes == {"t": 4}
    with pytest.raises(InputError, match=r"whole number, 0 … 100000000, not 2\.5"):
        canwall.ball("continuous", periods=2.5)  # type: ignore[arg-type]


def test_text_is_no_number_of_a_ball() -> None:
    with pytest.raises(InputError, match="stiffness has to be a number, not '4'"):
        canwall.ball("standard", stiffness="4")  # type: ignore[arg-type]


def test_ball_falls_and_has_units() -> None:
    dropped = canwall.ball("continuous", periods=300)
    free = dropped.isel(t=slice(0, 14))
    np.testing.assert_allclose(free["y"], 1.0 - 0.5 * free["t"] ** 2, rtol=1e-12)
    np.testing.assert_allclose(free["v"], -free["t"], rtol=1e-12)
    np.testing.assert_allclose(dropped["energy"], 1.0, rtol=1e-9)
    units = {str(name): v.attrs["units"] for name, v in dropped.variables.items()}
    assert units == {"t": "s", "y": "m", "v": "m/s", "f": "N", "energy": "J"}
    with pytest.raises(InputError, match="mass has to be a number above 0"):
        canwall.ball("standard", mass=0.0)
    with pytest.raises(ConfigError):
        canwall.load("nowhere.toml")
