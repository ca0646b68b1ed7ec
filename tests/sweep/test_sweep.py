"""Sweeps: the same numbers through frames, whoever computes them, and after an interruption."""

import json
import socket
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from commands import command
from rig import settings_with

from canwall import cli
from canwall.errors import InputError
from canwall.sweep import Plan, ineffective_axis_notes, make_plan, read_sweep, sweep, sweep_table
from canwall.sweep.journal import Journal
from canwall.sweep.plan import compute_piece
from canwall.sweep.workers import compute_pieces

SMALL = {"speed": [1.0], "phase": [0.35]}


def plan_of(through: str = "sim", **axes: object) -> Plan:
    return make_plan(settings_with(), {**SMALL, **axes}, through)


def raw(plan: Plan) -> list[bytes]:
    return [compute_piece(plan, piece).tobytes() for piece in range(plan.pieces)]


@pytest.mark.parametrize(
    "axes",
    [
        {"law": ["standard", "mean_force"], "operator": ["none", "finger", "hand"]},
        {"rate": [100, 550, 1000], "law": "mean_force"},
        {"delay": [0, 0.5, 1, 1.6, 2], "law": "half_sample"},
        {"counts": [4096, 1 << 20]},
        {"torque_step": [0.0001, 0.002]},
        {"wall.side": ["below", "above"], "wall.position_rad": [0.02]},
        {"simulation.hand.grip": [False], "operator": ["finger"], "servo": ["ideal"]},
        {"model": ["drive"], "model_error": [-0.2, 0.3], "law": "push_only", "speed": [0.5, 2.0]},
    ],
    ids=lambda axes: ", ".join(axes),
)
def test_through_the_bus_and_in_memory_it_is_the_same(axes: dict[str, Any]) -> None:
    axes = {"stiffness": "3:120:2", "damping": [0.001], **axes}
    assert raw(plan_of("bus", **axes)) == raw(plan_of(**axes))


def test_a_map_has_every_axis_with_its_unit(tmp_path: Path) -> None:
    plan = plan_of(
        stiffness="1:100:5",
        damping="0:0.02:3",
        rate="500:1000:2",
        speed=[0.5, 1.0],
        **{"simulation.coulomb_nm": "0,0.01"},
    )
    written = sweep(plan, tmp_path / "map.nc")
    read = read_sweep(tmp_path / "map.nc")
    assert read.identical(written)
    assert dict(read["chatters"].sizes) == {
        "law": 1,
        "rate": 2,
        "simulation.coulomb_nm": 2,
        "damping": 3,
        "stiffness": 5,
        "speed": 2,
        "phase": 1,
    }
    np.testing.assert_allclose(read["stiffness"], np.geomspace(1, 100, 5))
    assert read["stiffness"].attrs["units"] == "N*m/rad"
    assert read["energy_out"].attrs["units"] == "J"
    np.testing.assert_array_equal(read["period"].sel(rate=500), 0.002)
    assert tomllib.loads(read.attrs["configuration"])["bus"]["cycle_s"] == 0.001
    assert "numba" in json.loads(read.attrs["versions"])
    # Where the values lie: one point, computed alone.
    point = {"law": "standard", "rate": 1000, "simulation.coulomb_nm": 0.01}
    alone = plan_of(stiffness=[10.0**1.5], damping=[0.01], speed=[1.0], **point)
    there = read.sel({**point, "damping": 0.01, "speed": 1.0}).isel(stiffness=3)
    (measured,) = compute_piece(alone, 0)[0]
    assert there["energy_out"].item() == pytest.approx(measured["energy_out"], rel=1e-9)
    assert there["peak_torque"].item() == pytest.approx(measured["peak_torque"], rel=1e-9)


def test_the_result_does_not_depend_on_the_workers(tmp_path: Path) -> None:
    plan = plan_of(law=["standard", "half_sample"], operator=["none", "finger"])
    one = sweep(plan, tmp_path / "one.nc", workers=1)
    three = sweep(plan, tmp_path / "three.nc", workers=3)
    assert one.identical(three)
    by_frames = plan_of("bus", law=["standard"], operator=["none"], stiffness="1:50:2")
    in_memory = plan_of(law=["standard"], operator=["none"], stiffness="1:50:2")
    ((_, framed),) = compute_pieces(by_frames, [0], workers=2)
    assert framed.tobytes() == compute_piece(in_memory, 0).tobytes()


def test_a_k_limit_is_free_and_a_little_more_is_not() -> None:
    plan = plan_of(law=["half_sample"], operator=["finger"], speed=[0.5, 2.0], phase=[0.0, 0.7])
    found = compute_piece(plan, 0)
    worst = found["worst"][0, 0]
    assert worst <= found["limit"].min()
    free = plan_of(
        law=["half_sample"],
        operator=["finger"],
        speed=[0.5, 2.0],
        phase=[0.0, 0.7],
        stiffness=[worst, found["limit"].min() * 1.011],
    )
    chatters = np.array([compute_piece(free, piece)["chatters"][0] for piece in range(free.pieces)])
    assert not chatters[:, 0].any()
    assert chatters[:, 1].any()


class StoppedError(Exception):
    pass


def stop_after(count: int) -> Any:
    def progress(done: int, total: int) -> None:
        if done >= count:
            raise StoppedError

    return progress


def test_an_interrupted_sweep_goes_on(tmp_path: Path) -> None:
    plan = plan_of(stiffness="1:100:40", operator=["none", "finger", "grip", "hand"])
    whole = sweep(plan, tmp_path / "whole.nc")
    output = tmp_path / "parts.nc"
    with pytest.raises(StoppedError):
        sweep(plan, output, workers=1, progress=stop_after(2))
    assert not output.exists()
    with pytest.raises(InputError, match="holds an unfinished sweep; --resume continues"):
        sweep(plan, output)
    other = plan_of(stiffness="1:100:41", operator=["none", "finger", "grip", "hand"])
    with pytest.raises(InputError, match="another configuration or other axes"):
        sweep(other, output, resume=True)
    said: list[int] = []
    resumed = sweep(plan, output, resume=True, progress=lambda done, total: said.append(done))
    assert said[0] >= 2
    assert resumed.identical(whole)
    assert read_sweep(output).identical(whole)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.nc", "whole.nc"]


def test_a_file_that_is_no_journal_is_left_alone(tmp_path: Path) -> None:
    partial = tmp_path / "a.nc.partial"
    partial.write_text("a letter")
    with pytest.raises(InputError, match="holds no unfinished sweep"):
        sweep(plan_of(stiffness=[1.0]), tmp_path / "a.nc", resume=True)
    assert partial.read_text() == "a letter"


def test_a_journal_cut_short_by_a_power_cut_keeps_what_is_whole(tmp_path: Path) -> None:
    output = tmp_path / "a.nc"
    plan = plan_of(stiffness="1:100:3")
    journal = Journal(output, "plan", resume=False)
    journal.put(0, compute_piece(plan, 0))
    # No close: the process is gone.
    journal._database.close()
    again = Journal(output, "plan", resume=True)
    assert again.done() == [0]
    assert again.get(0, plan.dtype).tobytes() == compute_piece(plan, 0).tobytes()
    again.remove()


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"stiffness": "1:2"}, "axis stiffness: has to be a number, not '1:2'"),
        ({"stiffness": "0:2:3"}, "a geometric range has to be above 0"),
        ({"stiffness": "1:2:0"}, "is not a range; write LO:HI:N"),
        ({"stiffness": "1,1"}, "axis stiffness: has a value twice"),
        ({"stiffness": ""}, "axis stiffness: has no values"),
        ({"operator": "giant"}, "has to be one of none, finger, grip, hand, not 'giant'"),
        ({"model": "none"}, "has to be one of matched, drive, file, not 'none'"),
        ({"rate": "0"}, "axis rate: has to be greater than 0"),
        ({"simulation.coulomb": "1"}, "simulation.coulomb: unknown key; did you mean"),
        ({"simulation.coulomb_nm": "-1"}, "simulation.coulomb_nm: has to be greater than"),
        ({"simulation.coulomb_nm": "0,red"}, "simulation.coulomb_nm: has to be a valid number"),
        ({"nothing.at_all": "1"}, "nothing.at_all: there is no"),
        ({"law": "none"}, "wall.law: unknown law 'none'"),
        ({"wall.stiffness_nm_per_rad": "1"}, "use stiffness instead"),
        ({"delay": "3.5"}, "axis delay: has to be at most 3"),
        ({"damping": "-1"}, "axis damping: has to be at least 0, not -1"),
        ({"rate": "1e8"}, "a strike of .* cycles; 2000000 at most"),
        ({"press": "1e9"}, "a strike of .* cycles; 2000000 at most"),
        ({"stiffness": "1:2:99999999999"}, "99999999999 values; 1000000 at most"),
        ({"stiffness": "1:2:9999", "damping": "1:2:9999"}, "99980001 points; 10000000 at most"),
        ({"counts": "10.5"}, "has to be a whole number"),
        ({"torque_step": "1.5e-7"}, "whole µN·m"),
        ({"stiffness": "1", "stiffness_normalised": "1"}, "keep one of them"),
    ],
)
def test_a_wrong_axis(axes: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        plan_of(**axes)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--axis", "colour=red"], "sweep axis colour: unknown key"),
        (["--axis", "speed"], "--axis speed: has to be NAME=VALUES"),
        (["--through", "air"], "--through air: has to be sim or bus"),
        (["--workers", "2", "--dask", "nowhere"], "--workers and --dask: keep one"),
        (["--output", "."], ".: exists already"),
        (["--output", "/none/a.nc"], "/none/a.nc.partial: cannot be written"),
        (["--dask", "tcp://127.0.0.1:9"], "--dask tcp://127.0.0.1:9: no scheduler there"),
        (["--dask", "nowhere"], "--dask nowhere: no scheduler there"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    tmp_path: Path,
    arguments: list[str],
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    output = [] if "--output" in arguments else ["--output", "a.nc"]
    given = ["sweep", str(settings_file()), "--stiffness", "1,2", *output, *arguments]
    assert cli.guarded(lambda: cli.app(given, standalone_mode=False)) == 2
    errors = capsys.readouterr().err
    assert errors.splitlines()[0].startswith(f"canwall: {line}")
    assert len(errors.splitlines()) == 1, errors
    assert list(tmp_path.iterdir()) == []


def test_somebody_else_at_the_address_is_no_scheduler(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        done = command(
            *("sweep", settings_file(), "--stiffness", "1", "--output", "a.nc"),
            *("--dask", address),
            cwd=tmp_path,
        )
    assert done.returncode == 2
    assert done.stderr == f"canwall: --dask {address}: no scheduler there: no answer\n"
    assert list(tmp_path.iterdir()) == []


def settings_file() -> Path:
    from rig import SIM_CONFIG

    return SIM_CONFIG


def test_the_axes_of_the_file_and_those_of_the_command_line(tmp_path: Path) -> None:
    text = settings_file().read_text().replace("../eds", str(settings_file().parents[1] / "eds"))
    file = tmp_path / "axes.toml"
    file.write_text(
        text + '\n[sweep]\nlaw = ["midpoint", "standard"]\nstiffness = "1:10:3"\nspeed = 1.0\n'
        'phase = [0.0]\n"simulation.coulomb_nm" = [0.0, 0.02]\n'
    )
    done = command("sweep", file, "--output", "a.nc", "--stiffness", "2,4", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "8 points: a.nc; canwall plot a.nc draws them" in done.stdout
    found = read_sweep(tmp_path / "a.nc")
    assert list(found["law"].values) == ["midpoint", "standard"]
    assert list(found["stiffness"].values) == [2, 4]
    assert list(found["simulation.coulomb_nm"].values) == [0.0, 0.02]
    again = command("sweep", file, "--output", "a.nc", cwd=tmp_path)
    assert again.returncode == 2
    assert again.stderr == "canwall: a.nc: exists already; choose another --output\n"


def test_k_limits_are_shown_in_a_table(tmp_path: Path) -> None:
    done = command(
        *(
            "sweep",
            settings_file(),
            "--output",
            "a.nc",
            "--law",
            "standard",
            "--operator",
            "finger",
        ),
        *("--axis", "speed=1", "--axis", "phase=0"),
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "standard" in done.stdout
    worst = read_sweep(tmp_path / "a.nc")["worst"].item()
    assert f"{worst:.3g}" in done.stdout


def test_a_map_is_shown_in_a_table() -> None:
    dataset = xr.Dataset(
        {
            "chatters": (
                ("law", "damping", "stiffness", "speed", "phase"),
                np.array([[[0, 0, 1], [0, 1, 0]], [[1, 1, 1], [1, 0, 1]]], bool)[..., None, None],
            ),
            "energy_out": (
                ("law", "damping", "stiffness", "speed", "phase"),
                np.zeros((2, 2, 3, 1, 1)),
            ),
        },
        {"law": ["a", "b"], "damping": [0.0, 1.0], "stiffness": [1.0, 2.0, 3.0]},
    )
    table = sweep_table(dataset)
    columns = [list(column.cells) for column in table.columns]
    assert columns == [["a", "b"], ["6", "6"], ["4", "1"], ["2", "none"], ["0", "0"]]


@pytest.mark.parametrize("stiffness", [{}, {"stiffness": "2,20"}])
def test_notes_on_axes_that_a_law_ignores(tmp_path: Path, stiffness: dict[str, str]) -> None:
    axes = {"law": ["standard", "damped", "rigid"], "damping": "0,0.02", "speed": "1", "phase": "0"}
    dataset = sweep(make_plan(settings_with(), axes | stiffness), tmp_path / "a.nc")
    of_stiffness = ["stiffness changes nothing for rigid"] if stiffness else []
    assert ineffective_axis_notes(dataset) == [
        *of_stiffness,
        "damping changes nothing for standard, rigid",
    ]
    limits = list(sweep_table(dataset).columns[2].cells)
    assert [cell.startswith("≥") for cell in limits] == [
        not stiffness and n >= 4 for n in range(len(limits))
    ]
