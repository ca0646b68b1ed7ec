"""Records survive: killed processes, closed descriptors, full disks, and who reads them then."""

import json
import os
import shlex
import shutil
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

import matplotlib.image
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import (
    COMMAND,
    ON_A_BUSY_MACHINE,
    PATIENCE_S,
    Record,
    Start,
    command,
    config_file,
    python,
    torque_is_on,
    wait_for,
)

from canwall import config
from canwall.config import ConfigError
from canwall.record import RunFolder, read_signals
from canwall.record.folder import stream_of
from canwall.record.pictures import DRAWN
from canwall.run import read_run

#: A hand that stays on the wall of an embedded drive.
IN_CONTACT = ON_A_BUSY_MACHINE | {
    'interface = "unixcan"': 'interface = "virtual"',
    'channel = "/tmp/canwall.sock"': 'channel = "canwall"',
    "press_s = 0.5": "press_s = 3000.0",
    "strikes = 4\n": "strikes = 1\n",
    "interval_s = 1.0": "interval_s = 4000.0",
    "duration_s = 4.2": "# until Ctrl-C",
}

CUT_OFF = "the run did not end by itself: it was cut off while rendering, after cycle"


def in_contact(start: Start, tmp_path: Path) -> "tuple[subprocess.Popen[str], RunFolder]":
    """A run in contact, and its folder."""
    file = config_file(tmp_path / "c.toml", IN_CONTACT, config.shipped("config/unixcan.toml"))
    folder = RunFolder(tmp_path / "run")
    run = start(COMMAND, "run", file, "--output", folder.path)
    wait_for(lambda: torque_is_on(folder.path / "bus.log"))
    wait_for(lambda: read_signals(folder.signals).num_rows > 300)
    return run, folder


def writer_of(process: "subprocess.Popen[str]") -> int:
    """Process number of the writer of a run's record."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    (writer,) = (int(child) for child in children if _has_ring(child))
    return writer


def _has_ring(process: str) -> bool:
    descriptors = Path(f"/proc/{process}/fd").glob("*")
    return any("canwall-record" in os.readlink(descriptor) for descriptor in descriptors)


def one_line(text: str) -> str:
    (line,) = without_compiling(text)
    return line


def without_compiling(text: str) -> list[str]:
    """The lines without that of a first start."""
    return [line for line in text.splitlines() if "compiling for this machine" not in line]


@pytest.mark.slow
@pytest.mark.parametrize("writer_too", [False, True], ids=["master", "master and writer"])
def test_killed_run_is_plotted(start: Start, tmp_path: Path, writer_too: bool) -> None:
    run, folder = in_contact(start, tmp_path)
    victims = [writer_of(run)] if writer_too else []
    for victim in (*victims, run.pid):
        os.kill(victim, signal.SIGKILL)
    run.wait(PATIENCE_S)
    wait_for(lambda: not folder.is_being_written)
    assert stream_of(folder.signals).exists() is writer_too
    rows = read_signals(folder.signals).num_rows
    done = command("plot", folder.path)
    assert (done.returncode, done.stdout) == (0, f"{folder.picture}\n")
    assert one_line(done.stderr).startswith(f"canwall: {folder.path}: {CUT_OFF} {rows - 1} (")
    assert matplotlib.image.imread(folder.picture).min() < 0.5
    summary = folder.read_summary()
    assert summary["cycles"] == rows
    assert summary["cut_off"]
    assert summary["trip_cycle"] == rows - 1
    assert len(summary["strikes"]) == 1
    assert len(folder.trip.read_text().splitlines()) == 1 + min(rows, 200)
    # Again: it says the same, and leaves the summary as it is.
    before = folder.summary.stat()
    again = command("plot", folder.path)
    assert (again.returncode, one_line(again.stderr)) == (0, one_line(done.stderr))
    assert folder.summary.stat().st_mtime_ns == before.st_mtime_ns


@pytest.mark.slow
def test_run_in_progress_is_plotted_and_left_alone(start: Start, tmp_path: Path) -> None:
    run, folder = in_contact(start, tmp_path)
    done = command("plot", folder.path)
    assert (done.returncode, done.stdout) == (0, f"{folder.picture}\n")
    assert one_line(done.stderr) == (
        f"canwall: {folder.path}: the run is in progress; this is what there is so far"
    )
    assert not folder.summary.exists()
    assert not folder.trip.exists()
    run.send_signal(signal.SIGINT)
    assert run.wait(PATIENCE_S) == 130
    done = command("plot", folder.path)
    assert (done.returncode, done.stderr) == (0, "")
    assert not folder.read_summary()["cut_off"]


def copy_of(run: Path, folder: Path, *names: str) -> RunFolder:
    folder.mkdir()
    for name in names:
        shutil.copy(run / name, folder / name)
    return RunFolder(folder)


def test_summary_from_the_rows_is_that_of_the_run(four_strikes: Record, tmp_path: Path) -> None:
    kept = ("signals.parquet", "config.toml", "bus.log")
    folder = copy_of(four_strikes.folder, tmp_path / "run", *kept)
    found, first = read_run(folder).summary, four_strikes.summary
    assert found == folder.read_summary()
    of_the_end = {"cut_off", "trips", "trip_cycle", "drive", "timing"}
    of_the_end |= {"guard", "late_rpdo", "late_tpdo", "tpdo_lag_cycles", "skipped_sync"}
    assert {k: v for k, v in found.items() if k not in of_the_end} == {
        k: v for k, v in first.items() if k not in of_the_end
    }
    for name, value in found["drive"].items():
        assert value == pytest.approx(first["drive"][name], rel=1e-15)
    for name in ("sync_interval", "tpdo_to_rpdo"):
        for percentile, value in found["timing"][name].items():
            assert value == pytest.approx(first["timing"][name][percentile], rel=1 / 16, abs=0.1)
    # To every key that a run has there is an answer, if only that it is not known.
    assert found.keys() == first.keys()


@pytest.mark.parametrize("end", [0, 1, 40, 100_000])
def test_log_that_was_cut_anywhere(four_strikes: Record, tmp_path: Path, end: int) -> None:
    kept = ("signals.parquet", "config.toml", "bus.log")
    folder = copy_of(four_strikes.folder, tmp_path / "run", *kept)
    os.truncate(folder.path / "bus.log", end)
    assert read_run(folder).summary["error_frames"] == 0


def test_summary_that_is_something_else_is_not_overwritten(
    four_strikes: Record, tmp_path: Path
) -> None:
    folder = copy_of(four_strikes.folder, tmp_path / "run", "signals.parquet", "config.toml")
    deep = "[" * 100_000
    for text in ("[]", "{}", '{"strikes": 5}', '{"strikes": [5]}', '{"strikes": [{}]}', "", deep):
        folder.summary.write_text(text)
        with pytest.raises(ConfigError, match=r"summary.json: not a summary of a run") as error:
            read_run(folder)
        assert len(str(error.value)) < 300
        assert folder.summary.read_text() == text


def test_damaged_rows_are_not_read_as_data(four_strikes: Record, tmp_path: Path) -> None:
    """Parquet pages have a checksum, so that a flipped bit in a row is found.

    One in the name of a column is found by who requires the column.
    """
    folder = copy_of(four_strikes.folder, tmp_path / "run", "signals.parquet", "config.toml")
    whole = folder.signals.read_bytes()
    signals = read_signals(folder.signals)
    random = np.random.default_rng(0)
    found = 0
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[random.integers(len(whole))] ^= 1 << random.integers(8)
        folder.signals.write_bytes(damaged)
        try:
            assert read_signals(folder.signals, signals.column_names).equals(signals)
        except ConfigError:
            found += 1
    assert found > 50


@pytest.mark.slow
def test_any_flipped_bit_that_costs_rows_is_found(tmp_path: Path) -> None:
    rows = pa.table({"j": pa.array(range(40), pa.int64())})
    path = tmp_path / "signals.parquet"
    pq.write_table(rows, path, write_page_checksum=True)
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with suppress(ConfigError):
            assert read_signals(path).equals(rows), bit


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        *(("y", value, "column y has values of no run") for value in (np.inf, np.nan, -1e300)),
        ("position_rad", -1e30, "counts_per_rev has to be positive"),
        ("phase", 77, r".*77.* is not a valid Phase"),
    ],
)
def test_damaged_rows_of_a_stream_are_no_run(
    four_strikes: Record, tmp_path: Path, name: str, value: float, said: str
) -> None:
    """A stream of rows, of a run that was cut off, has no checksums."""
    folder = copy_of(four_strikes.folder, tmp_path / "run", "config.toml")
    values = four_strikes.column(name).copy()
    values[:] = value
    column = four_strikes.signals.schema.get_field_index(name)
    kind = four_strikes.signals.schema.field(name)
    damaged = four_strikes.signals.set_column(column, kind, pa.array(values, kind.type))
    with pa.ipc.new_stream(stream_of(folder.signals), damaged.schema) as stream:
        stream.write_table(damaged)
    with pytest.raises(ConfigError, match=f"damaged: {said}"):
        read_run(folder, DRAWN)
    assert not folder.summary.exists()


def test_stream_with_a_damaged_name_is_no_record(four_strikes: Record, tmp_path: Path) -> None:
    folder = copy_of(four_strikes.folder, tmp_path / "run", "config.toml")
    stream = stream_of(folder.signals)
    with pa.ipc.new_stream(stream, four_strikes.signals.schema) as file:
        file.write_table(four_strikes.signals)
    stream.write_bytes(stream.read_bytes().replace(b"y_est", b"y\xefest"[:5]))
    with pytest.raises(ConfigError, match="not a record of a run"):
        read_run(folder)


def test_rows_of_another_kind_are_no_record(four_strikes: Record, tmp_path: Path) -> None:
    folder = copy_of(four_strikes.folder, tmp_path / "run", "config.toml")
    signals = four_strikes.signals
    column = signals.column_names.index("y")
    text = pa.array(["deep"] * signals.num_rows)
    pq.write_table(signals.set_column(column, "y", text), folder.signals)
    with pytest.raises(ConfigError, match="column y holds string, not double"):
        read_run(folder)


def test_record_without_rows_is_told_beside_a_summary_as_well(
    four_strikes: Record, tmp_path: Path
) -> None:
    folder = copy_of(four_strikes.folder, tmp_path / "run", "config.toml", "summary.json")
    signals = four_strikes.signals
    pq.write_table(signals.slice(0, 0), folder.signals)
    with pytest.raises(ConfigError, match="no cycle was recorded"):
        read_run(folder)


# Standard streams that are closed


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&-", "<&- >&- 2>&-"])
def test_streams_that_are_closed_at_start(tmp_path: Path, closed: str) -> None:
    line = f"exec {shlex.quote(COMMAND)} run --duration 0.5 --output run {closed}"
    done = subprocess.run(
        ["sh", "-c", line], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert (done.returncode, without_compiling(done.stderr)) == (0, [])
    record = Record(tmp_path / "run")
    assert record.signals.num_rows == record.summary["cycles"] > 500
    assert (tmp_path / "run" / "run.png").exists()
    assert len(record.cycles) == record.signals.num_rows


@pytest.mark.slow
def test_output_that_cannot_be_written(tmp_path: Path) -> None:
    line = f'exec {shlex.quote(COMMAND)} run --duration 0.1 --output "$0"'
    told = ["canwall: standard output cannot be written: No space left on device"]
    for n, (streams, code, said) in enumerate(
        [
            (">/dev/full", 1, told),
            ("--json >/dev/full", 1, told),
            (">/dev/full 2>/dev/full", 1, []),
            ("| true", 0, []),
        ]
    ):
        words = ["bash", "-o", "pipefail", "-c", f"{line} {streams}", str(tmp_path / f"run{n}")]
        if streams.startswith("|"):
            words[4] = words[4].removeprefix("exec ")
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S)
        assert (done.returncode, without_compiling(done.stderr)) == (code, said)
        assert Record(tmp_path / f"run{n}").summary["cycles"] > 100


# A writer that ends before its run


@pytest.mark.slow
def test_run_ends_with_its_writer(start: Start, tmp_path: Path) -> None:
    run, folder = in_contact(start, tmp_path)
    os.kill(writer_of(run), signal.SIGKILL)
    _, errors = run.communicate(timeout=PATIENCE_S)  # by itself
    assert run.returncode == 1
    record = f"{folder.path}: the record is incomplete: the writer of the record has died"
    assert f"canwall: {record}" in errors.splitlines()
    assert errors.count(record) == 1
    summary = folder.read_summary()
    assert summary["trips"] == [record]
    assert summary["cycles"] == read_signals(folder.signals).num_rows


# A disk that is full at any moment


def assert_told_and_readable(done: "subprocess.CompletedProcess[str]", folder: RunFolder) -> None:
    lines = done.stderr.splitlines()
    assert done.returncode in (1, 2), done.stderr
    assert lines
    assert all(line.startswith("canwall: ") for line in lines), done.stderr
    assert len(lines) == len(set(lines))
    assert not list(folder.path.glob(".*"))
    for name in ("summary.json", "live.json"):
        if (folder.path / name).exists():
            json.loads((folder.path / name).read_text())
    try:
        signals = read_signals(folder.signals)
    except ConfigError:
        return
    j = signals["j"].to_numpy()
    assert np.array_equal(j, np.arange(len(j)))
    if len(j) and folder.config.exists():
        assert read_run(folder).summary["cycles"] == len(j)


#: Bytes that a file may have: each file of a run is the first that is too large for some of them.
SIZES = [0, 10, 500, 3000, 8000, 20_000, 40_000, 70_000, 100_000, 150_000]

#: `canwall`, whose files cannot be larger. Shared memory counts as a file.
WITH_SMALL_FILES = """
import resource, sys
from canwall import cli
from canwall.record import Ring

create, size = Ring.create, int(sys.argv.pop(1))

def limited():
    ring = create()
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    return ring

Ring.create = limited
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
def test_no_file_can_be_larger(tmp_path: Path, size: int) -> None:
    folder = RunFolder(tmp_path / "run")
    done = python("-c", WITH_SMALL_FILES, size, "run", "--duration", 1, "--output", folder.path)
    assert_told_and_readable(done, folder)


@pytest.mark.slow
def test_no_shared_memory(tmp_path: Path) -> None:
    shell = f'ulimit -f 100; exec {shlex.quote(COMMAND)} run --duration 0.1 --output "$0"'
    words = ["sh", "-c", shell, str(tmp_path / "run")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 1
    assert one_line(done.stderr).startswith("canwall: the writer of the record does not start: ")


#: Sizes of a disk [kB] that is full at different moments of a run.
DISKS = [4, 16, 40, 100, 200, 300]

ON_A_DISK = """
mount -t tmpfs -o size="$1k" none "$2" || exit 77
"$0" run --duration 1 --output "$2/run"
code=$?
cp -r "$2/run" "$3"
exit $code
"""


@pytest.mark.slow
@pytest.mark.parametrize("size", DISKS)
def test_full_disk(tmp_path: Path, size: int) -> None:
    disk, copy = tmp_path / "disk", tmp_path / "copy"
    disk.mkdir()
    arguments = [COMMAND, str(size), str(disk), str(copy)]
    words = ["unshare", "--mount", "--map-root-user", "sh", "-c", ON_A_DISK, *arguments]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S)
    if done.returncode == 77 or "unshare failed" in done.stderr:
        pytest.skip("no mounts of its own on this machine")
    assert_told_and_readable(done, RunFolder(copy))
