"""A run in progress from a script: what it sees and does is in the record afterwards."""

import signal
from pathlib import Path

import pytest
from commands import COMMAND, PATIENCE_S, Start, wait_for

import canwall
from canwall.errors import ConfigError
from canwall.record import read_signals


@pytest.mark.slow
def test_attached_run(start: Start, tmp_path: Path) -> None:
    settings = canwall.load()
    endless = settings.run.model_copy(update={"duration_s": None})
    settings = settings.model_copy(update={"schedule": (), "run": endless})
    file, folder = tmp_path / "c.toml", tmp_path / "run"
    file.write_text(settings.to_toml())
    with pytest.raises(ConfigError, match="no run in progress"):
        canwall.attach(folder)
    process = start(COMMAND, "run", file, "--output", folder)
    wait_for((folder / "live.json").exists)
    with canwall.attach(folder) as run:
        wait_for(lambda: run.status.phase == "rendering")
        before = run.settings.wall.stiffness_nm_per_rad
        softer = run.change(stiffness=12.5, tension="clamp", guard={"action": "act"})
        assert run.settings.wall.stiffness_nm_per_rad == 12.5  # already
        marked = run.mark("here")
        wait_for(lambda: run.status.cycle > marked)
        signals = run.signals()
        assert set(signals["law"]) <= {law.name for law in run.settings.laws}
        assert signals.attrs["units"]["torque_cmd"] == "N·m"
        changed = signals["j"][signals["stiffness"] == 12.5]
        assert changed.tolist() == list(range(softer, changed.iloc[-1] + 1))
        assert changed.iloc[-1] == signals["j"].iloc[-1]
        wait_for(lambda: read_signals(folder / "signals.parquet").num_rows > 0)
        so_far = canwall.read(folder)
        assert isinstance(so_far, canwall.RecordedRun)
        assert (so_far.trips, so_far.summary["cut_off"]) == ([], False)
        assert "in progress" in so_far.remarks[0]
        last = run.signals(seconds=0.1)
        assert 1 <= len(last) <= 101
        assert last["j"].iloc[-1] >= signals["j"].iloc[-1]
        with pytest.raises(ConfigError, match="greater than or equal to 0"):
            run.change(stiffness=-1.0)
        with pytest.raises(ConfigError, match=r"limits\.torque_nm = 50"):
            run.change(limits={"torque_nm": 50.0})
        with pytest.raises(ConfigError, match="do: unknown key"):
            run.change(do="end")
        assert "12.5 N·m/rad; rendering, cycle" in repr(run)
        turns = run.take_turns({"stiffness_nm_per_rad": 3.0}, {"stiffness_nm_per_rad": 4.0})
        with pytest.raises(ConfigError, match=r"walls\.0: has to be a dictionary"):
            run.take_turns("ab")  # type: ignore[arg-type]
        assert run.watch_beat(0) >= turns
        run.end()
        assert process.wait(PATIENCE_S) == 128 + signal.SIGINT
        wait_for(lambda: run.status.ended)
        assert "ended" in repr(run)
        run.close()
    # Closed twice: no descriptor that somebody else has got since.
    with (tmp_path / "mine").open("w") as mine:
        run.close()
        mine.write("mine")
    for ask in (run.stop, run.end, run.live.beat):
        with pytest.raises(ConfigError, match="is detached from; attach to it again"):
            ask()
    recorded = canwall.read(run.folder)
    assert isinstance(recorded, canwall.RecordedRun)
    assert recorded.summary["guard"]["action"] == "act"
    stiffness = recorded.signals["stiffness"]
    assert stiffness[softer - 1] == before
    assert stiffness[softer] == 12.5
    assert stiffness[turns] == 3.0
