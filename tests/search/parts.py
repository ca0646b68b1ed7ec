"""Parts of the search: what each does with a seed and an effort."""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import belief
import kills
import long_runs
import storms
from fuzzing import FoundError, fuzz
from targets import TARGETS

ROOT = Path(__file__).parents[2]

Tell: TypeAlias = Callable[[int], None]
"""Takes how much is done."""


@dataclass(frozen=True)
class Part:
    """A part of the search.

    Attributes:
        search: takes a seed, an effort and a function for what is done; returns figures, or raises
            AssertionError with what it found.
        effort: of a search that takes its time: inputs, machines, masters, cycles or contacts.
        bounded: effort of the same in the tests.
        promise: what a finding would break.
    """

    search: Callable[[int, int, Tell], dict[str, Any]]
    effort: int
    bounded: int
    promise: str


def _fuzz(name: str, seed: int, effort: int, tell: Tell) -> dict[str, Any]:
    # Kept where something was found, for the input to be tried again.
    folder = Path(tempfile.mkdtemp(prefix="canwall-search-"))
    return fuzz(name, seed, effort, folder, tell)


def _kills(seed: int, effort: int, tell: Tell) -> dict[str, Any]:
    found = kills.turns(seed, effort, tell=tell)
    phases = [turn.phase for turn in found]
    return {
        "masters": len(found),
        "doing": {phase: phases.count(phase) for phase in sorted(set(phases))},
        "bins_ms": kills.BINS_MS,
        "in contact": kills.histograms(found),
    }


def _long_run(exchange: str, seed: int, effort: int, tell: Tell) -> dict[str, Any]:
    return long_runs.long_run(seed, exchange, effort, tell=tell)


#: What tests play case by case, and the tests.
CASES = {
    "Every fault that the simulated drive knows, whenever it begins, ends as "
    "[](ways_out.md) says; frames, cycles and words are all in the record.": (
        "tests/run/test_fault_matrix.py"
    ),
    "A fault in any single call on the way out (an exception, a signal, a call that hangs) "
    "leaves no torque, and the words are there.": (
        "tests/cycle/test_every_call_on_the_way_out.py tests/cycle/test_loop.py"
    ),
    "A master that is asked to end, that dies, stands still, or whose law or writer fails, "
    "leaves no torque.": "tests/run/test_ways_out.py",
    "A simulated drive that loses its master ends its torque, as its objects say.": (
        "tests/simdrive/test_lost_master.py"
    ),
    "The limits of a wall trip in their cycle, and not without a reason.": (
        "tests/cycle/test_step.py tests/sweep/test_no_false_trips.py"
    ),
    "TPDOs that are missing or late, torques that are late, positions that overflow and a master "
    "that stands still throw no handle, or are told.": (
        "tests/run/test_disturbances.py tests/run/test_torque_delay.py"
    ),
    "A record is whole, and says so where it is not; one that was cut off is completed from its "
    "rows.": "tests/record tests/run/test_records_survive.py",
    "A damaged journal of a sweep is never read as data; a law that hangs, or a worker that dies, "
    "is named and costs no finished piece.": "tests/sweep/test_sweep.py",
    "A drive that is not what its file says, or not alone under its node-ID, is named before "
    "it is enabled, and put back as it was or that is said.": "tests/drive tests/bench",
    "A change is judged against the wall that is in force, and refused to the one who asked.": (
        "tests/run/test_changes.py"
    ),
    "Code that is called is the code that is there.": "tests/test_compiled.py",
}


def _cases(seed: int, effort: int, tell: Tell) -> dict[str, Any]:
    """Run the tests of the first `effort` promises, all of each."""
    del seed
    found: dict[str, Any] = {}
    for done, (promise, tests) in enumerate(list(CASES.items())[:effort]):
        tell(done)
        words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *tests.split()]
        ran = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        if ran.returncode != 0:
            raise FoundError(ran.stdout[-4000:])
        found[promise] = {"tests": tests, "figure": ran.stdout.splitlines()[-1].strip("= ")}
    return found


PARTS = {
    "cases": Part(_cases, len(CASES), 1, "Each of these is played, case by case."),
    "frames into the drive": Part(
        partial(_fuzz, "frames into the drive"),
        200_000,
        200,
        "The simulated drive outlives any frames, answers valid ones after them, and gives a "
        "torque in OPERATION ENABLED and its own way to rest alone.",
    ),
    "frames into the master": Part(
        partial(_fuzz, "frames into the master"),
        50_000,
        40,
        "Whatever a bus does to frames, a master ends in order: no exception but its own, no "
        "torque left, none beyond the limit.",
    ),
    "dictionaries": Part(
        partial(_fuzz, "dictionaries"),
        500_000,
        300,
        "Any EDS or DCF is read, or refused with one line.",
    ),
    "configurations": Part(
        partial(_fuzz, "configurations"),
        500_000,
        1000,
        "Any TOML file is read, or refused with one line; what a run keeps of it means the same.",
    ),
    "records": Part(
        partial(_fuzz, "records"),
        50_000,
        40,
        "Any record of a run is drawn, or refused with one line.",
    ),
    "journals": Part(
        partial(_fuzz, "journals"),
        500_000,
        1000,
        "A journal of a sweep gives the pieces that were written, or is refused.",
    ),
    "belief": Part(
        belief.pairs,
        5_000,
        40,
        "No pair of a drive's state and its master's belief has a torque and no master in its"
        " cycle, whatever is lost, late, doubled, reordered or forged.",
    ),
    "kills": Part(
        _kills,
        300,
        9,
        "A master that is killed, stopped or asked to end at any instant leaves no torque; a "
        "witness on the bus and the drive itself say so.",
    ),
    "native cycles": Part(
        partial(_long_run, "native"),
        10_000_000,
        100_000,
        "Memory, descriptors, counters and the energy of a contact are the same after "
        "millions of cycles; every one of them is in the record.",
    ),
    "python-can cycles": Part(
        partial(_long_run, "python-can"), 1_000_000, 20_000, "The same over python-can."
    ),
    "storms": Part(
        storms.storms,
        10_000,
        100,
        "Under faults of drive and machine over each other no torque is left, none is beyond "
        "the limit, no record has a gap, no run ends without a word.",
    ),
}
"""By name. The kills' masters take some seconds each, however fast the machine."""

assert set(TARGETS) <= set(PARTS)
