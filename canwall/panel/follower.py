"""Thread that follows a run: reads what it publishes, and tells the pages.

It looks 30 times a second, finds a new run when the one before has ended, and never writes to a
run but what a page requests.
"""

import contextlib
import json
import math
import os
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from canwall.config import Request, Wall
from canwall.errors import InputError, RunFailedError
from canwall.panel.frames import Buckets, contact_frame
from canwall.panel.launch import StartedRun
from canwall.panel.pages import Signals
from canwall.record import RunFolder
from canwall.record.status import KILLED
from canwall.strict_json import plain

if TYPE_CHECKING:
    from canwall.panel.contacts import Contact

#: Intervals at which signals, the state and new runs are looked at [s].
_TICK_S, _STATUS_S, _SEARCH_S = 1.0 / 30.0, 0.1, 0.5
#: Points of a signal in a second.
_POINTS_HZ = 250.0
#: Runs of a folder that are looked at for one in progress: the last ones by name.
_NEWEST = 32
#: Largest part of events.jsonl that is read at once, and longest line [bytes].
_MOST_EVENTS = 1 << 16
#: Time over which the use of limits is shown [s].
_USED_S = 1.0


class Live(Protocol):
    """The part of `canwall.record.live.LiveRun` that the panel uses."""

    pid: int
    rows_lost: int

    @property
    def alive(self) -> bool:
        """False once the process of the run has ended, however it did."""

    def rows(self) -> NDArray[np.void]:
        """Return the rows since the last call."""

    def status(self) -> Any:
        """Return a snapshot of the run's state."""

    def settings(self) -> Any:
        """Return the settings in force."""

    def request(self, values: dict[str, Any] | Request, timeout_s: float = 5.0) -> int:
        """Have the run take a request; return the cycle."""

    def stop(self) -> None:
        """Have the torque be zero in the next cycle, and the run end."""

    def beat(self) -> None:
        """Tell the run that somebody is there."""

    def close(self) -> None:
        """Close the run."""


class Audience(Protocol):
    """Recipient of what a follower sees; called in the follower's thread."""

    def tell(self, event: str, **content: Any) -> None:
        """Tell an event."""

    def show(self, signals: Signals, contact_frames: list[bytes]) -> None:
        """Show signals, and what is new of the running contact."""

    def attached(self, run: "Attached | None") -> None:
        """Take a new run, or that there is none."""

    def strike_ended(self, began: int) -> None:
        """Take the end of a strike: the handle is free, and has been for a moment.

        Args:
            began: SYNC count at which it began.
        """

    @property
    def is_blind(self) -> bool:
        """True while nothing may tell which wall is in force."""


@dataclass
class Attached:
    """A run that is followed, and its settings in force."""

    folder: Path
    live: Live
    settings: dict[str, Any]


class Follower:
    """Follower of the run of a folder, or of the newest run in it."""

    def __init__(
        self, folder: Path, audience: Audience, open_live: Callable[[Path], Live] | None = None
    ) -> None:
        """Prepare a thread.

        Args:
            folder: Folder of a run, or of runs.
            audience: Where it tells what it sees.
            open_live: Opens a run in progress; InputError if there is none.
        """
        self._thread = threading.Thread(target=self._work, name="follower", daemon=True)
        self._folder = folder
        self._audience = audience
        self._open_live = open_live or _open_live
        self._ending = threading.Event()
        self._started: StartedRun | None = None
        self._run: Attached | None = None
        self._last: tuple[Path, int] | None = None
        #: True once it looks.
        self.is_ready = False

    def begin(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self) -> None:
        """End the thread, if it was started; the run goes on."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()

    def expect(self, started: StartedRun) -> None:
        """Follow a run that is about to begin."""
        self._started = started

    def _work(self) -> None:
        self._audience.tell("run", state="none", name="", folder="", text="")
        from canwall.panel.contacts import ContactMeter, Scale, prepare  # takes seconds

        prepare()
        self._new_meter, self._scale = ContactMeter, Scale
        self.is_ready = True
        next_s = time.monotonic()
        while not self._ending.wait(max(0.0, next_s - time.monotonic())):
            next_s = max(next_s + _TICK_S, time.monotonic())
            try:
                if self._run is None:
                    next_s += self._search()
                else:
                    self._follow()
            except Exception as error:
                # The page says so, the terminal has the rest; a new run is followed again.
                traceback.print_exc()
                self._leave("failed", f"the panel cannot follow the run: {error}")
        if self._run is not None:
            self._run.live.close()

    def _search(self) -> float:
        """Attach to a run if there is one; return how much longer to wait [s]."""
        if self._started is not None and self._failed_to_start(self._started):
            self._started = None
        for folder in self._candidates():
            if not (folder / "live.json").exists():
                continue
            try:
                live = self._open_live(folder)
            except InputError:
                continue
            if (folder, live.pid) == self._last:  # it is still writing its record
                live.close()
                continue
            try:
                self._attach(folder, live)
            except RunFailedError:  # it has not said yet how it is set
                live.close()
                continue
            return 0.0
        return 0.0 if self._started is not None else _SEARCH_S

    def _candidates(self) -> Iterator[Path]:
        if self._started is not None:
            yield self._started.folder
            return
        yield self._folder
        with contextlib.suppress(OSError):
            inner = sorted((entry.name for entry in os.scandir(self._folder)), reverse=True)
            for name in inner[:_NEWEST]:
                yield self._folder / name

    def _failed_to_start(self, started: StartedRun) -> bool:
        if started.process.poll() is None:
            return False
        text = started.last_line() or f"canwall run ended with code {started.process.returncode}"
        self._tell_run("failed", started.folder, text)
        return True

    def _attach(self, folder: Path, live: Live) -> None:
        settings = plain(live.settings())
        self._run = Attached(folder, live, settings)
        self._last = (folder, live.pid)
        self._audience.attached(self._run)
        self._tell_run("attached", folder, "")
        cycle_s = float(settings["cycle_s"])
        self._meter = self._new_meter(
            self._scale(
                cycle_s,
                float(settings["count_rad"]),
                settings.get("handle_radius_m"),
                [law["name"] for law in settings["laws"]],
                Wall(side=settings["side"]).orientation,
            )
        )
        self._buckets = Buckets(math.ceil(1.0 / cycle_s / _POINTS_HZ))
        self._used = _Used(round(_USED_S / cycle_s))
        self._revision: int | None = None
        self._next_status_s = 0.0
        self._events = _Events(folder / "events.jsonl")

    def _follow(self) -> None:
        run = self._run
        assert run is not None
        alive = run.live.alive  # first: then come its last rows
        rows = run.live.rows()
        self._show(rows)
        now_s = time.monotonic()
        status = None
        if now_s >= self._next_status_s or not alive:
            self._next_status_s = now_s + _STATUS_S
            with contextlib.suppress(RunFailedError):  # it has not said yet how it is
                status = plain(run.live.status())
                self._tell_status(run, status)
        if status is not None and status["ended"]:
            self._leave("ended", status["trip"] or "the run has ended")
        elif not alive:
            self._leave("ended", KILLED)

    def _show(self, rows: NDArray[np.void]) -> None:
        blind = self._audience.is_blind
        frames = []
        self._used.take(rows)
        for stretch in self._meter.take(rows):
            slope = math.nan if blind else stretch.stiffness
            if stretch.begins:
                nothing = np.empty(0)
                frames.append(contact_frame(slope, nothing, nothing, nothing))
            new = stretch.rows
            frames.append(contact_frame(slope, new["t_s"], new["y"], new["force_applied"]))
            if stretch.ended is not None:
                self._tell_contact(stretch.ended, blind)
        began = self._meter.strike_ended()
        if began is not None:
            self._audience.strike_ended(began)
        signals = self._buckets.take(rows)
        if blind:
            for values in signals[1:]:
                values[-1] = math.nan  # stiffness_in_force
        self._audience.show(signals, frames)

    def _tell_contact(self, contact: "Contact", blind: bool) -> None:
        content = plain(contact)
        if blind:
            content |= {"law": None, "stiffness": None}
        self._audience.tell("contact", **content)

    def _tell_status(self, run: Attached, status: dict[str, Any]) -> None:
        if status["revision"] != self._revision:
            self._revision = status["revision"]
            run.settings = plain(run.live.settings())
            self.tell_settings()
        chatters, frequency, ripple = self._meter.chatter()
        self._audience.tell(
            "status",
            **status,
            chatter=chatters,
            chatter_hz=frequency,
            felt_ripple_n=ripple,
            in_contact=self._meter.in_contact,
            limits=self._used.of(run.settings["limits"], status),
            recording=not status["ended"],
            folder=str(run.folder),
            rows_skipped=run.live.rows_lost,
        )
        # They tell which wall is in force; afterwards they are read.
        if not self._audience.is_blind and (marks := self._events.new()):
            self._audience.tell("marks", marks=marks)

    def tell_settings(self) -> None:
        """Tell the settings in force, without those of the wall while a comparison is blind."""
        run = self._run
        if run is not None:
            hidden = {"wall": None, "turns": None} if self._audience.is_blind else {}
            self._audience.tell("settings", **(run.settings | hidden))

    def _leave(self, state: str, text: str) -> None:
        run, self._run = self._run, None
        started, self._started = self._started, None
        if run is not None:
            self._audience.attached(None)
            self._tell_run(state, run.folder, text)
            run.live.close()
        if started is not None:
            threading.Thread(target=started.process.wait, daemon=True).start()

    def _tell_run(self, state: str, folder: Path, text: str) -> None:
        self._audience.tell("run", state=state, name=folder.name, folder=str(folder), text=text)


class _Used:
    """Use of the limits over the last second."""

    def __init__(self, cycles: int) -> None:
        self._cycles = cycles
        self._rows = np.empty((3, 0))

    def take(self, rows: NDArray[np.void]) -> None:
        new = np.stack([rows["torque_cmd"], rows["v_est"], rows["position_rad"]])
        self._rows = np.concatenate([self._rows, new], axis=1)[:, -self._cycles :]

    def of(self, limits: dict[str, Any], status: dict[str, Any]) -> list[dict[str, Any]]:
        """Return name, bound and used part of each limit."""
        if not self._rows.shape[1]:
            return []
        torque, speed, position = self._rows
        low, high = limits["position_rad"]
        # As far from the middle as towards the nearer limit.
        reach = 2.0 * np.abs(position - 0.5 * (low + high)) / (high - low)
        found = [
            ("torque_nm", "N·m", limits["torque_nm"], np.abs(torque) / limits["torque_nm"]),
            ("speed_rad_s", "rad/s", limits["speed_rad_s"], np.abs(speed) / limits["speed_rad_s"]),
            ("position_rad", "rad", high, reach),
        ]
        if limits.get("energy_j"):
            energy = np.array([status.get("energy_j") or 0.0])
            found.append(("energy_j", "J", limits["energy_j"], energy / limits["energy_j"]))
        return [
            {"name": name, "unit": unit, "bound": bound, "used": float(np.nanmax(used))}
            for name, unit, bound, used in found
        ]


class _Events:
    """New lines of a run's events.jsonl."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0

    def new(self) -> list[dict[str, Any]]:
        """Return the events that are complete and were not returned before."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._read)
                content = file.read(_MOST_EVENTS)
        except OSError:
            return []
        whole = content.rfind(b"\n") + 1
        if not whole and len(content) == _MOST_EVENTS:
            whole = len(content)  # nothing that a run writes
        self._read += whole
        found = []
        for line in content[:whole].splitlines():
            with contextlib.suppress(ValueError, RecursionError):
                event = json.loads(line)
                if isinstance(event, dict):
                    found.append(event)
        return found


def _open_live(folder: Path) -> Live:
    from canwall.record.live import LiveRun

    return LiveRun.open(RunFolder(folder))
