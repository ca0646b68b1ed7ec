"""A recorded bus log on the bus again, by can-utils' canplayer."""

import struct
from collections.abc import Callable
from contextlib import closing
from copy import copy
from pathlib import Path

import can
import main_job
from commands import Record, read_log
from conftest import Strikes
from rig import RPDO1, SDO_REQUEST, SYNC, TPDO1
from socketcan import (
    PATIENCE_S,
    UNTIL_STOPPED,
    Bench,
    first_difference,
    is_disabled,
    run_with_torque,
    wait_for,
)

_OF_THE_MASTER = (0x000, SYNC, RPDO1, SDO_REQUEST)
#: canplayer waits for no answer: it is given so many times the time that the master took, which had
#: more beside it, but no longer between two frames [s] than a drive needs for one. The master loads
#: code before a SYNC.
_SLOWER, _LONGEST_S = 2.0, 0.5
#: Cycles that are played: the hand has struck, and presses.
_CYCLES = 350


def _write_log(path: Path, frames: list[can.Message]) -> None:
    at_s = last_s = frames[0].timestamp
    with can.CanutilsLogWriter(path, channel="vcan0") as log:
        for frame in frames:
            at_s += min(_SLOWER * (frame.timestamp - last_s), _LONGEST_S)
            last_s = frame.timestamp
            slowed = copy(frame)
            slowed.timestamp = at_s
            log.on_message_received(slowed)


def test_replayed_master_gets_the_recorded_answers(
    strikes_by: Callable[[str], Strikes], tmp_path: Path
) -> None:
    """A drive's answers depend on the frames alone: another drive gives the same positions."""
    frames = strikes_by("native").record.frames
    syncs = [n for n, frame in enumerate(frames) if frame.arbitration_id == SYNC]
    played = frames[: syncs[_CYCLES]]
    log = tmp_path / "master.log"
    _write_log(log, [frame for frame in played if frame.arbitration_id in _OF_THE_MASTER])
    recorded = [bytes(f.data) for f in played if f.arbitration_id == TPDO1]
    with closing(Bench(tmp_path, "native")) as bench:
        bench.drive(bench.config(main_job.CHANGES))
        dump = bench.start("candump", "-L", "vcan0,185:7FF", output=tmp_path / "candump.log")
        player = bench.start("canplayer", "-I", log)
        assert player.wait(PATIENCE_S) == 0

        def answered() -> list[bytes]:
            return [bytes(frame.data) for frame in read_log(tmp_path / "candump.log")]

        wait_for(lambda: len(answered()) >= len(recorded))
        dump.terminate()
        dump.wait()
    assert first_difference(answered(), recorded) is None
    torques = [struct.unpack("<iHh", data)[2] for data in recorded]
    assert max(torques) > 100, "the strike is in it"


def test_replay_beside_a_run_is_a_second_master(strikes: Strikes, bench: Bench) -> None:
    """Whoever does not listen first is found out by his first SYNC."""
    syncs = [frame for frame in strikes.record.frames if frame.arbitration_id == SYNC][:5]
    log = bench.folder / "syncs.log"
    _write_log(log, syncs)
    bench.drive()
    folder = bench.folder / "run"
    run = run_with_torque(bench, folder, bench.config(UNTIL_STOPPED))
    bench.start("canplayer", "-I", log)
    assert run.wait() == 1
    (line,) = run.errors
    assert "somebody else sends SYNC (0x080) as well: end it, or set bus.sync" in line
    assert struct.unpack("<Hh", Record(folder).cycles[-1][1]) == (0, 0)
    assert is_disabled(bench.bus())
