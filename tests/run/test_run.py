"""The main job in processes of its own: what a run leaves, and who may share machine and bus."""

import itertools
import math
import re
import signal
import struct
import subprocess
import sys
from pathlib import Path

import can
import canopen
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus
from commands import (
    COMMAND,
    GUARD_SAID,
    ON_A_BUSY_MACHINE,
    PATIENCE_S,
    STOPPED_SAID,
    Record,
    Start,
    command,
    config_file,
    is_enabled,
    read_log,
    same_signals,
    torque_is_on,
    wait_for,
)
from rig import (
    RPDO1,
    SDO_ANSWER,
    SDO_REQUEST,
    SIM_CONFIG,
    SYNC,
    TPDO1,
    eds_with,
    settings_with,
)

from canwall import config, simdrive
from canwall.cycle import make_cycle, run_laws, set_wall, step
from canwall.cycle.state import start_at
from canwall.drive import DriveSetup, Field, PdoLayout
from canwall.errors import RunFailedError
from canwall.record import ROW, Phase, Recorder
from canwall.run import buses, on_the_bus, run
from canwall.units import DriveUnits

UNIXCAN_CONFIG = config.shipped("config/unixcan.toml")


# What a run leaves


def test_standard_chatters_and_mean_force_does_not(four_strikes: Record) -> None:
    strikes = four_strikes.summary["strikes"]
    assert [strike["law"] for strike in strikes] == ["mean_force", "standard"] * 2
    assert [strike["chatter"] for strike in strikes] == [False, True, False, True]
    for mean_force, standard in ((strikes[0], strikes[1]), (strikes[2], strikes[3])):
        # Friction that stops the handle on its way out is taken for a push inwards: a pulse more.
        assert standard["contacts"] > 10 * mean_force["contacts"]
        assert mean_force["contacts"] <= 2
        assert standard["energy_out_j"] > 100 * mean_force["energy_out_j"]
        assert standard["chatter_frequency_hz"] > 10.0
        assert "makes and breaks" in standard["chatter_reason"]


def test_signals_are_those_of_a_wall_as_late_as_bus_and_drive(four_strikes: Record) -> None:
    """The torque of a row is the law's at this sample, and acts from the next SYNC on.

    The drive's own cycle and its current loop add 0.25 and 0.1 ms: of a period, that much has the
    torque of the row before.
    """
    law, y = four_strikes.column("law"), four_strikes.column("y")
    wanted, per_mille = four_strikes.column("force"), four_strikes.column("torque_cmd_per_mille")
    standard = (law == "standard") & (four_strikes.column("phase") == Phase.RENDERING)
    assert wanted[standard] == pytest.approx(np.maximum(-50.0 * y[standard], 0.0))
    applied, commanded = four_strikes.column("torque_applied"), four_strikes.column("torque_cmd")
    older = 0.25 + 1.0 / (2.0 * math.pi * 1.6)
    assert four_strikes.summary["delay_cycles"] == pytest.approx(1.0 + older)
    expected = older * commanded[:-2] + (1.0 - older) * commanded[1:-1]
    np.testing.assert_allclose(applied[2:], expected, atol=1e-12)
    nm_per_mille = four_strikes.summary["drive"]["nm_per_mille"]
    assert commanded == pytest.approx(per_mille * nm_per_mille)
    # The limit of 1.9 N·m is rounded towards zero.
    most = math.floor(1.9 / nm_per_mille) * nm_per_mille
    assert (
        np.abs(commanded - np.clip(wanted, -most, most))[standard].max() <= nm_per_mille / 2 + 1e-12
    )


def test_folder_and_summary(four_strikes: Record) -> None:
    names = {path.name for path in four_strikes.folder.iterdir()} - {"stdout.txt"}
    assert names == {"signals.parquet", "bus.log", "summary.json", "config.toml", "run.png"}
    summary = four_strikes.summary
    assert summary["law"] == ["mean_force", "standard"]
    assert summary["stiffness"] == 50.0
    assert summary["damping"] == 0.0
    assert summary["cycle_s"] == 0.001
    assert summary["cycles"] == four_strikes.signals.num_rows
    assert summary["missed_tpdo"] == summary["late_rpdo"] == 0
    assert summary["contacts"] == len(summary["energy_per_contact_j"])
    assert summary["contacts"] == sum(strike["contacts"] for strike in summary["strikes"])
    assert summary["energy_out_max_j"] == pytest.approx(
        sum(strike["energy_out_j"] for strike in summary["strikes"]), rel=0.05
    )
    assert summary["chatter"] is True
    assert summary["chatter_reason"] == summary["strikes"][1]["chatter_reason"]
    assert summary["peak_torque"] == np.abs(four_strikes.column("torque_cmd")).max()
    assert 0.0 < summary["peak_torque"] <= 1.9
    assert summary["trips"] == []
    assert summary["interrupted"] is False
    for histogram in ("sync_interval", "tpdo_to_rpdo"):
        p50, p99, p999, longest = (
            summary["timing"][histogram][key] for key in ("p50_us", "p99_us", "p99.9_us", "max_us")
        )
        assert 0.0 < p50 <= p99 <= p999 <= longest


def test_recorded_configuration_is_the_one_that_ran(four_strikes: Record) -> None:
    assert config.load(four_strikes.folder / "config.toml") == config.load(SIM_CONFIG)


def test_table_of_strikes(four_strikes: Record) -> None:
    text = (four_strikes.folder / "stdout.txt").read_text()
    rows = [line.split() for line in text.splitlines() if line.strip()[:1].isdigit()]
    assert [row[1] for row in rows] == ["mean_force", "standard"] * 2
    assert [row[10] for row in rows] == ["no", "yes,"] * 2
    # The energy that the plain wall puts out makes it buzz, and throws the hand deeper in.
    for row, strike in zip(rows, four_strikes.summary["strikes"], strict=True):
        assert float(row[9]) == pytest.approx(strike["felt_ripple_n"], abs=0.005)
        deeper = strike["first_depth_rad"] / strike["referent_first_depth_rad"]
        assert float(row[7]) == pytest.approx(deeper, abs=0.005)
    assert f"record: {four_strikes.folder}" in text


# The record is what was on the bus


def test_signals_are_what_the_frames_say(four_strikes: Record) -> None:
    tpdos = [struct.unpack("<iHh", tpdo or b"") for tpdo, _ in four_strikes.cycles]
    rpdos = [struct.unpack("<Hh", rpdo) for _, rpdo in four_strikes.cycles]
    for column, values in (
        ("counts", [counts for counts, _, _ in tpdos]),
        ("statusword", [statusword for _, statusword, _ in tpdos]),
        ("controlword", [controlword for controlword, _ in rpdos]),
        ("torque_cmd_per_mille", [torque for _, torque in rpdos]),
    ):
        assert four_strikes.column(column).tolist() == values, column
    nm_per_mille = four_strikes.summary["drive"]["nm_per_mille"]
    actual = [torque * nm_per_mille for _, _, torque in tpdos]
    assert four_strikes.column("torque_actual").tolist() == actual


def test_torque_recomputed_from_the_frames_alone(four_strikes: Record) -> None:
    settings = config.load(four_strikes.folder / "config.toml")
    tpdo = PdoLayout(
        TPDO1, (Field(0x6064, 0, 0, 32), Field(0x6041, 0, 32, 16), Field(0x6077, 0, 48, 16))
    )
    rpdo = PdoLayout(RPDO1, (Field(0x6040, 0, 0, 16), Field(0x6071, 0, 16, 16)))
    units = DriveUnits(counts_per_rev=131072, rated_torque_nm=0.637)
    laws = run_laws(settings)
    cycle = make_cycle(settings, DriveSetup(units, SYNC, tpdo, rpdo), laws)
    changes = [(round(stage.at_s / 0.001), stage.wall) for stage in settings.stages[1:]]
    row = np.zeros(1, ROW)
    enabled = False
    recomputed = []
    for j, (given, sent) in enumerate(four_strikes.cycles):
        assert given is not None
        if j == 1:
            first, _, _ = struct.unpack("<iHh", four_strikes.cycles[0][0] or b"")
            start_at(cycle, first)
        for at, wall in changes:
            if at == j:
                set_wall(cycle, wall, laws)
        # The wall is rendered from the first cycle that finds the drive enabled until the
        # controlword takes it down.
        (controlword,) = struct.unpack_from("<H", sent)
        cycle["controlword"] = controlword
        cycle["phase"] = Phase.RENDERING if enabled and controlword == 0x0F else Phase.ENABLING
        answer = step(cycle, row, int.from_bytes(given, "little", signed=True), True)
        recomputed.append((answer & 0xFFFFFFFF).to_bytes(4, "little"))
        enabled = enabled or row["statusword"][0] & 0x6F == 0x27
    assert recomputed == [sent for _, sent in four_strikes.cycles]
    torques = [struct.unpack("<Hh", answer)[1] for answer in recomputed]
    assert four_strikes.column("torque_cmd_per_mille").tolist() == torques
    assert sum(torque != 0 for torque in torques) > 500


# The same run again


@pytest.mark.slow
def test_same_signals_with_the_processor_loaded(
    four_strikes: Record, start: Start, tmp_path: Path
) -> None:
    start(sys.executable, "-c", "while True: pass")
    done = command("run", "--output", tmp_path / "run")
    assert done.returncode == 0
    again = Record(tmp_path / "run")
    assert same_signals(four_strikes, again)
    assert again.cycles == four_strikes.cycles
    clock = [name for name in four_strikes.summary if name != "timing"]
    assert {n: again.summary[n] for n in clock} == {n: four_strikes.summary[n] for n in clock}


@pytest.mark.slow
def test_other_settings_give_other_signals(four_strikes: Record, tmp_path: Path) -> None:
    done = command(
        "run",
        "--law",
        "half_sample",
        "--stiffness",
        30,
        "--duration",
        1,
        "--output",
        tmp_path / "x",
    )
    assert (done.returncode, done.stderr) == (0, "")
    other = Record(tmp_path / "x")
    assert not same_signals(four_strikes, other, rows=900)
    assert other.summary["law"] == ["half_sample"]
    assert other.summary["stiffness"] == 30.0
    assert set(other.column("stiffness")) == {30.0}
    assert [strike["chatter"] for strike in other.summary["strikes"]] == [False]
    assert other.column("j")[other.column("phase") == Phase.RENDERING][-1] == 999


# Two processes


@pytest.fixture
def channel(tmp_path: Path) -> Path:
    return tmp_path / "bus"


@pytest.fixture
def unixcan(tmp_path: Path, channel: Path) -> Path:
    """config/unixcan.toml on a channel of the test's own."""
    changes = {'channel = "/tmp/canwall.sock"': f'channel = "{channel}"'}
    return config_file(tmp_path / "unixcan.toml", changes, UNIXCAN_CONFIG)


def start_drive(start: Start, configuration: Path) -> "subprocess.Popen[str]":
    drive = start(COMMAND, "drive", configuration)
    assert drive.stdout is not None
    assert drive.stdout.readline().startswith("simulated drive, node 5, on unixcan")
    return drive


@pytest.mark.slow
def test_drive_in_a_process_of_its_own_with_a_logger_beside(
    four_strikes: Record, start: Start, unixcan: Path, channel: Path, tmp_path: Path
) -> None:
    log = tmp_path / "logger.log"
    drive = start_drive(start, unixcan)
    attach = ["-m", "can.logger", "-i", "unixcan", "-c", channel]
    logger = start(sys.executable, "-u", *attach, "-f", log)
    assert logger.stdout is not None
    assert logger.stdout.readline().startswith("Connected to UnixBus")
    done = command("run", unixcan, "--output", tmp_path / "run")
    assert done.returncode == 0
    assert re.fullmatch(GUARD_SAID, done.stderr)
    record = Record(tmp_path / "run")
    assert same_signals(four_strikes, record)
    assert record.cycles == four_strikes.cycles
    assert record.summary["strikes"] == four_strikes.summary["strikes"]
    assert_logger_has_the_same(logger, log, channel, record)
    drive.send_signal(signal.SIGINT)
    assert drive.wait(PATIENCE_S) == 0


def assert_logger_has_the_same(
    logger: "subprocess.Popen[str]", log: Path, channel: Path, record: Record
) -> None:
    # Its file is buffered: what pushes the record out of the buffer follows.
    with can.Bus(interface="unixcan", channel=str(channel)) as bus:
        filler = can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(8))

        def filled() -> bool:
            for _ in range(20):
                bus.send(filler)
            return b"7FF#" in log.read_bytes()[-2000:]

        wait_for(filled)
    logger.send_signal(signal.SIGINT)
    assert logger.wait(PATIENCE_S) == 0
    logged = read_log(log)
    # Each sees frames of different senders in an order of its own, those of one in the same.
    for can_id in (SYNC, TPDO1, RPDO1, SDO_REQUEST, SDO_ANSWER, 0x285, 0x385):
        seen, recorded = (
            [bytes(frame.data) for frame in frames if frame.arbitration_id == can_id]
            for frames in (logged, record.frames)
        )
        assert seen[: len(recorded)] == recorded, hex(can_id)
        # What followed the last TPDO came after the master had left.
        assert len(seen) - len(recorded) <= (can_id in (0x285, 0x385)), hex(can_id)


@pytest.mark.slow
def test_master_may_start_first(
    four_strikes: Record, start: Start, unixcan: Path, channel: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    running = start(COMMAND, "run", unixcan, "--duration", 0.6, "--output", folder)
    wait_for(channel.exists)
    drive = start_drive(start, unixcan)
    assert running.wait(PATIENCE_S) == 0
    assert same_signals(four_strikes, Record(folder), rows=600)
    drive.terminate()
    assert drive.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_drive_that_does_not_come(unixcan: Path, tmp_path: Path) -> None:
    unixcan.write_text(unixcan.read_text().replace("wait_s = 5.0", "wait_s = 0.0"))
    done = command("run", unixcan, "--output", tmp_path / "run")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "node 5 does not answer" in line


# Ctrl-C


def assert_left_in_order(record: Record) -> None:
    """Zero torque and the state machine down at the end; a whole record up to there."""
    phase = record.column("phase")
    assert (np.diff(phase.astype(int)) >= 0).all()
    leaving = [
        data for (_, data), p in zip(record.cycles, phase, strict=True) if p == Phase.LEAVING
    ]
    words, torques = zip(*(struct.unpack("<Hh", rpdo) for rpdo in leaving), strict=True)
    assert set(torques) == {0}
    assert list(dict.fromkeys(words)) == [0x00]
    last, _ = record.cycles[-1]
    assert last is not None
    _, statusword, torque = struct.unpack("<iHh", last)
    assert (statusword & 0x6F, torque) == (0x40, 0)
    ids = [frame.arbitration_id for frame in record.frames]
    assert next(i for i in reversed(ids) if i in (SYNC, TPDO1, RPDO1)) == RPDO1
    assert len(record.cycles) == record.signals.num_rows == record.summary["cycles"]
    assert record.column("j").tolist() == list(range(len(record.cycles)))
    assert np.abs(record.column("torque_cmd_per_mille")).max() > 0
    assert record.summary["interrupted"] is True
    assert record.summary["trips"] == []
    assert (record.folder / "run.png").stat().st_size > 10_000


@pytest.mark.slow
def test_ctrl_c_in_the_middle(start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    running = start(COMMAND, "run", "--duration", 3600, "--output", folder)
    wait_for(lambda: torque_is_on(folder / "bus.log"))
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 130
    assert re.fullmatch(f"({GUARD_SAID})?{STOPPED_SAID}", errors)
    assert_left_in_order(Record(folder))


@pytest.mark.slow
def test_others_may_ask_the_drive_while_it_runs_in_real_time(
    start: Start, unixcan: Path, channel: Path, tmp_path: Path
) -> None:
    file = config_file(tmp_path / "c.toml", ON_A_BUSY_MACHINE, unixcan)
    folder = tmp_path / "run"
    start_drive(start, file)
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.1
    network.connect(interface="unixcan", channel=str(channel))
    try:
        node = network.add_node(5, str(settings_with().drive.eds))
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        assert node.sdo["Device type"].raw == 0x20192
        running = start(COMMAND, "run", file, "--duration", 3600, "--output", folder)
        wait_for(lambda: is_enabled(folder / "bus.log"))
        for _ in range(20):
            assert node.sdo[0x6041].raw & 0x6F == 0x27
        wait_for(lambda: torque_is_on(folder / "bus.log"))
        running.terminate()
        assert running.wait(PATIENCE_S) == 130
        assert node.sdo[0x6041].raw & 0x6F == 0x40
        assert node.sdo[0x6071].raw == 0
    finally:
        network.disconnect()
    assert_left_in_order(Record(folder))


# Runs that fail


@pytest.mark.slow
def test_trip_is_the_outcome(tmp_path: Path) -> None:
    file = config_file(tmp_path / "c.toml", {"speed_rad_s = 60.0": "speed_rad_s = 0.5"})
    done = command("run", file, "--output", tmp_path / "run")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "rad/s beyond limits.speed_rad_s" in line
    record = Record(tmp_path / "run")
    assert record.summary["trips"] == [line.removeprefix("canwall: ")]
    assert struct.unpack("<Hh", record.cycles[-1][1]) == (0x00, 0)


@pytest.mark.slow
def test_drive_that_is_not_restored_is_a_failure(tmp_path: Path) -> None:
    # The drive begins with an inhibit time that nobody may write.
    odd = {("1800sub3", "DefaultValue"): "20\nHighLimit=10"}
    eds = eds_with(tmp_path / "odd.eds", odd)
    done = command(
        "run", "--eds", eds, "--restore", "--duration", "0.1", "--output", tmp_path / "run"
    )
    assert done.returncode == 1
    assert "node 5: not restored: writing 0x14 to 0x1800:03 failed" in done.stderr


@pytest.mark.slow
def test_start_inside_the_wall(tmp_path: Path) -> None:
    file = config_file(tmp_path / "c.toml", {"position_rad = 0.0\n": "position_rad = 0.2\n"})
    done = command("run", file, "--output", tmp_path / "run")
    assert done.returncode == 0
    assert re.fullmatch(GUARD_SAID, done.stderr)
    torques = [struct.unpack("<Hh", rpdo)[1] for _, rpdo in Record(tmp_path / "run").cycles]
    # 5 N·m would be the full wall's: 100 torque steps a cycle at the most, from none.
    assert max(abs(a - b) for a, b in itertools.pairwise(torques[:100])) < 100


@pytest.mark.slow
def test_bus_that_fails_before_the_first_cycle(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class NoSync(VirtualBus):
        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            if msg.arbitration_id == SYNC:
                raise can.CanOperationError("transmit buffer full")
            super().send(msg, timeout)

    monkeypatch.setattr(buses, "open_bus", lambda settings: NoSync("no sync"))
    with pytest.raises(RunFailedError, match="the bus failed: transmit buffer full"):
        run(settings_with({"bus.exchange": "python-can"}), tmp_path / "run")


def test_record_that_is_lost(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    recorders: list[Recorder] = []

    class Lost(Recorder):
        def __init__(self) -> None:
            super().__init__()
            recorders.append(self)

    monkeypatch.setattr("canwall.record.recorder.Recorder", Lost)
    settings = settings_with({"run.duration_s": 0.3})
    with pytest.raises(RunFailedError, match="the writer of the record has died"):
        run(settings, tmp_path / "run", progress=lambda now, end: recorders[0]._writer.kill())


@pytest.mark.parametrize(("pace", "loads"), [("real_time", [False]), ("simulated", [])])
def test_drive_is_loaded_before_the_clock_counts(
    monkeypatch: pytest.MonkeyPatch, pace: str, loads: list[bool]
) -> None:
    loaded: list[bool] = []
    monkeypatch.setattr(simdrive, "load_compiled_code", loaded.append)
    with on_the_bus(settings_with({"bus.pace": pace})):
        assert loaded == loads
