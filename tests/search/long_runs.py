"""Runs for long: what memory, counters, energy and files do over millions of cycles."""

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from commands import COMMAND
from fuzzing import FoundError
from rig import SIM_CONFIG

from canwall import config
from canwall.record import ROW

#: Interval of the samples of a run [s], and the part of the run before which nothing counts.
_SAMPLE_S, _WARM_UP = 0.2, 0.3
#: Growth after the warm-up that is none of the cycles', but of the allocator [bytes].
_NOISE = 128 << 20
_PAGE = os.sysconf("SC_PAGESIZE")
_INTERVAL_S = 1.0


def long_run(
    seed: int,
    exchange: str,
    cycles: int,
    popen: Callable[..., "subprocess.Popen[str]"] = subprocess.Popen,
    tell: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Render a wall for so many cycles, a strike every second of bus time.

    Args:
        seed: of the simulated drive.
        exchange: "native" or "python-can".
        cycles: number of cycles.
        popen: starts a program.
        tell: called with the cycles so far, about.

    Raises:
        FoundError: If memory grows with the cycles, a file is not whole, a descriptor is left
            open, or contacts are not all the same.
    """
    with tempfile.TemporaryDirectory(prefix="canwall-search-") as temporary:
        folder = Path(temporary) / "run"
        file = Path(temporary) / "c.toml"
        file.write_text(_settings(seed, exchange, cycles).to_toml())
        begin = time.monotonic()
        words = [COMMAND, "run", str(file), "--output", str(folder)]
        said = Path(temporary) / "said.txt"
        with (
            said.open("w") as output,
            popen(words, stdout=output, stderr=subprocess.STDOUT, text=True) as process,
        ):
            try:
                samples = _watch(process, folder / "signals.arrows", cycles, tell)
            finally:
                process.kill()
        took_s = time.monotonic() - begin
        if process.returncode != 0:
            last = said.read_text()[-1000:]
            raise FoundError(f"{exchange}, seed {seed}: exit code {process.returncode}: {last}")
        return _judged(folder, exchange, cycles, samples, took_s)


def _settings(seed: int, exchange: str, cycles: int) -> config.Settings:
    hand = config.load(SIM_CONFIG).simulation.hand.model_dump()  # type: ignore[union-attr]
    hand |= {"strikes": cycles // 1000, "interval_s": _INTERVAL_S, "script": ()}
    given = {
        "bus.exchange": exchange,
        "run.duration_s": cycles * 1e-3,
        "simulation.hand": {key: value for key, value in hand.items() if value is not None},
        "simulation.seed": seed,
        "wall.law": "half_sample",
    }
    settings = config.load(SIM_CONFIG, given)
    return settings.model_copy(update={"schedule": ()})


def _watch(
    process: "subprocess.Popen[str]", stream: Path, cycles: int, tell: Callable[[int], None]
) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    """Return size of the stream of rows, memory of master and writer, and open descriptors.

    Only while the stream grows: before, programs start, and after, the record is summarised.
    """
    samples: list[tuple[int, ...]] = []
    while process.poll() is None:
        time.sleep(_SAMPLE_S)
        try:
            size = stream.stat().st_size
            pids = [process.pid, *_children(process.pid)]
            resident = [_resident(pid) for pid in pids[:2]]
            descriptors = len(os.listdir(f"/proc/{process.pid}/fd"))
        except OSError:
            continue  # not begun yet, or ended
        grown = not samples or size > samples[-1][0]
        if len(resident) == 2 and grown:
            samples.append((size, *resident, descriptors))
            tell(min(cycles, size // ROW.itemsize))
    return np.array(samples, float).reshape(-1, 4)


def _children(pid: int) -> list[int]:
    return list(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))


def _resident(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE


def _judged(
    folder: Path,
    exchange: str,
    cycles: int,
    samples: "np.ndarray[tuple[int, int], np.dtype[np.float64]]",
    took_s: float,
) -> dict[str, Any]:
    summary = json.loads((folder / "summary.json").read_text())
    settled = samples[int(len(samples) * _WARM_UP) :]
    found: dict[str, Any] = {
        "cycles": summary["cycles"],
        "cycles_per_s": round(cycles / took_s),
        "contacts": summary["contacts"],
        "missed_tpdo": summary["missed_tpdo"],
    }
    wrong = []
    if len(settled) >= 10:
        done = settled[:, 0] / max(1.0, samples[:, 0].max()) * cycles
        for name, column in (("master", 1), ("writer", 2)):
            slope = float(np.polyfit(done, settled[:, column], 1)[0])
            found[f"{name}_bytes_per_cycle"] = round(slope, 3)
            found[f"{name}_mib"] = round(float(settled[-1, column]) / 2**20, 1)
            if slope * np.ptp(done) > _NOISE:
                wrong.append(f"the {name} grows by {slope:.2f} bytes per cycle")
        # One more for a moment is none that stays.
        first, last = (part[:, 3].min() for part in np.array_split(settled, 2))
        found["descriptors"] = int(last)
        if last > first:
            wrong.append(f"open descriptors: first {first:.0f}, then {last:.0f}")
    rows = pq.ParquetFile(folder / "signals.parquet").metadata.num_rows
    if rows != summary["cycles"]:
        wrong.append(f"{rows} rows of {summary['cycles']} cycles")
    with (folder / "bus.log").open("rb") as log:
        syncs = sum(b" 080#" in line for line in log)
    if syncs != summary["cycles"]:
        wrong.append(f"{syncs} SYNCs in the log of {summary['cycles']} cycles")
    # The first contact begins from rest, and the last may be cut off.
    energies = np.array(summary["energy_per_contact_j"][1:-1])
    if len(energies):
        found["energy_per_contact_j"] = [
            float(f"{energies.min():.4g}"),
            float(f"{energies.max():.4g}"),
        ]
    found["mib_on_disk"] = round(sum(f.stat().st_size for f in folder.iterdir()) / 2**20, 1)
    if summary["trips"]:
        wrong.append(f"tripped: {summary['trips']}")
    if wrong:
        raise FoundError(f"{exchange}, {cycles} cycles: {'; '.join(wrong)}; {found}")
    return found
