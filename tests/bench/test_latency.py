"""`canwall latency`: measurement, report, and a drive that stays as it was."""

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colour_vision import assert_nothing_overlaps, assert_readable, assert_told_apart
from commands import COMMAND, Start, call, command, config_file, wait_for
from matplotlib.figure import Figure
from matplotlib.image import imread
from rig import eds_with

import canwall.bench
from canwall import config, simdrive
from canwall.bench import latency as latency_module
from canwall.bench.budget import Budget, BudgetFrame, bus_budget
from canwall.bench.latency import Histogram, Latency, LatencyPhase, measure_latency, shortest_cycle
from canwall.bench.latency_report import QUANTITIES, percentiles_us, report_lines, write_latency
from canwall.config import Settings
from canwall.cycle import HISTOGRAM, Grant, observe_ns
from canwall.drive import DriveError
from canwall.errors import InputError, RunFailedError
from canwall.run import StopRequest, buses

REAL_TIME = {"bus.interface": "socketcan", "bus.channel": "can0"}
READ_ONLY = 0x06010002.to_bytes(4, "little")
GRANTED = {"scheduling": Grant("SCHED_FIFO, priority 45")}


@pytest.fixture
def drives(monkeypatch: pytest.MonkeyPatch) -> "list[Listening]":
    """Every simulated drive that is made, and what it has heard."""
    made: list[Listening] = []
    make = buses.make_simulated_drive

    def listened(settings: Settings) -> simdrive.FaultyDrive:
        drive = make(settings)
        made.append(Listening(drive))
        return drive

    monkeypatch.setattr(buses, "make_simulated_drive", listened)
    monkeypatch.setattr(latency_module, "_SETTLING_S", 0.02)
    return made


class Listening:
    def __init__(self, drive: simdrive.FaultyDrive) -> None:
        self.drive = drive
        self._process = drive.process
        self.heard: list[tuple[int, bytes]] = []
        self.mute = False
        #: Lets nobody write the quick stop's option, from the first RPDO on.
        self.refusing = False
        self.also: list[simdrive.Frame] = []  # sent after the next SYNC, by whomever
        self._served = False
        drive.process = self._noted  # type: ignore[method-assign]

    def _noted(self, can_id: int, data: bytes) -> list[simdrive.Frame]:
        self.heard.append((can_id, data))
        self._served |= can_id == 0x205
        if (
            self.refusing
            and self._served
            and can_id == 0x605
            and data[0] >> 5 == 1
            and data[1:3] == b"\x07\x60"
        ):
            return [(0x585, b"\x80" + data[1:4] + READ_ONLY)]
        frames = self._process(can_id, data)
        if can_id == 0x080:
            frames, self.also = [*frames, *self.also], []
        return [frame for frame in frames if not (self.mute and frame[0] == 0x185)]


def settings_of(exchange: str, overrides: dict[str, Any] | None = None) -> Settings:
    given = {"bus.exchange": exchange} | (overrides or {})
    return config.load(config.shipped("config/sim.toml"), given)


@pytest.mark.slow
@pytest.mark.parametrize("exchange", ["python-can", "native"])
def test_measured_without_torque_and_put_back(exchange: str, drives: list[Listening]) -> None:
    told: list[tuple[str, float, float]] = []
    found = measure_latency(
        settings_of(exchange),
        0.1,
        1,
        1,
        StopRequest(),
        progress=lambda *part: told.append(part),
    )
    assert found is not None
    assert found.exchange == exchange
    assert [phase.name for phase in found.phases] == ["idle", "load"]
    for phase in found.phases:
        assert phase.cycles == 100
        for quantity in QUANTITIES:
            assert quantity.of(phase).counts.sum() == 100
        # From the SYNC to the RPDO there is the way from the TPDO to it.
        assert phase.sync_to_rpdo.max_us >= phase.tpdo_to_rpdo.p50_us > 0.0
    assert {name for name, _, _ in told} == {"idle", "load"}
    assert all(0.0 <= now <= end == pytest.approx(0.1) for _, now, end in told)
    (listening,) = drives
    rpdos = {data for can_id, data in listening.heard if can_id == 0x205}
    assert rpdos == {bytes(4)}  # neither enabled nor with a torque
    assert found.not_restored == ()
    upload = b"\x40\x00\x14\x05\0\0\0\0"  # the RPDO's event timer, a watchdog while it was measured
    answers = [data for can_id, data in listening._process(0x605, upload) if can_id == 0x585]
    assert answers[0][4:6] == b"\0\0"


def test_drive_that_does_not_answer_the_sync(drives: list[Listening]) -> None:
    def mute(what: str) -> None:
        drives[0].mute = True

    with pytest.raises(RunFailedError, match=r"no TPDO \(0x185\) for \d+ SYNCs"):
        measure_latency(settings_of("python-can"), 0.1, 0, 0, StopRequest(), report=mute)


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        ((0x080, b""), r"somebody else sends SYNC \(0x080\) as well: end it"),
        ((0x205, bytes(4)), r"somebody else sends RPDOs \(0x205\) to the drive as well"),
        ((0x000, b"\x02\x05"), r"somebody else has sent NMT STOP \(0x000\)"),
        ((0x705, b"\x00"), "the drive restarted, or a second one with its node-ID started"),
    ],
)
def test_what_disturbs_the_measurement_ends_it(
    frame: simdrive.Frame, said: str, drives: list[Listening]
) -> None:
    def disturb(what: str, now_s: float, end_s: float) -> None:
        if now_s > 0.05:
            drives[0].also = [frame]

    with pytest.raises(RunFailedError, match=rf"SYNC \d+: {said}"):
        measure_latency(settings_of("python-can"), 0.2, 0, 0, StopRequest(), progress=disturb)


def test_emergency_is_told_of_a_drive_that_sends_no_tpdo(drives: list[Listening]) -> None:
    def mute(what: str) -> None:
        drives[0].mute = True
        drives[0].also = [(0x085, b"\x20\x32\x05" + bytes(5))]

    with pytest.raises(RunFailedError, match=r"no TPDO \(0x185\) for \d+ SYNCs; EMCY 0x3220"):
        measure_latency(settings_of("python-can"), 0.1, 0, 0, StopRequest(), report=mute)


def test_stopped_in_between(drives: list[Listening]) -> None:
    stop = StopRequest()

    def ask(what: str, now_s: float, end_s: float) -> None:
        stop.count = 1

    assert measure_latency(settings_of("native"), 60.0, 0, 0, stop, progress=ask) is None
    (listening,) = drives
    assert {data for can_id, data in listening.heard if can_id == 0x205} == {bytes(4)}


NOT_RESTORED = "node 5: not restored: writing 0x1 to 0x6007:00 failed"


def test_what_cannot_be_put_back_is_said(drives: list[Listening]) -> None:
    def refuse(what: str, now_s: float, end_s: float) -> None:
        drives[0].refusing = True

    found = measure_latency(
        settings_of("native"),
        *(0.1, 0, 0, StopRequest()),
        progress=refuse,
    )
    assert found is not None
    (line,) = found.not_restored
    assert line.startswith(NOT_RESTORED)


def test_what_cannot_be_put_back_is_said_where_it_was_stopped(drives: list[Listening]) -> None:
    stop = StopRequest()

    def ask(what: str, now_s: float, end_s: float) -> None:
        drives[0].refusing = True
        stop.count = 1

    with pytest.raises(DriveError, match=f"interrupted; {NOT_RESTORED}"):
        measure_latency(settings_of("native"), 60.0, 0, 0, stop, progress=ask)


def test_what_cannot_be_put_back_is_said_where_it_failed(drives: list[Listening]) -> None:
    def mute(what: str) -> None:
        drives[0].refusing = True
        drives[0].mute = True

    with pytest.raises(RunFailedError, match="no TPDO") as failed:
        measure_latency(settings_of("python-can"), 0.1, 0, 0, StopRequest(), report=mute)
    (note,) = failed.value.__notes__
    assert note.startswith(NOT_RESTORED)


# The shortest cycle


def histogram(*values_us: float) -> Histogram:
    counted = np.zeros(1, HISTOGRAM)
    for value in values_us:
        observe_ns(counted, round(value * 1e3))
    return Histogram.of(counted)


def phase(name: str, sync_to_rpdo_us: float, missed: int = 0) -> LatencyPhase:
    many = [histogram(*[value] * 1000) for value in (5.0, 10.0, sync_to_rpdo_us)]
    return LatencyPhase(name, 1000, missed, 0, *many)


def budget(settings: Settings) -> Budget:
    frames = (BudgetFrame("TPDO", 0x185, 8),), (BudgetFrame("RPDO", 0x205, 4),)
    sync = BudgetFrame("SYNC", 0x80, 0)
    return bus_budget(sync, *frames, settings.bus.bitrate, settings.bus.cycle_s)


def bench_settings(**bus: object) -> Settings:
    given = REAL_TIME | {f"bus.{key}": value for key, value in bus.items()}
    return config.load(config.shipped("config/sim.toml"), given)


def test_bus_that_bounds_the_cycle() -> None:
    settings = bench_settings(bitrate=125_000, cycle_s=0.005)
    found = shortest_cycle([phase("idle", 200.0)], budget(settings), settings, GRANTED)
    # 55 + 135 + 95 bits at worst, of which 80 % of the bus may be used.
    bits = 55 + 135 + 95
    assert budget(settings).bits == bits
    assert found.by_bus_s == pytest.approx(bits / 125e3 / 0.8, rel=0.01)
    assert found.holds_s == math.ceil(found.by_bus_s * 1e5) / 1e5
    assert found.text.startswith("holds a cycle of 2.8")
    assert "limited by the bus: a cycle has 285 bits, and 80% of 125 kbit/s" in found.text


def test_machine_that_bounds_the_cycle() -> None:
    settings = bench_settings()
    parts = [phase("idle", 100.0), phase("load", 700.0)]
    found = shortest_cycle(
        parts, budget(settings), settings, {"scheduling": Grant("no real-time priority")}
    )
    assert found.by_machine_s == pytest.approx(700e-6 + 95e-6, rel=1 / 32)
    assert found.holds_s >= found.by_machine_s
    assert "(under load), most of it waiting for the TPDO, without real-time priority" in found.text


def test_bus_without_a_bit_rate_has_the_time_of_a_wire_added() -> None:
    on_a_wire, without = bench_settings(), bench_settings(channel="vcan0")
    both = [
        shortest_cycle([phase("idle", 700.0)], budget(settings), settings, GRANTED).by_machine_s
        for settings in (on_a_wire, without)
    ]
    assert both[1] - both[0] == pytest.approx((55 + 135) * 1e-6)


def test_cycle_that_is_too_short() -> None:
    settings = bench_settings()
    parts = [phase("load", 1500.0)]
    found = shortest_cycle(parts, budget(settings), settings, GRANTED)
    assert found.text.startswith("does not hold 1 ms, but a cycle of 1.")
    missing = shortest_cycle([phase("idle", 100.0, missed=20)], budget(settings), settings, GRANTED)
    assert missing.holds_s == math.inf
    assert missing.text.startswith("not even bus.cycle_s = 0.001 is held: 2.00% of the TPDOs")


# What is shown and written


def measured() -> Latency:
    settings = bench_settings()
    counted = [
        LatencyPhase(
            name,
            4,
            0,
            1,
            histogram(0.5, 3.0, 3.0, worst),
            histogram(8.0, 9.0, 11.0, 12.0),
            histogram(40.0, 45.0, 70.0, 1200.0),
        )
        for name, worst in (("idle", 4.0), ("load", 300.0))
    ]
    known = budget(settings)
    found = shortest_cycle(counted, known, settings, GRANTED)
    return Latency(
        "socketcan",
        "can0",
        1_000_000,
        0.001,
        "native",
        GRANTED,
        "none",
        tuple(counted),
        known,
        found,
        (),
    )


def test_histograms_as_text() -> None:
    text = list(report_lines(measured()))
    error = [line.split() for line in text if line.startswith("       2 – 5")]
    assert [word for word in error[0] if word.isdigit()][2:] == ["3", "2"]  # of idle, of load
    # What is late has no margin left; it is in the same bins, from the next SYNC backwards.
    late = next(line for line in text if line.startswith("   -1000 – 0"))
    assert [word for word in late.split() if word.isdigit()][-2:] == ["1", "1"]
    in_time = next(line for line in text if line.startswith("     950 – 980"))
    assert [word for word in in_time.split() if word.isdigit()][2:] == ["2", "2"]
    assert any("min -200.0" in line for line in text)


def test_margin_is_what_is_left_of_the_period() -> None:
    found = measured()
    margin = percentiles_us(found, QUANTITIES[2], found.phases[0])
    taken = found.phases[0].sync_to_rpdo
    assert margin["p50"] == 1000.0 - taken.p50_us
    assert margin["min"] == 1000.0 - 1200.0


def test_files(tmp_path: Path) -> None:
    found = measured()
    paths = write_latency(found, tmp_path / "out")
    assert [path.name for path in paths] == ["latency.json", "latency.csv", "latency.png"]
    numbers = json.loads(paths[0].read_text())
    assert numbers["verdict"] == found.shortest_cycle.text
    assert numbers["phases"]["load"]["rpdo_margin_us"]["min"] == -200.0
    with paths[1].open() as file:
        rows = list(csv.DictReader(file))
    for quantity in ("sync_error", "tpdo_to_rpdo", "sync_to_rpdo"):
        for name in ("idle", "load"):
            of_it = [r for r in rows if (r["quantity"], r["phase"]) == (quantity, name)]
            assert sum(int(row["cycles"]) for row in of_it) == 4
    assert imread(paths[2]).shape[1] == 1280


@pytest.fixture
def picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Latency], Figure]:
    def draw(found: Latency) -> Figure:
        drawn: list[Figure] = []
        monkeypatch.setattr(Figure, "savefig", lambda self, path: drawn.append(self))
        write_latency(found, tmp_path)
        return drawn[0]

    return draw


def test_missed_tpdos_are_visible(picture: Callable[[Latency], Figure]) -> None:
    found = measured()
    nothing = np.zeros(1, HISTOGRAM)
    load = replace(
        found.phases[1],
        cycles=3000,
        missed_tpdo=3000,
        late_rpdo=0,
        tpdo_to_rpdo=Histogram.of(nothing),
        sync_to_rpdo=Histogram.of(nothing),
    )
    figure = picture(replace(found, phases=(found.phases[0], load)))
    missed = next(
        axes for axes in figure.axes if axes.get_title("left") == "Missed and late frames"
    )
    assert "load: 3000 of 3000" in [text.get_text() for text in missed.texts]
    assert max(bar.get_width() for bar in missed.patches) == 100.0
    response = next(axes for axes in figure.axes if axes.get_title("left") == "TPDO → RPDO")
    legend = response.get_legend()
    assert legend is not None
    assert legend.get_texts()[1].get_text() == "load: no cycle had one"


def test_axes_say_that_they_are_logarithmic(picture: Callable[[Latency], Figure]) -> None:
    figure = picture(measured())
    for axes in figure.axes:
        for scale, label in (
            (axes.get_xscale(), axes.get_xlabel()),
            (axes.get_yscale(), axes.get_ylabel()),
        ):
            assert (scale == "log") == ("logarithmic" in label)
    assert_told_apart(figure)
    assert_readable(figure)
    assert_nothing_overlaps(figure)
    # Legends lie below their axes, where no peak is.
    for axes in figure.axes[:3]:
        legend = axes.get_legend()
        assert legend is not None
        assert legend.get_window_extent().y1 < axes.get_window_extent().y0


def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"--output .*file/x: Not a directory"):
        write_latency(measured(), tmp_path / "file" / "x")


# The command


@pytest.mark.slow
def test_command_over_unixcan(start: Start, tmp_path: Path) -> None:
    file = config_file(
        tmp_path / "c.toml",
        {
            'channel = "/tmp/canwall.sock"': f'channel = "{tmp_path / "bus"}"',
            "[drive]": "[drive]\nsdo_timeout_s = 10.0",  # other tests run beside this one
        },
        config.shipped("config/unixcan.toml"),
    )
    drive = start(COMMAND, "drive", file)
    assert drive.stdout is not None
    drive.stdout.readline()
    done = command(
        *("latency", file, "--duration", "0.2", "--load", "1", "--output", tmp_path / "out")
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "exchange native; the drive is set up but not enabled" in done.stdout
    assert done.stdout.splitlines()[-1].startswith(("holds", "does not hold", "not even"))
    assert (tmp_path / "out" / "latency.png").exists()


@pytest.mark.slow
def test_command_that_cannot_put_the_drive_back(tmp_path: Path) -> None:
    # The drive begins with an inhibit time that nobody may write.
    odd = {("1800sub3", "DefaultValue"): "20\nHighLimit=10"}
    eds = eds_with(tmp_path / "odd.eds", odd)
    done = command("latency", "--eds", eds, "--duration", "0.1", "--load", "0")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("canwall: node 5: not restored: writing 0x14 to 0x1800:03")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("missing.toml",), "missing.toml"),
        (("--exchange", "other"), "bus.exchange"),
        (("--duration", "0"), "--duration"),
        (("--load", "-1"), "--load"),
        (("--load", "257"), "--load"),
        (("--threads", "257"), "--threads"),
    ],
)
def test_bad_input(arguments: tuple[str, ...], said: str) -> None:
    done = command("latency", *arguments)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert said in line


def test_output_is_checked_before_the_measurement(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(canwall.bench, "measure_latency", lambda *args: pytest.fail("measured"))
    taken = tmp_path / "latency.csv"
    taken.write_text("mine")
    for folder, said in (
        (tmp_path, "holds latency.csv already; choose another --output"),
        (taken, "File exists; choose another folder"),
        (taken / "x", "Not a directory; choose another folder"),
    ):
        assert call("latency", "--output", folder) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.endswith(f"{folder}: {said}")
    assert taken.read_text() == "mine"


def test_verdict_is_told_whatever_the_output_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "out"

    def lose_the_folder(*args: object) -> Latency:
        folder.rmdir()
        folder.touch()
        return measured()

    monkeypatch.setattr(canwall.bench, "measure_latency", lose_the_folder)
    assert call("latency", "--output", folder) == 2
    out, errors = capsys.readouterr()
    assert out.splitlines()[-1] == measured().shortest_cycle.text
    assert errors == f"canwall: --output {folder}: File exists; choose another folder\n"


@pytest.mark.slow
def test_ctrl_c(start: Start) -> None:
    running = start(COMMAND, "latency", "--duration", "3600", "--load", "1", "--exchange", "native")
    # Its ring is there: it has begun.
    wait_for(lambda: "canwall-record" in Path(f"/proc/{running.pid}/maps").read_text())
    running.send_signal(2)
    _, errors = running.communicate(timeout=60.0)
    assert running.returncode == 130
    assert errors.splitlines() == ["canwall: interrupted; the drive is as it was before"]
