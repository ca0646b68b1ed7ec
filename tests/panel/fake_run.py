"""A run in progress without a run, and a panel beside it, for tests of the panel's server."""

import json
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canwall import config
from canwall.errors import ConfigError
from canwall.panel.launch import Launcher
from canwall.panel.recorded import routes
from canwall.panel.server import PanelServer
from canwall.panel.session import Session
from canwall.record import ROW, Phase
from canwall.record.live import LiveLaw, LiveSettings

CYCLE_S = 0.001

STATUS: dict[str, Any] = {
    "cycle": 0,
    "t_s": 0.0,
    "phase": "rendering",
    "ended": False,
    "trip": "",
    "revision": 0,
    "energy_j": 0.0,
}


def rows_of(y: NDArray[np.float64], first: int = 0, **columns: Any) -> NDArray[np.void]:
    """Rows of a run at a wall of 50 N·m/rad; other columns by name."""
    rows = np.zeros(len(y), ROW)
    rows["j"] = np.arange(first, first + len(y))
    rows["t_s"] = rows["j"] * CYCLE_S
    rows["phase"] = Phase.RENDERING
    rows["y"], rows["stiffness"], rows["stiffness_in_force"] = y, 50.0, 50.0
    rows["force_applied"] = np.maximum(-50.0 * y, 0.0)
    for name, values in columns.items():
        rows[name] = values
    return rows


@dataclass
class FakeRun:
    """What the panel uses of a run in progress; the test says what it publishes."""

    waiting: list[NDArray[np.void]] = field(default_factory=list)
    status_now: dict[str, Any] = field(default_factory=lambda: dict(STATUS))
    requests: list[dict[str, Any]] = field(default_factory=list)
    refusal: str | None = None
    #: The run takes no request before this is set.
    takes: threading.Event = field(default_factory=threading.Event)
    stopped: int = 0
    beats: int = 0
    pid: int = 1
    rows_lost: int = 0
    alive: bool = True
    closed: bool = False

    def __post_init__(self) -> None:
        self.takes.set()

    def publish(self, rows: NDArray[np.void]) -> None:
        self.waiting.append(rows)

    def rows(self) -> NDArray[np.void]:
        taken, self.waiting = self.waiting, []
        return np.concatenate([np.empty(0, ROW), *taken])

    def status(self) -> Any:
        return SimpleNamespace(**self.status_now, _asdict=lambda: dict(self.status_now))

    def settings(self) -> Any:
        settings = config.load(config.shipped("config/sim.toml"))
        return LiveSettings(
            revision=0,
            wall=settings.wall,
            limits=settings.limits,
            guard=settings.guard,
            operator=settings.operator,
            turns=(settings.wall,),
            laws=(LiveLaw(name="mean_force"),),
            config="config.toml",
            rated_torque_nm=0.637,
            torque_limit_nm=1.9,
            count_rad=4.8e-5,
            cycle_s=CYCLE_S,
            handle_radius_m=None,
            side="below",
            node_id=5,
            bus="virtual canwall",
        )

    def request(self, request: Any, timeout_s: float = 5.0) -> int:
        assert self.takes.wait(30.0)
        if self.refusal is not None:
            raise ConfigError(self.refusal)
        given = request if isinstance(request, dict) else request.model_dump(exclude_none=True)
        self.requests.append(given)
        return 7

    def stop(self) -> None:
        self.stopped += 1
        self.status_now["phase"] = "leaving"

    def beat(self) -> None:
        self.beats += 1

    def close(self) -> None:
        self.closed = True


class PanelBeside:
    """A panel on a free port of loopback, in a thread, that follows fake runs by their folders."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.folder = folder
        self.runs: dict[Path, FakeRun] = {}
        self.session = Session(folder, Launcher(folder), open_live=self._open, **options)
        self.server = PanelServer(self.session, routes(folder))
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self.server.serve, args=(self._ready.set,))

    def _open(self, folder: Path) -> FakeRun:
        if folder not in self.runs:
            raise ConfigError(f"{folder}: no run in progress")
        return self.runs[folder]

    def begin_run(self, name: str = "one", pid: int = 1) -> FakeRun:
        folder = self.folder / name
        folder.mkdir()
        (folder / "live.json").write_text(json.dumps({}))
        self.runs[folder] = FakeRun(pid=pid)
        return self.runs[folder]

    def __enter__(self) -> "PanelBeside":
        self._thread.start()
        assert self._ready.wait(30.0)
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.server.end()
        self._thread.join()

    @property
    def bearer(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.server.access.token}"}

    @property
    def is_serving(self) -> bool:
        return self._thread.is_alive()

    @property
    def connections(self) -> set[Any]:
        return self.server._server.server_state.connections

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.server.port}"


def wait_until(condition: Any, patience_s: float = 30.0) -> None:
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)
