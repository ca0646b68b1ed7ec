"""Ctrl-C in commands that evaluate a law which takes its time."""

import signal
import subprocess
import time
from pathlib import Path

import pytest
from commands import COMMAND, PATIENCE_S, wait_for
from fork_server import ForkedPopen

LAWS = """from pathlib import Path

Path(__file__).with_name("loaded").touch()

def endless(wall):
    while wall.y < 0.0:
        wall.memory[0] += 1.0
    return 0.0

def slow(wall):
    for _ in range(10_000_000):
        wall.memory[0] += 1.0
    return 0.0
"""
#: Time that the law is given to be compiled, and called [s].
_UNTIL_CALLED_S = 4.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "begin"),
    [
        ("endless", ("ball",)),
        ("slow", ("sweep", "--stiffness", "5:50:100", "--workers", "1")),
    ],
)
def test_ctrl_c_is_heard_while_a_law_computes(
    tmp_path: Path, law: str, begin: tuple[str, ...]
) -> None:
    (tmp_path / "laws.py").write_text(LAWS)
    process = ForkedPopen[str](
        [COMMAND, *begin, "--law", f"laws.py:{law}", "--output", "a.nc"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            wait_for((tmp_path / "loaded").exists)
            time.sleep(_UNTIL_CALLED_S)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert (process.returncode, errors) == (130, "canwall: interrupted\n")
