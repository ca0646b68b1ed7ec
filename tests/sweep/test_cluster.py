"""Sweeps on a Dask cluster, and what a killed worker and Ctrl-C leave of them."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commands import COMMAND, Start, command, python, wait_for
from fork_server import ForkedPopen
from rig import SIM_CONFIG

from canwall.sweep import read_sweep

pytestmark = pytest.mark.slow

PATIENCE_S = 120.0

#: A second's work for one core in 12 pieces: there is time to kill somebody.
SWEEP = [
    *("sweep", SIM_CONFIG, "--law", "push_only", "--operator", "finger"),
    *("--stiffness", "1:300:24", "--axis", "speed=0.5,1,2", "--axis", "phase=0:0.75:4"),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("whole") / "whole.nc"
    done = command(*SWEEP, "--output", output)
    assert (done.returncode, done.stderr) == (0, "")
    return output


class Cluster:
    """A scheduler and its workers, processes of their own on this machine."""

    def __init__(self, folder: Path, workers: int = 2, first: Path | None = None) -> None:
        """first: where its processes look for packages before they look anywhere else."""
        self.workers: list[subprocess.Popen[bytes]] = []
        self._first = first
        self._environment = dict(os.environ)
        if first is not None:
            others = os.environ.get("PYTHONPATH", "")
            self._environment["PYTHONPATH"] = f"{first}{os.pathsep}{others}".rstrip(os.pathsep)
        self._log = (folder / "log").open("wb")
        file = folder / "scheduler.json"
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
            "--scheduler-file", str(file),
        )  # fmt: skip
        wait_for(file.exists)
        self.scheduler_file = file
        self.workers = [
            self._start(
                "worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny",
                "--no-dashboard", "--local-directory", str(folder),
            )
            for _ in range(workers)
        ]  # fmt: skip
        wait_for(lambda: (folder / "log").read_text().count("Registered to:") == workers)

    def _start(self, *arguments: str) -> "subprocess.Popen[bytes]":
        # What is forked has imported canwall already.
        popen = subprocess.Popen[bytes] if self._first else ForkedPopen[bytes]
        return popen(
            [str(Path(COMMAND).with_name("dask")), *arguments],
            stdout=self._log,
            stderr=self._log,
            env=self._environment,
        )

    @property
    def address(self) -> str:
        import json

        return str(json.loads(self.scheduler_file.read_text())["address"])

    @contextlib.contextmanager
    def held_up(self) -> Iterator[None]:
        """Have one of the workers stand still, so that no sweep comes to its end."""
        self.workers[-1].send_signal(signal.SIGSTOP)
        yield
        self.workers[-1].send_signal(signal.SIGCONT)

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()
        self._log.close()


@pytest.fixture
def clusters(tmp_path: Path) -> Iterator[Callable[..., Cluster]]:
    running: list[Cluster] = []

    def start(workers: int = 2, first: Path | None = None) -> Cluster:
        folder = tmp_path / f"cluster{len(running)}"
        folder.mkdir()
        running.append(Cluster(folder, workers, first))
        return running[-1]

    yield start
    for cluster in running:
        cluster.close()


@pytest.fixture
def cluster(clusters: Callable[..., Cluster]) -> Cluster:
    return clusters()


def wait_for_pieces(output: Path, process: "subprocess.Popen[str]") -> None:
    """Until some of the sweep is on disk, and not all of it."""
    journal = output.with_name(output.name + ".partial")

    def came() -> bool:
        assert process.poll() is None, process.communicate()[1]
        return journal.exists() and journal.read_bytes().count(b"\n") > 2

    wait_for(came)


def begun(output: Path, *options: object) -> "subprocess.Popen[str]":
    """SWEEP, some of its pieces done."""
    process = ForkedPopen[str](
        [COMMAND, *map(str, (*SWEEP, "--output", output, *options))],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for_pieces(output, process)
    return process


def assert_resume_goes_on(output: Path, whole: Path) -> None:
    done = command(*SWEEP, "--output", output, "--resume", "--workers", 2)
    assert (done.returncode, done.stderr) == (0, "")
    assert read_sweep(output).identical(read_sweep(whole))


def test_a_worker_that_is_killed_loses_nothing_but_time(
    cluster: Cluster, whole: Path, tmp_path: Path
) -> None:
    output = tmp_path / "clustered.nc"
    with cluster.held_up():
        process = begun(output, "--dask", cluster.address)
        cluster.workers[0].kill()
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, errors) == (0, "")
    assert cluster.workers[0].poll() == -signal.SIGKILL
    assert read_sweep(output).identical(read_sweep(whole))


def test_worker_that_dies_with_results_is_no_word_on_the_terminal(cluster: Cluster) -> None:
    """The client warns if it asks for one just then, which cannot be timed: any warning here."""
    code = f"""
import logging
from pathlib import Path
from canwall.config import load
from canwall.sweep import make_plan
from canwall.sweep.workers import compute_pieces
plan = make_plan(load(Path({str(SIM_CONFIG)!r})), {{"stiffness": "1,2"}})
pieces = range(plan.pieces)
assert len(list(compute_pieces(plan, pieces, dask={cluster.address!r}))) == plan.pieces
for name in list(logging.root.manager.loggerDict):
    if name.startswith("distributed"):
        logging.getLogger(name).warning("this one")
"""
    done = python("-c", code)
    assert (done.returncode, done.stderr) == (0, "")


def test_lost_scheduler_ends_the_sweep_and_resume_goes_on(
    cluster: Cluster, whole: Path, tmp_path: Path
) -> None:
    output = tmp_path / "clustered.nc"
    with cluster.held_up():
        process = begun(output, "--dask", cluster.address)
        cluster.scheduler.kill()
    _, errors = process.communicate(timeout=PATIENCE_S)
    line = f"--dask {cluster.address}: the scheduler is gone; --resume continues {output}"
    assert (process.returncode, errors) == (1, f"canwall: {line}\n")
    assert_resume_goes_on(output, whole)


def another_version(folder: Path) -> None:
    info = folder / "canwall-0.0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: canwall\nVersion: 0.0.1\n")


def none_at_all(folder: Path) -> None:
    (folder / "canwall.py").write_text("raise ImportError('this machine has no canwall')\n")


@pytest.mark.parametrize(
    ("made", "line"),
    [
        (another_version, "a worker has canwall 0.0.1; needed: canwall "),
        (none_at_all, "need the canwall of this machine: this machine has no canwall"),
    ],
)
def test_cluster_with_other_software_computes_nothing(
    made: Callable[[Path], None], line: str, clusters: Callable[..., Cluster], tmp_path: Path
) -> None:
    packages, output = tmp_path / "packages", tmp_path / "a.nc"
    packages.mkdir()
    made(packages)
    done = command(*SWEEP, "--output", output, "--dask", clusters(1, packages).address)
    assert done.returncode == 1
    assert line in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert not list(tmp_path.glob("a.nc*"))


def test_law_that_has_changed_since_a_worker_read_it_is_not_computed_with(
    cluster: Cluster, tmp_path: Path
) -> None:
    law = tmp_path / "law.py"
    sweep = ["sweep", SIM_CONFIG, "--law", f"{law}:spring", "--stiffness", 10, "--axis", "speed=1"]
    law.write_text("def spring(wall):\n    return -wall.stiffness * min(wall.y, 0.0)\n")
    done = command(*sweep, "--output", tmp_path / "a.nc", "--dask", cluster.address)
    assert (done.returncode, done.stderr) == (0, "")
    law.write_text("def spring(wall):\n    return -2.0 * wall.stiffness * min(wall.y, 0.0)\n")
    done = command(*sweep, "--output", tmp_path / "b.nc", "--dask", cluster.address)
    assert done.returncode == 1
    assert f"a worker has another {law}, or has read it before it changed" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.glob("b.nc*"))


def test_ctrl_c_ends_a_sweep_by_frames(start: Start, tmp_path: Path) -> None:
    """Within a piece, whose processes end with it; what is done is kept."""
    output = tmp_path / "a.nc"
    sweep = ("sweep", SIM_CONFIG, "--through", "bus", "--law", "standard")
    process = start(COMMAND, *sweep, "--stiffness", "1:100:400", "--output", output)
    journal = tmp_path / "a.nc.partial"
    # Of two, one is kept even if Ctrl-C comes as the other is being written.
    wait_for_pieces(output, process)
    began_s = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert time.monotonic() - began_s < 10.0
    assert process.returncode == 130
    assert errors.endswith(f"canwall: interrupted; --resume continues {output}\n")
    assert journal.exists()


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_what_was_interrupted_goes_on(whole: Path, tmp_path: Path, end: signal.Signals) -> None:
    output = tmp_path / "a.nc"
    process = begun(output, "--workers", 1)
    os.kill(process.pid, end)
    _, errors = process.communicate(timeout=PATIENCE_S)
    if end == signal.SIGINT:
        assert process.returncode == 130
        assert errors == f"canwall: interrupted; --resume continues {output}\n"
    assert not output.exists()
    assert command(*SWEEP, "--output", output).returncode == 2
    assert_resume_goes_on(output, whole)
    assert [path.name for path in tmp_path.iterdir()] == ["a.nc"]
