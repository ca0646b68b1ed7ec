"""Fixtures for all tests: rigs and programs that end with the test, and one recorded run.

Reports unmarked tests that are `slow` by the rule in pyproject.toml. A test that ends its process
makes the exit code that of an internal error: scripts/test has no second run for it.
"""

import contextlib
import gc
import re
import signal
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fork_server
import hypothesis
import pytest
import rig
from commands import GUARD_SAID, Record, Start, installed_command
from fork_server import PYTHON, ForkedPopen, eds_read_once
from rig import Rig, RigFactory

import canwall.record.recorder
from canwall.run import assembly
from canwall.simdrive.communication import dictionary

# A shell without job control starts what it puts into the background with SIGINT ignored, nohup
# does so with SIGHUP, and canwall leaves it so: its tests are to mean the same there.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

# No example fails for the time it takes.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

#: A test that takes longer [s] is marked slow.
LIMIT_S = 1.0


class InterpreterStartedError(Exception):
    """A test that is not marked slow has started an interpreter."""


class Tiers:
    """Holds tests without the mark `slow` to its rule.

    One that starts an interpreter fails. Those that take longer than LIMIT_S are listed at the end
    and do not fail: that may be for what else the machine has to do.
    """

    def __init__(self) -> None:
        self._watching = False
        self._took: dict[str, float] = {}
        sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event != "subprocess.Popen" or not self._watching:
            return
        words = [str(word) for word in arguments[1]]
        if Path(words[0]).parent == PYTHON.parent and fork_server.__file__ not in words:
            raise InterpreterStartedError(f"ForkedPopen, or the mark slow, for {' '.join(words)}")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        self._watching = item.get_closest_marker("slow") is None
        try:
            return (yield)
        finally:
            self._watching = False

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" and "slow" not in report.keywords and report.duration > LIMIT_S:
            self._took[report.nodeid] = report.duration

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        if self._took:
            terminalreporter.section(f"took longer than {LIMIT_S:g} s, not marked slow")
            for name, took in sorted(self._took.items(), key=lambda one: -one[1]):
                terminalreporter.write_line(f"{took:.1f} s {name}")


class Crashes:
    """Tells a test that ends its process from one that fails."""

    def __init__(self) -> None:
        self._any = False

    @pytest.hookimpl(optionalhook=True)
    def pytest_handlecrashitem(self) -> None:
        self._any = True

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self._any:
            session.exitstatus = pytest.ExitCode.INTERNAL_ERROR


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Tiers())
    config.pluginmanager.register(Crashes())


@pytest.fixture(autouse=True)
def _little_to_collect() -> None:
    """Keep what there is by now from the garbage collector, once it has taken the last test's rest.

    Each wall has it run before its first cycle, which would take longer than many a wall. What is
    kept while it waits to be collected would hold its descriptors to the end.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _forked_writers() -> Iterator[None]:
    """Have the writers of records that are made in this process forked as well."""
    forking = types.SimpleNamespace(**{**vars(subprocess), "Popen": ForkedPopen})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canwall.record.recorder, "subprocess", forking)
        yield


@pytest.fixture(scope="session", autouse=True)
def _dictionaries_read_once() -> Iterator[None]:
    """Read each EDS once: most of the time that a rig takes."""
    load_once = eds_read_once()
    with pytest.MonkeyPatch.context() as patch:
        for user in (rig, assembly, dictionary):
            patch.setattr(user, "load_eds", load_once)
        yield


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
            process = ForkedPopen[str](
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
    done = installed_command("run", "--output", folder)
    assert done.returncode == 0
    # The plain wall's strikes.
    assert re.fullmatch(GUARD_SAID, done.stderr)
    (folder / "stdout.txt").write_text(done.stdout)
    return Record(folder)
