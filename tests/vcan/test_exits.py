"""Master or drive is interrupted, killed, stopped: the torque goes, by either exchange."""

import signal
import struct

import can
from commands import STOPPED_SAID, Record
from rig import RPDO1, TPDO1
from socketcan import SLOW, UNTIL_STOPPED, Bench, is_disabled, run_with_torque, wait_for

_EMCY = 0x085
_ENABLED = 0x0F


def _rpdo(data: bytes) -> tuple[int, int]:
    """Controlword and torque."""
    controlword, torque = struct.unpack("<Hh", data)
    return controlword, torque


def test_interrupted_run(bench: Bench) -> None:
    configuration = bench.config(UNTIL_STOPPED)
    drive = bench.drive(configuration)
    folder = bench.folder / "run"
    run = run_with_torque(bench, folder, configuration)
    assert (run.interrupt(), run.errors) == (130, STOPPED_SAID.splitlines())
    record = Record(folder)
    assert record.summary["interrupted"]
    assert record.summary["trips"] == []
    assert _rpdo(record.cycles[-1][1]) == (0, 0)
    assert is_disabled(bench.bus())
    assert drive.interrupt() == 0


def test_master_that_is_killed(bench: Bench) -> None:
    """Nobody takes the torque away but the drive, when its watchdog finds no RPDO."""
    configuration = bench.config(SLOW | UNTIL_STOPPED)
    bench.drive(configuration)
    run = run_with_torque(bench, bench.folder / "run", configuration)
    witness = bench.bus()
    seen: list[can.Message] = []

    def emergency() -> bool:
        while (message := witness.recv(0)) is not None:
            seen.append(message)
        return any(message.arbitration_id == _EMCY for message in seen)

    wait_for(lambda: emergency() or any(m.arbitration_id == RPDO1 for m in seen))
    run.kill()
    wait_for(emergency)
    (code,) = (bytes(m.data[:2]) for m in seen if m.arbitration_id == _EMCY)
    assert code == struct.pack("<H", 0x8250)
    controlword, torque = [_rpdo(m.data) for m in seen if m.arbitration_id == RPDO1][-1]
    assert (controlword, torque != 0) == (_ENABLED, True)
    assert is_disabled(bench.bus())


def test_drive_that_stands_still(bench: Bench) -> None:
    """Without TPDOs the torque is held for two cycles, then let go of within ten."""
    configuration = bench.config(UNTIL_STOPPED)
    drive = bench.drive(configuration)
    folder = bench.folder / "run"
    run = run_with_torque(bench, folder, configuration)
    drive.send(signal.SIGSTOP)
    assert run.wait() == 1
    assert "no TPDO for " in run.errors[0]
    assert "did not confirm that it is disabled" in run.errors[1]
    assert len(run.errors) == 2
    record = Record(folder)
    tpdos = [tpdo for tpdo, _ in record.cycles]
    silent = tpdos.index(None, max(n for n, tpdo in enumerate(tpdos) if tpdo is not None))
    torques = [_rpdo(rpdo)[1] for _, rpdo in record.cycles[silent - 1 :]]
    held, ramp, rest = torques[:3], torques[3:13], torques[13:]
    assert held[0] > 0
    assert held == [held[0]] * 3
    assert all(now < before for before, now in zip(torques[2:], ramp, strict=False))
    assert not any(rest)
    # It finds all that it was sent meanwhile, and follows.
    drive.send(signal.SIGCONT)
    bus = bench.bus()
    wait_for(lambda: is_disabled(bus))
    assert any(message.arbitration_id == TPDO1 for message in record.frames)
    assert drive.interrupt() == 0
