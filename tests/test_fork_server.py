"""A forked program is like one that is started: streams, signals, folder, environment, end."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fork_server import ForkedPopen, PopenByFork

FORKED = pytest.mark.parametrize("popen", [ForkedPopen, PopenByFork])
Popen = type["subprocess.Popen[str]"]


def said_by(popen: Popen, code: str, *words: str, **options: object) -> tuple[int, str, str]:
    """Exit code, output and errors of a program."""
    pipe = subprocess.PIPE
    with popen(
        [sys.executable, "-c", code, *words], stdout=pipe, stderr=pipe, text=True, **options
    ) as process:
        out, errors = process.communicate()
    return process.returncode, out, errors


@pytest.mark.slow
@FORKED
def test_streams_arguments_folder_and_environment(popen: Popen, tmp_path: Path) -> None:
    code = "import os, sys; print(sys.argv, os.getcwd(), os.getenv('COLOUR'), input())"
    with popen(
        [sys.executable, "-c", code, "a b"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={"COLOUR": "red"},
    ) as process:
        out, errors = process.communicate("typed\n")
    assert (process.returncode, errors) == (0, None)
    assert out == f"['-c', 'a b'] {tmp_path} red typed\n"


@FORKED
def test_it_is_a_child_with_nothing_open_but_its_own(popen: Popen) -> None:
    code = "import os; print(os.getppid(), len(os.listdir('/proc/self/fd')), os.getpgid(0))"
    _, out, _ = said_by(popen, code)
    # Three streams, and the folder that is being listed.
    assert out.split() == [str(os.getpid()), "4", str(os.getpgid(0))]


@FORKED
def test_descriptor_that_is_passed_on(popen: Popen) -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading) as ours:
        said_by(popen, f"import os; os.write({writing}, b'here')", pass_fds=[writing])
        os.close(writing)
        assert ours.read() == "here"


@FORKED
def test_session_of_its_own(popen: Popen) -> None:
    _, out, _ = said_by(popen, "import os; print(os.getsid(0) == os.getpid())", start_new_session=1)
    assert out == "True\n"


@FORKED
@pytest.mark.parametrize(
    ("code", "ended"),
    [("", 0), ("import sys; sys.exit(3)", 3), ("1 / 0", 1), ("import os; os._exit(4)", 4)],
)
def test_exit_code(popen: Popen, code: str, ended: int) -> None:
    returned, out, errors = said_by(popen, code)
    assert (returned, out) == (ended, "")
    assert ("ZeroDivisionError: division by zero" in errors) == (code == "1 / 0")


@FORKED
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_signals(popen: Popen, number: signal.Signals) -> None:
    code = (
        "import time\n"
        "try: print('ready', flush=True); time.sleep(60)\n"
        "except KeyboardInterrupt: raise SystemExit(130)"
    )
    with popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGSTOP)
        assert process.poll() is None
        process.send_signal(signal.SIGCONT)
        process.send_signal(number)
        assert process.wait() == (130 if number == signal.SIGINT else -number)


def test_what_runs_at_exit_runs() -> None:
    code = "import atexit; atexit.register(print, 'left'); print('ran')"
    assert said_by(ForkedPopen, code) == (0, "ran\nleft\n", "")
