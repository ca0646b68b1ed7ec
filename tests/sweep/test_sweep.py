"""Sweeps: the same numbers through frames, whoever computes them, and after an interruption."""

import contextlib
import errno
import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from commands import COMMAND, PATIENCE_S, command, wait_for
from fork_server import ForkedPopen
from rig import settings_with

from canwall import cli
from canwall.analysis.k_limit import FINE_FACTOR
from canwall.config import ConfigError
from canwall.errors import InputError
from canwall.sweep import Plan, ineffective_axis_notes, make_plan, read_sweep, sweep, sweep_table
from canwall.sweep.axes import settings_at
from canwall.sweep.dataset import plan_json
from canwall.sweep.journal import Journal
from canwall.sweep.plan import compute_piece
from canwall.sweep.workers import compute_pieces

SMALL = {"speed": [1.0], "phase": [0.35]}


def plan_of(through: str = "sim", **axes: object) -> Plan:
    return make_plan(settings_with(), {**SMALL, **axes}, through)


def raw(plan: Plan) -> list[bytes]:
    return [compute_piece(plan, piece).tobytes() for piece in range(plan.pieces)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "axes",
    [
        {"law": ["standard", "mean_force"], "operator": ["none", "finger", "arm"]},
        {"rate": [100, 550, 1000], "law": "mean_force"},
        {"delay": [0, 0.5, 1, 1.6, 2], "law": "half_sample"},
        {"counts": [4096, 1 << 20]},
        {"torque_step": [0.0001, 0.002]},
        {"wall.side": ["below", "above"], "wall.position_rad": [0.02]},
        {"simulation.hand.grip": [False], "operator": ["finger"], "servo": ["ideal"]},
        {"model": ["drive"], "model_error": [-0.2, 0.3], "law": "push_only", "speed": [0.5, 2.0]},
        # The bound that a shaft sets depends on the damping.
        {
            "servo": "1600Hz",
            "simulation.shaft_hz": [400.0],
            "model": "drive",
            "damping": [0.0, 0.02],
        },
    ],
    ids=lambda axes: ", ".join(axes),
)
def test_through_the_bus_and_in_memory_it_is_the_same(axes: dict[str, Any]) -> None:
    axes = {"stiffness": "3:120:2", "damping": [0.001], **axes}
    assert raw(plan_of("bus", **axes)) == raw(plan_of(**axes))


@pytest.mark.slow
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


@pytest.mark.slow
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
        stiffness=[worst, found["limit"].min() * FINE_FACTOR],
    )
    chatters = np.array([compute_piece(free, piece)["chatters"][0] for piece in range(free.pieces)])
    assert not chatters[:, 0].any()
    assert chatters[:, 1].any()


def test_a_buzz_within_six_counts_is_felt() -> None:
    """half_sample on a grip at 712 N·m/rad: motion and counts alone called it free up to 791."""
    wall: dict[str, object] = {"law": ["half_sample"], "operator": ["grip"], "servo": ["ideal"]}
    plan = plan_of(**wall, stiffness=[100.0, 712.0])
    quiet, buzzing = compute_piece(plan, 0)[0]
    assert not quiet["chatters"]
    assert quiet["ripple"] < 1e-6
    assert buzzing["chatters"]
    assert buzzing["chatters_ripple"]
    assert not buzzing["chatters_counts"]
    assert not buzzing["chatters_amplitude"]
    # Of the wall's force, 2.6 N peak to peak, the hand's share of the inertia is felt.
    felt = 712.0 * buzzing["motion"] / 0.08 * 3.2 / 4.2 / np.sqrt(8.0)
    assert buzzing["ripple"] == pytest.approx(felt, rel=0.4)
    assert 200.0 < buzzing["frequency"] < 350.0


def test_referent_is_the_wall_in_force_for_the_mass_that_moves() -> None:
    """A wrong mass in the model is no excuse: it shows in mass_est and stiffness_in_force."""
    mass, asked = 1e-4 + 0.05 * 0.08**2, 600.0
    struck: dict[str, object] = {"operator": ["grip"], "law": ["mean_force"]}
    wall = {"wall.damping_ratio": [0.5], "wall.cap": [0.5]}
    capped = plan_of(**struck, **wall, stiffness=[asked], model=["drive"])
    found = compute_piece(capped, 0)[0, 0]
    stiffness = 0.5 * mass / 1e-6
    plain = plan_of(**struck, stiffness=[stiffness], damping=[np.sqrt(stiffness * mass)])
    referent = compute_piece(plain, 0)[0, 0]
    for name in ("referent_first_depth", "referent_ripple", "referent_events"):
        assert found[name] == pytest.approx(referent[name], rel=1e-9), name
    # Half of m/T² of a model that knows the drive alone.
    assert found["mass_est"] == pytest.approx(1e-4)
    assert found["stiffness_in_force"] == found["stiffness_in_force_least"]
    assert found["stiffness_in_force"] == pytest.approx(50.0)
    assert referent["stiffness_in_force"] == pytest.approx(stiffness)


def test_cap_of_a_law_that_is_evaluated_every_few_periods_is_that_of_its_period() -> None:
    struck: dict[str, object] = {"operator": ["grip"], "law": ["mean_force"], "model": ["drive"]}
    divided = plan_of(**struck, stiffness=[600.0], **{"wall.cap": [0.8], "wall.divider": [4]})
    plain = plan_of(**struck, stiffness=[600.0], **{"wall.cap": [0.05]})
    found, alike = (compute_piece(plan, 0)[0, 0] for plan in (divided, plain))
    assert found["referent_first_depth"] == alike["referent_first_depth"]


def test_model_lighter_than_its_rotor_is_refused() -> None:
    axes = {"servo": ["1600Hz"], "model": ["drive"], "simulation.shaft_hz": [400.0]}
    plan_of(**axes, model_error=[-0.8])
    with pytest.raises(ConfigError, match=r"model_error: with -0\.9 the model's inertia"):
        plan_of(**axes, model_error=[-0.9])


@pytest.mark.parametrize(
    ("axis", "values"),
    [
        ("simulation.current_bandwidth_hz", [800.0, 1600.0]),
        ("simulation.viscous_nm_s_per_rad", [1e-4, 1e-3]),
        ("friction", [0.0, 0.02]),
        ("servo", ["1600Hz", "800Hz"]),
        ("press_torque", [0.1, 0.2]),
        ("sync_jitter", [0.0, 1e-4]),
    ],
)
def test_numbers_of_plant_and_strike_are_axes(axis: str, values: list[object]) -> None:
    plan = plan_of(stiffness=[20.0], **{"simulation.ideal": [False], axis: values})
    one, other = (compute_piece(plan, piece)[0, 0] for piece in range(2))
    assert one["penetration"] != other["penetration"]


def test_stiction_goes_with_the_friction_of_an_axis() -> None:
    axes = {"servo": ["1600Hz"], "friction": [0.01, 0.02], "breakaway": [2.0]}
    plan = plan_of(stiffness=[20.0], **axes)
    found = [settings_at(plan.base, point).simulation for point in plan.points]
    assert [(s.coulomb_nm, s.stiction_nm) for s in found if s] == [(0.01, 0.02), (0.02, 0.04)]


class StoppedError(Exception):
    pass


def stop_after(count: int) -> Any:
    def progress(done: int, total: int) -> None:
        if done >= count:
            raise StoppedError

    return progress


@pytest.mark.slow
def test_an_interrupted_sweep_goes_on(tmp_path: Path) -> None:
    plan = plan_of(stiffness="1:100:40", operator=["none", "finger", "grip", "arm"])
    whole = sweep(plan, tmp_path / "whole.nc")
    output = tmp_path / "parts.nc"
    with pytest.raises(StoppedError):
        sweep(plan, output, workers=1, progress=stop_after(2))
    assert not output.exists()
    with pytest.raises(InputError, match="holds an unfinished sweep; --resume continues"):
        sweep(plan, output)
    other = plan_of(stiffness="1:100:41", operator=["none", "finger", "grip", "arm"])
    with pytest.raises(InputError, match="another configuration or other axes"):
        sweep(other, output, resume=True)
    said: list[int] = []
    resumed = sweep(plan, output, resume=True, progress=lambda done, total: said.append(done))
    assert said[0] >= 2
    assert resumed.identical(whole)
    assert read_sweep(output).identical(whole)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.nc", "whole.nc"]


def test_walls_rise_whatever_order_they_are_given_in() -> None:
    plan = plan_of(stiffness=[30.0, 10, 20.0], damping=[0.1, 0.0])
    assert plan.stiffness is not None
    assert plan.stiffness.values == (10, 20.0, 30.0)
    assert plan.damping.values == (0.0, 0.1)


@pytest.mark.parametrize(
    ("given", "ratio"), [({}, 0.5), ({"damping": "0"}, 0.0), ({"damping_normalised": 0.0}, 0.0)]
)
def test_a_damping_that_is_given_takes_the_place_of_the_ratio(
    given: dict[str, object], ratio: float
) -> None:
    plan = make_plan(settings_with({"wall.damping_ratio": 0.5}), {**SMALL, **given})
    assert plan.base.wall.damping_ratio == ratio


def test_a_plan_is_another_one_with_other_contents_of_its_files(tmp_path: Path) -> None:
    law, eds = tmp_path / "law.py", tmp_path / "drive.eds"
    text = "def force(wall):\n    return -wall.stiffness * wall.y\n"
    law.write_text(text)
    base = settings_with()
    eds.write_bytes(base.drive.eds.read_bytes())
    base = base.model_copy(update={"drive": base.drive.model_copy(update={"eds": eds})})
    plan = make_plan(base, {**SMALL, "law": [f"{law}:force"], "stiffness": [1.0]})
    known = [plan_json(plan)]
    law.write_text(f"{text}# another one\n")
    known.append(plan_json(plan))
    eds.write_bytes(eds.read_bytes() + b"\n")
    known.append(plan_json(plan))
    law.write_text(text)
    known.append(plan_json(plan))
    assert len(set(known)) == 4
    assert plan_json(plan) == known[-1]


def test_a_file_that_is_no_journal_is_left_alone(tmp_path: Path) -> None:
    partial = tmp_path / "a.nc.partial"
    partial.write_text("a letter")
    with pytest.raises(InputError, match="holds no unfinished sweep"):
        sweep(plan_of(stiffness=[1.0]), tmp_path / "a.nc", resume=True)
    assert partial.read_text() == "a letter"


@pytest.fixture
def _quick_to_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have hundreds of journals not wait for the disk."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.mark.slow
@pytest.mark.usefixtures("_quick_to_disk")
def test_a_journal_cut_short_by_a_power_cut_keeps_what_is_whole(tmp_path: Path) -> None:
    output = tmp_path / "a.nc"
    plan = plan_of(stiffness="1:100:3")
    journal = Journal(output, "plan", resume=False)
    piece = compute_piece(plan, 0)
    for number in range(3):
        journal.put(number, piece)
    journal.close()
    whole = journal.path.read_bytes()
    found = set()
    for size in range(len(whole) + 1):
        journal.path.write_bytes(whole[:size])
        again = Journal(output, "plan", resume=True)
        found.add(len(again.done()))
        for number in again.done():
            assert again.get(number, plan.dtype).tobytes() == piece.tobytes()
        again.put(3, piece)  # on a line of its own
        again.close()
        kept = Journal(output, "plan", resume=True)
        assert kept.done() == [*again.done()]
        kept.close()
    assert found == {0, 1, 2, 3}


def some_pieces(count: int) -> list[np.ndarray[Any, Any]]:
    random = np.random.default_rng(1)
    return [random.random(8).view([("force", "f8")]) for _ in range(count)]


@pytest.mark.slow
@pytest.mark.usefixtures("_quick_to_disk")
def test_a_damaged_journal_is_never_read_as_data(tmp_path: Path) -> None:
    """Whatever happens to the file: a piece is what was put in, or it is not there."""
    output, pieces = tmp_path / "a.nc", some_pieces(12)
    journal = Journal(output, "plan", resume=False)
    for number, piece in enumerate(pieces):
        journal.put(number, piece)
    journal.close()
    whole = journal.path.read_bytes()
    lines = whole.splitlines(keepends=True)
    random = np.random.default_rng(0)

    def flipped() -> bytes:
        data = bytearray(whole)
        for _ in range(random.integers(1, 4)):
            data[random.integers(len(data))] ^= 1 << random.integers(8)
        return bytes(data)

    def zeroed() -> bytes:
        start = random.integers(len(whole))
        end = start + random.integers(1, 400)
        return whole[:start] + bytes(len(whole[start:end])) + whole[end:]

    def shuffled() -> bytes:
        return b"".join([lines[0], *(lines[k] for k in random.integers(1, len(lines), 15))])

    def exchanged() -> bytes:
        """The content of one piece under the number of another."""
        words = [line.split(b" ") for line in lines[1:]]
        a, b = random.choice(len(words), 2, replace=False)
        words[a][0], words[b][0] = words[b][0], words[a][0]
        return lines[0] + b"".join(b" ".join(word) for word in words)

    def moved() -> bytes:
        start, end, to = np.sort(random.integers(len(whole), size=3))
        return whole[:start] + whole[end:to] + whole[start:end] + whole[to:]

    refused = lost = 0
    for mutation in (flipped, zeroed, shuffled, exchanged, moved):
        for _ in range(200):
            journal.path.write_bytes(mutation())
            try:
                again = Journal(output, "plan", resume=True)
            except InputError:
                refused += 1
                continue
            for number in again.done():
                piece = again.get(number, pieces[0].dtype)
                assert piece.tobytes() == pieces[number].tobytes()
            lost += len(again.done()) < len(pieces)
            again.close()
    assert refused > 0
    assert lost > 500


def test_a_piece_that_is_damaged_afterwards_is_told(tmp_path: Path) -> None:
    (piece,) = some_pieces(1)
    journal = Journal(tmp_path / "a.nc", "plan", resume=False)
    journal.put(0, piece)
    data = bytearray(journal.path.read_bytes())
    data[-5] ^= 1
    journal.path.write_bytes(data)
    with pytest.raises(InputError, match="piece 0 is damaged; --resume computes it again"):
        journal.get(0, piece.dtype)
    journal.close()


def test_a_journal_of_another_plan_is_not_read(tmp_path: Path) -> None:
    Journal(tmp_path / "a.nc", "plan", resume=False).close()
    with pytest.raises(InputError, match="another configuration or other axes"):
        Journal(tmp_path / "a.nc", "another plan", resume=True)


def foreign_database(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE letters (text TEXT)")
        database.execute("INSERT INTO letters VALUES ('a thesis')")
        database.commit()


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("kind", ["database", "link", "link to nowhere", "directory", "fifo"])
def test_what_is_no_journal_is_left_alone(tmp_path: Path, kind: str, resume: bool) -> None:
    partial, foreign = tmp_path / "a.nc.partial", tmp_path / "thesis"
    if kind == "database":
        foreign_database(partial)
    elif kind == "directory":
        partial.mkdir()
    elif kind == "fifo":
        os.mkfifo(partial)
    else:
        if kind == "link":
            foreign_database(foreign)
        partial.symlink_to(foreign)
    before = foreign.read_bytes() if foreign.exists() else b""
    own = partial.read_bytes() if kind == "database" else b""
    with pytest.raises(InputError, match="holds no unfinished sweep; remove it"):
        Journal(tmp_path / "a.nc", "plan", resume)
    assert (foreign.read_bytes() if foreign.exists() else b"") == before
    assert (partial.read_bytes() if kind == "database" else b"") == own


def test_two_sweeps_do_not_share_a_journal(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "a.nc", "plan", resume=False)
    with pytest.raises(InputError, match="another sweep is writing it; let that end"):
        Journal(tmp_path / "a.nc", "plan", resume=True)
    journal.close()
    Journal(tmp_path / "a.nc", "plan", resume=True).remove()


def test_a_full_disk_leaves_a_journal_that_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, pieces = tmp_path / "a.nc", some_pieces(3)
    journal = Journal(output, "plan", resume=False)
    room = journal.path.stat().st_size + 300  # one piece, and a part of the next
    write = os.write

    def write_what_fits(file: int, data: memoryview) -> int:
        fits = room - os.fstat(file).st_size
        if not fits:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, data[:fits])

    monkeypatch.setattr(os, "write", write_what_fits)
    journal.put(0, pieces[0])
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        journal.put(1, pieces[1])
    journal.close()
    monkeypatch.undo()
    again = Journal(output, "plan", resume=True)
    assert again.done() == [0]
    again.put(1, pieces[1])
    for number in (0, 1):
        assert again.get(number, pieces[0].dtype).tobytes() == pieces[number].tobytes()
    again.remove()
    room = 0
    monkeypatch.setattr(os, "write", write_what_fits)
    with pytest.raises(InputError, match="No space left on device"):
        Journal(output, "plan", resume=False)
    assert not journal.path.exists()  # nothing stands in the way of the next attempt


def workers_of(parent: int) -> list[int]:
    """Processes that compute for a sweep by frames."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    named = {child: Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    return [int(child) for child, line in named.items() if b"spawn_main" in line]


def is_alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_their_parent(tmp_path: Path, end: signal.Signals) -> None:
    words = ["--axis", "speed=0.5:2:40", "--axis", "phase=0:1:9", "--through", "bus"]
    sweeping = ForkedPopen[str](
        [COMMAND, "sweep", str(settings_file()), "--output", str(tmp_path / "a.nc"), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with sweeping:
        try:
            wait_for(lambda: sweeping.poll() is None and len(workers_of(sweeping.pid)) > 0)
            workers = workers_of(sweeping.pid)
            time.sleep(3.0)  # into its work, or still its start
        finally:
            sweeping.send_signal(end)
        wait_for(lambda: not any(map(is_alive, workers)))


@pytest.mark.slow
def test_a_worker_that_dies_is_one_line(tmp_path: Path) -> None:
    words = ["--axis", "speed=0.5:2:40", "--axis", "phase=0:1:9", "--through", "bus"]
    sweeping = ForkedPopen[str](
        [COMMAND, "sweep", str(settings_file()), "--output", str(tmp_path / "a.nc"), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with sweeping:
        try:
            wait_for(lambda: sweeping.poll() is None and len(workers_of(sweeping.pid)) > 0)
            os.kill(workers_of(sweeping.pid)[0], signal.SIGKILL)
            _, errors = sweeping.communicate(timeout=PATIENCE_S)
        finally:
            sweeping.kill()
    assert sweeping.returncode == 1
    hint = rf"(; --resume continues {tmp_path}/a\.nc)?"  # if a piece was done
    assert re.fullmatch(rf"canwall: a process that computes the sweep has died{hint}\n", errors)


def swept_once(
    folder: Path, text: str, law: str, *stiffness: str
) -> "subprocess.CompletedProcess[str]":
    """Sweep a law of one's own with one strike on each wall."""
    file = folder / "laws.py"
    file.write_text(text)
    return command(
        *("sweep", settings_file(), "--output", folder / "a.nc", "--law", f"{file}:{law}"),
        *("--axis", "speed=1", "--axis", "phase=0", *stiffness),
    )


RAISING = """def raising(wall):
    if wall.y < 0.0 and wall.stiffness > 50.0:
        raise ValueError("too stiff")
    return -wall.stiffness * min(wall.y, 0.0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [["--stiffness", "20,60,70"], []])
def test_a_law_that_raises_is_named_with_its_wall(tmp_path: Path, stiffness: list[str]) -> None:
    """To raise is no limit of its stiffness."""
    done = swept_once(tmp_path, RAISING, "raising", *stiffness)
    assert done.returncode == 1
    assert re.fullmatch(
        r"canwall: .*stiffness [5-9]\d[\d.]*, damping 0: cycle \d+: law \S+laws.py:raising raised "
        r"ValueError: too stiff \(laws.py, line 3\)\n",
        done.stderr,
    )


@pytest.mark.slow
@pytest.mark.parametrize("force", ["math.nan", "-math.inf"])
def test_a_law_whose_force_is_no_number_is_named_with_its_wall(tmp_path: Path, force: str) -> None:
    text = f"import math\n\ndef endless(wall):\n    return {force} if wall.y < 0.0 else 0.0\n"
    done = swept_once(tmp_path, text, "endless", "--stiffness", "20")
    assert done.returncode == 1
    assert re.fullmatch(
        r"canwall: .*stiffness 20, damping 0: cycle \d+: law \S+laws.py:endless gave a force that "
        r"is not a number\n",
        done.stderr,
    )


HANGING = """def hanging(wall):
    '''Does not return from walls that are stiff.'''
    if wall.stiffness > 50.0:
        while wall.y < 0.0:
            pass
    return -wall.stiffness * min(wall.y, 0.0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("through", ["sim", "bus"])
def test_a_law_that_does_not_return_is_named_with_its_point(tmp_path: Path, through: str) -> None:
    """Pieces of work that end are in the journal: those of the law that returns."""
    law, output = tmp_path / "laws.py", tmp_path / "a.nc"
    law.write_text(HANGING)
    done = command(
        *("sweep", settings_file(), "--output", output, "--through", through, "--workers", "1"),
        *("--law", "standard", "--law", f"{law}:hanging", "--stiffness", "20,60"),
        *("--axis", "speed=1", "--axis", "phase=0"),
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "stiffness 60, damping 0: cycle " in line
    assert f": law {law}:hanging has not returned for 0." in line
    assert line.endswith(f"; --resume continues {output}")
    (piece,) = (tmp_path / "a.nc.partial").read_text().splitlines()[1:]
    assert piece.startswith("0 ")


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"stiffness": "1:2"}, "axis stiffness: has to be a number, not '1:2'; a range is LO:HI:N"),
        ({"stiffness": "0:2:3"}, "a geometric range has to be above 0"),
        ({"stiffness": "1:2:0"}, "is not a range; write LO:HI:N"),
        ({"stiffness": "1,1"}, "axis stiffness: has a value twice"),
        ({"stiffness": ""}, "axis stiffness: has no values"),
        ({"operator": "giant"}, "has to be one of none, fingertip, finger, grip, hand, arm, not"),
        ({"model": "none"}, "has to be one of matched, drive, file, not 'none'"),
        ({"rate": "0"}, "axis rate: has to be greater than 0"),
        ({"simulation.coulomb": "1"}, "simulation.coulomb: unknown key; did you mean"),
        ({"simulation.coulomb_nm": "-1"}, "simulation.coulomb_nm: has to be greater than"),
        ({"simulation.coulomb_nm": "0,red"}, "simulation.coulomb_nm: has to be a valid number"),
        ({"nothing.at_all": "1"}, "nothing.at_all: there is no"),
        ({"law": "none"}, "wall.law: unknown law 'none'"),
        ({"wall.stiffness_nm_per_rad": "1"}, "use stiffness instead"),
        ({"simulation.hand.press_s": "0.1,0.5"}, "hand.press_s: use press instead"),
        ({"bus.cycle_s": "0.001,0.002"}, "bus.cycle_s: use rate instead"),
        ({"run.duration_s": "1,2"}, "run.duration_s: it changes nothing; leave it out"),
        ({"delay_error": "-1.5"}, "axis delay_error: -1.5 makes D = -0.5; it has to be between"),
        ({"friction": "-0.01"}, "axis friction: has to be at least 0"),
        ({"delay": "3.5"}, "axis delay: has to be at most 3"),
        ({"damping": "-1"}, "axis damping: has to be at least 0, not -1"),
        ({"rate": "1e8"}, "axis rate: has to be at most 100000, not"),
        ({"rate": "0.5"}, "sweep axis bus.cycle_s: has to be less than or equal to 1"),
        ({"press": "1e9"}, "a strike of .* cycles; 2000000 at most"),
        ({"stiffness": "1:2:99999999999"}, "99999999999 values; 1000000 at most"),
        ({"stiffness": "1:2:9999", "damping": "1:2:9999"}, "99980001 points; 10000000 at most"),
        ({"counts": "10.5"}, "has to be a whole number"),
        ({"torque_step": "1.5e-7"}, "whole µN·m"),
        ({"stiffness": "1", "stiffness_normalised": "1"}, "keep one of them"),
        ({"damping": "0.1", "wall.damping_ratio": "0.5"}, "and wall.damping_ratio: keep one"),
        ({"through": "bus", "sync_jitter": "1e-5"}, "sync_jitter: has to be 0 with --through bus"),
    ],
)
def test_a_wrong_axis(axes: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        plan_of(**axes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--axis", "colour=red"], "sweep axis colour: unknown; known are law, stiffness"),
        (["--axis", "speed"], "--axis speed: has to be NAME=VALUES"),
        (["--through", "air"], "--through air: has to be sim or bus"),
        (["--workers", "2", "--dask", "nowhere"], "--workers and --dask: keep one"),
        (["--output", "."], ".: has to end in .nc"),
        (["--output", ""], "Invalid value for '--output': is empty; give a file"),
        (["--stiffness", "10", "--axis", "stiffness=20"], "--stiffness and --axis stiffness: keep"),
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.parametrize("settled", [[[True, True], [True, False]], [[True, True]] * 2])
def test_strikes_that_never_settle_are_named(settled: list[list[bool]]) -> None:
    dims = ("law", "damping", "speed", "phase")
    names = ("limit", "ripple", "stiffness_in_force", "first_depth", "referent_first_depth")
    strikes = np.array(settled)[:, None, :, None]
    dataset = xr.Dataset(
        {name: (dims, np.ones(strikes.shape)) for name in names}
        | {"settled": (dims, strikes), "open_ended": (dims, np.zeros(strikes.shape, bool))}
        | {name: (dims[:2], np.ones((2, 1))) for name in ("worst", "worst_normalised")},
        {"law": ["a", "b"], "damping": [0.0], "speed": [1.0, 2.0], "phase": [0.0]},
    )
    columns = {str(column.header): list(column.cells) for column in sweep_table(dataset).columns}
    expected = None if np.all(settled) else ["0", "1"]
    assert columns.get("strikes not\nsettled") == expected


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
            "stiffness_in_force": (
                ("law", "damping", "stiffness", "speed", "phase"),
                np.tile(np.array([[[1.0]], [[2.0]], [[3.0]]]), (2, 2, 1, 1, 1)),
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
