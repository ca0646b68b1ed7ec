"""`canwall run --panel`: the panel is a process of its own, and the run's end is not its end."""

import os
import re
import signal
from pathlib import Path

import pytest
from commands import COMMAND, PATIENCE_S, Start, wait_for

import canwall

pytest.importorskip("uvicorn")


def children(process: int) -> dict[int, str]:
    """Commands of the processes that a process has started."""
    found = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return {int(pid): Path(f"/proc/{pid}/cmdline").read_text() for pid in found}


@pytest.mark.slow
def test_run_with_its_panel(start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    settings = canwall.load()
    endless = settings.run.model_copy(update={"duration_s": None})
    file = tmp_path / "c.toml"
    file.write_text(settings.model_copy(update={"schedule": (), "run": endless}).to_toml())
    run = start(COMMAND, "run", file, "--output", folder, "--panel")
    assert run.stderr is not None
    address = run.stderr.readline()
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]+\n", address)
    (panel,) = (pid for pid, words in children(run.pid).items() if "panel" in words)
    assert os.getsid(panel) != os.getsid(run.pid)
    with canwall.attach(folder) as attached:
        cycle = attached.mark("with the panel")
        os.kill(panel, signal.SIGKILL)
        wait_for(lambda: attached.status.cycle > cycle + 1000)
        attached.end()
    out, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130
    assert f"record: {folder}" in out
    assert "Traceback" not in errors
