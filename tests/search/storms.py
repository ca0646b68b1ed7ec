"""Storms: faults of the drive and of the host over each other, contact after contact."""

import contextlib
import random
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from commands import Record
from fuzzing import FoundError
from rig import SIM_CONFIG
from test_fault_matrix import Witness

from canwall import config, simdrive
from canwall.config import Settings
from canwall.cycle import exchange as exchange_module
from canwall.errors import RunFailedError
from canwall.record import Recorder
from canwall.run import RunResult, buses, run

_STRIKES, _INTERVAL_S = 25, 0.2
_DURATION_S = _STRIKES * _INTERVAL_S
_HAND = {
    "inertia_kg_m2": 6.4e-5,
    "damping_nm_s_per_rad": 0.0256,
    "stiffness_nm_per_rad": 3.2,
    "strikes": _STRIKES,
    "first_strike_s": 0.02,
    "interval_s": _INTERVAL_S,
    "rest_rad": 0.03,
    "press_rad": -0.1,
    "approach_s": 0.03,
    "press_s": 0.1,
    "withdraw_s": 0.03,
}
#: Faults that a wall outlives, and those that end it, or may: kind and settings.
_BEARABLE: tuple[dict[str, Any], ...] = (
    {"kind": "lost", "can_id": 0x185, "duration_syncs": 2},
    {"kind": "lost", "can_id": 0x205, "direction": "received", "duration_syncs": 2},
    {"kind": "late", "can_id": 0x185, "duration_syncs": 3},
    {"kind": "doubled", "can_id": 0x185, "duration_syncs": 100},
    {"kind": "doubled", "can_id": 0x205, "direction": "received", "duration_syncs": 100},
    {"kind": "corrupted", "can_id": 0x185, "amount": 0, "duration_syncs": 100},
    {"kind": "encoder_jump", "amount": 5, "duration_syncs": 20},
    {"kind": "torque", "amount": 850, "duration_syncs": 50},
    {"kind": "babbling", "duration_syncs": 50},
    {"kind": "silence", "duration_syncs": 4},
)
_GRAVE: tuple[dict[str, Any], ...] = (
    {"kind": "lost"},
    {"kind": "lost", "probability": 0.2, "duration_syncs": 200},
    {"kind": "late", "can_id": 0x185, "amount": 3},
    {"kind": "corrupted", "can_id": 0x185, "amount": 16, "duration_syncs": 1},
    {"kind": "corrupted", "can_id": 0x205, "direction": "received", "amount": 3},
    {"kind": "wrong_length"},
    {"kind": "silence"},
    {"kind": "reboot"},
    {"kind": "emcy"},
    {"kind": "fault"},
    {"kind": "encoder_jump", "amount": 20_000},
    {"kind": "encoder_stuck"},
    {"kind": "torque", "amount": -1000},
    {"kind": "sto"},
    {"kind": "undervoltage"},
    {"kind": "bus_off"},
    {"kind": "babbling", "can_id": 0x185},
)
#: Rated torque of the drive of config/sim.toml [N·m], and its 0x6072 [per mille].
_RATED_NM, _DRIVE_LIMIT = 0.637, 3000
_HOST = ("none", "none", "none", "stall", "signal", "writer killed")


@dataclass
class Storms:
    """What was lived through.

    Attributes:
        runs: runs, of which so many ended by a trip.
        contacts: with the wall.
        faults: of drive and host.
        largest_per_mille: largest torque of a drive.
        ended: runs by how they ended.
    """

    runs: int = 0
    contacts: int = 0
    faults: int = 0
    largest_per_mille: int = 0
    ended: dict[str, int] = field(default_factory=dict)


def storms(
    seed: int, contacts: int, tell: Callable[[int], None] = lambda done: None
) -> dict[str, Any]:
    """Render walls in storms until there were so many contacts; return what `Storms` has.

    Raises:
        FoundError: If a torque was left, or beyond the limit, a record is not whole, or a run ends
            without a word.
    """
    done, chance = Storms(), random.Random(seed)
    with _watched() as witnesses:
        while done.contacts < contacts:
            number = chance.getrandbits(32)
            witnesses.clear()
            try:
                _storm(done, number, witnesses)
            except FoundError:
                raise
            except Exception as error:
                raise FoundError(f"storm {number}: {type(error).__name__}: {error}") from error
            tell(min(done.contacts, contacts))
    return vars(done)


@contextlib.contextmanager
def _watched() -> Iterator[list[Witness]]:
    """Have a witness at each simulated drive, and no pictures; give up what is lost sooner."""
    witnesses: list[Witness] = []
    make = buses.make_simulated_drive

    def watched(settings: Settings) -> simdrive.FaultyDrive:
        drive = make(settings)
        witnesses.append(Witness(drive))
        return drive

    with (
        patch.object(buses, "make_simulated_drive", watched),
        patch.object(Recorder, "draw", lambda recorder, given_up: []),
        patch.object(exchange_module, "_SIMULATED_TIMEOUT_S", 0.02),
        patch.object(exchange_module, "_MISSING_TIMEOUT_S", 0.002),
    ):
        yield witnesses


def _storm(done: Storms, number: int, witnesses: list[Witness]) -> None:
    chance = random.Random(number)
    settings, host = _settings(chance), chance.choice(_HOST)
    assert settings.simulation is not None
    trouble = _Host(host, chance.uniform(0.1, _DURATION_S))
    with tempfile.TemporaryDirectory(prefix="canwall-search-") as temporary:
        folder = Path(temporary) / "run"
        ended, result = "", None
        try:
            with trouble.knows_writers():
                result = run(settings, folder, stopped=trouble, progress=trouble.note)
            ended = "tripped" if result.outcome.trips else "completed"
            if result.outcome.interrupted:
                ended = "stopped"
        except RunFailedError as error:
            ended = f"failed: {error}"[:80] if host == "writer killed" else ""
            if not ended:
                raise
        _check(number, host, settings, folder, witnesses, result)
    done.runs += 1
    done.faults += len(settings.simulation.fault) + (host != "none")
    kind = ended.partition(":")[0]
    done.ended[kind] = done.ended.get(kind, 0) + 1
    if result is not None:
        done.contacts += result.summary["contacts"]
    largest = max(map(abs, witnesses[0].torques), default=0)
    done.largest_per_mille = max(done.largest_per_mille, largest)


def _settings(chance: random.Random) -> Settings:
    faults = [_at(chance, fault) for fault in chance.sample(_BEARABLE, chance.randint(0, 8))]
    if chance.random() < 0.6:
        faults += [_at(chance, fault) for fault in chance.sample(_GRAVE, chance.randint(1, 2))]
    return config.load(
        SIM_CONFIG,
        {
            "bus.exchange": chance.choice(["native", "native", "native", "python-can"]),
            "run.duration_s": _DURATION_S,
            "simulation.hand": _HAND,
            "simulation.fault": faults,
            "simulation.seed": chance.getrandbits(16),
        },
    )


def _at(chance: random.Random, fault: dict[str, Any]) -> dict[str, Any]:
    return {**fault, "at_sync": chance.randint(1, round(_DURATION_S * 1000))}


class _Host:
    """Trouble of the machine, once, at a time of the bus: asked once a turn of the loop."""

    def __init__(self, kind: str, at_s: float) -> None:
        self._kind, self._at_s = kind, at_s
        self._writers: list[subprocess.Popen[bytes]] = []
        self._now_s = 0.0

    @contextlib.contextmanager
    def knows_writers(self) -> Iterator[None]:
        """Take the writers of the records that are begun meanwhile."""
        begin = Recorder.begin

        def noted(recorder: Recorder, *given: Any) -> None:
            self._writers.append(recorder._writer)
            begin(recorder, *given)

        with patch.object(Recorder, "begin", noted):
            yield

    def note(self, now_s: float, end_s: float | None) -> None:
        """Take the time."""
        self._now_s = now_s

    def __call__(self) -> bool:
        if self._now_s >= self._at_s:
            kind, self._kind = self._kind, "none"
            if kind == "stall":
                time.sleep(0.05)
            elif kind == "signal":
                signal.raise_signal(signal.SIGINT)
            elif kind == "writer killed":
                self._writers[-1].kill()
        return False


def _check(
    number: int,
    host: str,
    settings: Settings,
    folder: Path,
    witnesses: list[Witness],
    result: RunResult | None,
) -> None:
    (witness,) = witnesses
    wrong = []
    if witness.torque():
        wrong.append(f"{witness.torque()} per mille are left")
    # The drive's own limit: what it gets may be corrupted on the way.
    if max(map(abs, witness.torques), default=0) > _DRIVE_LIMIT:
        wrong.append(f"{max(map(abs, witness.torques))} per mille in the drive")
    if result is not None and host != "writer killed":
        record = Record(folder)
        if not np.array_equal(record.column("j"), np.arange(record.summary["cycles"])):
            wrong.append("cycles are missing in the record")
        largest = np.abs(record.column("torque_cmd_per_mille").astype(int)).max(initial=0)
        if largest > settings.limits.torque_nm / _RATED_NM * 1000.0 + 1.0:
            wrong.append(f"{largest} per mille commanded, beyond limits.torque_nm")
        complete = record.summary["cycles"] >= round(_DURATION_S / settings.bus.cycle_s)
        if not (complete or result.outcome.trips or result.outcome.interrupted):
            wrong.append("ended without a word")
    if wrong:
        faults = settings.simulation.fault if settings.simulation else ()
        raise FoundError(f"storm {number}: {'; '.join(wrong)}; host: {host}; {faults}")
