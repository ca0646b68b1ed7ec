"""What the tests share: rigs and programs that are ended with the test, and one recorded run."""

import contextlib
import signal
import subprocess
from collections.abc import Iterator

import pytest
from commands import Record, Start, command
from rig import Rig, RigFactory

# A shell without job control starts what it puts into the background with SIGINT ignored, and
# canwall leaves it so: its tests are to mean the same there.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def make_rig() -> Iterator[RigFactory]:
    with contextlib.ExitStack() as stack:

        def make(*args: object, **kwargs: object) -> Rig:
            rig = Rig(*args, **kwargs)  # type: ignore[arg-type]
            stack.callback(rig.close)
            return rig

        yield make


@pytest.fixture
def start() -> Iterator[Start]:
    with contextlib.ExitStack() as stack:

        def start(*command: object) -> "subprocess.Popen[str]":
            process = subprocess.Popen(
                [str(part) for part in command],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield start


@pytest.fixture(scope="session")
def four_strikes(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """The main job as it comes: four strikes, the law changing between them."""
    folder = tmp_path_factory.mktemp("four_strikes") / "run"
    done = command("run", "--output", folder)
    assert (done.returncode, done.stderr) == (0, "")
    (folder / "stdout.txt").write_text(done.stdout)
    return Record(folder)
