"""A bounded part of the search, with seeds that stay: `scripts/search` goes on from there."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import belief
import kills
import long_runs
import pytest
import storms
from adversary import Act, Duel, Master, TorqueError, fast_duels
from fork_server import ForkedPopen
from fuzzing import fuzz
from parts import PARTS
from targets import TARGETS

import canwall.drive.setup
from canwall.drive.watchdog import NO_WATCHDOG

SEED = 1

needs_atheris = pytest.mark.skipif(
    importlib.util.find_spec("atheris") is None, reason="atheris has no wheel for this Python"
)


@needs_atheris
@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_fuzzed(name: str, tmp_path: Path) -> None:
    found = fuzz(name, SEED, PARTS[name].bounded, tmp_path)
    assert found["inputs"] >= PARTS[name].bounded
    assert found["branches"] > 0


@pytest.mark.slow
def test_no_torque_without_a_master() -> None:
    found = belief.pairs(SEED, PARTS["belief"].bounded)
    # There was something to be lost.
    assert any("OPERATION ENABLED, torque" in pair for pair in found["pairs"])


@pytest.mark.slow
def test_killed_masters() -> None:
    popen = ForkedPopen[str]
    found = kills.turns(SEED, PARTS["kills"].bounded, popen)
    assert {turn.name for turn in found} == set(kills.SIGNALS)
    assert any(turn.phase == "in contact" for turn in found)


@pytest.mark.slow
@pytest.mark.parametrize("exchange", ["native", "python-can"])
def test_cycles_for_long(exchange: str) -> None:
    cycles = PARTS[f"{exchange} cycles"].bounded
    found = long_runs.long_run(SEED, exchange, cycles, ForkedPopen[str])
    assert found["contacts"] >= cycles // 1000 - 1


@pytest.mark.slow
def test_storms() -> None:
    found = storms.storms(SEED, PARTS["storms"].bounded)
    assert found["faults"] > 0


@needs_atheris
@pytest.mark.slow
def test_figures_are_kept(tmp_path: Path) -> None:
    figures = tmp_path / "promises.json"
    words = ["configurations", "--share", "0.0001", "--seed", "3", "--figures", str(figures)]
    done = subprocess.run(
        [sys.executable, str(Path(__file__).parent), *words],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "search: seed 3" in done.stderr
    kept = json.loads(figures.read_text())["configurations"]
    assert kept["seed"] == 3
    assert kept["figures"]["inputs"] == PARTS["configurations"].effort * 0.0001
    assert json.loads(done.stdout) == {"configurations": kept}


@pytest.mark.slow
def test_torque_without_a_master_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search can find something: a drive whose watchdog is not set."""
    monkeypatch.setattr(canwall.drive.setup, "arm", lambda *given: NO_WATCHDOG)
    with fast_duels():
        duel = Duel()
        try:
            duel.adversary.plan([Act("gone", after=600)])
            Master(duel, cycles=200).run()
            with pytest.raises(TorqueError, match="and no master in its cycle"):
                duel.settle()
        finally:
            duel.close()
