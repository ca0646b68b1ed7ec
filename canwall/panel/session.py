"""One panel: the run that is followed, the pages that are open, and what they ask for.

The event loop's thread has the pages and never waits for anything. The follower's thread reads the
run. Requests are carried out in a thread of their own, one at a time; `stop` and `beat` are words
of shared memory and wait for none of them.
"""

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from canwall.config import ConfigError
from canwall.errors import InputError, RunFailedError
from canwall.panel.follower import Attached, Follower, Live
from canwall.panel.launch import Launcher, StartedRun
from canwall.panel.messages import Start, validated
from canwall.panel.pages import Page, Pages, Signals
from canwall.panel.presets import Presets
from canwall.panel.requests import RunRequests, tell_presets

#: Requests that wait for their turn, of all pages.
_MOST_WAITING = 16
#: Patience with a run that is asked to stop [s], and interval of the looks at it [s].
_STOP_S, _LOOK_S = 3.0, 0.005

#: Time without a run and a page after which a panel that was opened with a run ends [s].
_ALONE_S = 30.0
#: Priority of the panel's threads: the cycle and its record come first.
_NICE = 10

_NO_RUN = "no run is in progress"
#: Requests that every page may send.
_FREE = ("stop", "beat", "take_control")


class Session:
    """A panel without its web server; its methods are called in the thread of the event loop."""

    def __init__(
        self,
        folder: Path,
        launcher: Launcher,
        dead_man_s: float = 0.0,
        with_run: bool = False,
        open_live: Callable[[Path], Live] | None = None,
    ) -> None:
        """Prepare a panel.

        Args:
            folder: Folder of a run, or of runs: the one in progress is followed.
            launcher: What starts runs.
            dead_man_s: Time after the last beat of the page in control at which the run ends; 0:
                it does not end for that [s].
            with_run: The panel has served its purpose once no run is in progress and no page open.
            open_live: Opens a run in progress.
        """
        self.pages = Pages()
        self.launcher = launcher
        self._dead_man_s = dead_man_s
        self._with_run = with_run
        self._needed_s = time.monotonic()
        self._follower = Follower(folder, self, open_live)
        self._requests = ThreadPoolExecutor(1, "requests")
        self._starts = ThreadPoolExecutor(1, "starts")
        self._start_lock = asyncio.Lock()
        self._waiting = 0
        self._presets = Presets()
        self._run: Attached | None = None
        self._to_run: RunRequests | None = None
        self._starting: StartedRun | None = None
        self._watches_beat = False
        self._loop: asyncio.AbstractEventLoop | None = None

    def begin(self) -> None:
        """Begin to follow; called in the event loop."""
        self._loop = asyncio.get_running_loop()
        self._starts.submit(_nothing).result()  # what this thread starts has the priority of now
        os.nice(_NICE)
        self._follower.begin()
        self._requests.submit(tell_presets, self._presets, self.tell)

    def end(self) -> None:
        """End the threads; the run goes on."""
        self._follower.end()
        self._requests.shutdown(wait=False, cancel_futures=True)
        self._starts.shutdown(wait=False, cancel_futures=True)

    def is_done(self) -> bool:
        """Return True if the panel was to be there for a run, and nobody needs it any more."""
        now_s = time.monotonic()
        waits = not self._follower.is_ready or self._is_starting
        if waits or self._run is not None or len(self.pages):
            self._needed_s = now_s
        return self._with_run and now_s - self._needed_s > _ALONE_S

    @property
    def folder_of_run(self) -> Path | None:
        """Folder of the run in progress, None if there is none."""
        return self._run.folder if self._run else None

    # What the follower tells, in its thread.

    @property
    def is_blind(self) -> bool:
        """True while nothing may tell which wall is in force."""
        to_run = self._to_run
        return to_run is not None and to_run.comparison.active

    def tell(self, event: str, **content: Any) -> None:
        """Have all pages told of an event; from any thread."""
        self._call(lambda: self.pages.tell(event, **content))

    def show(self, signals: Signals, contact_frames: list[bytes]) -> None:
        """Have signals shown on all pages; from any thread."""
        self._call(lambda: self.pages.show(signals, contact_frames))

    def attached(self, run: Attached | None) -> None:
        """Take a new run, or that there is none."""
        before, self._to_run = self._to_run, None
        if before is not None:
            self._submit(before.run_ended)
        if run is not None:
            self._to_run = RunRequests(run.folder, run.live, self._presets, self.tell)
        self._call(lambda: self._take_run(run))
        if self._to_run is not None:
            self._submit(self._to_run.tell)

    def strike_ended(self, began: int) -> None:
        """Take the end of a strike that began at a SYNC count."""
        if self.is_blind and self._to_run is not None:
            self._submit(partial(self._to_run.strike_ended, began))

    def _submit(self, call: Callable[[], object]) -> None:
        """Have something done in the thread of requests; pages are told what went wrong."""

        def done() -> None:
            try:
                call()
            except (InputError, RunFailedError) as error:
                self.tell("problem", text=str(error))

        with contextlib.suppress(RuntimeError):  # the panel ends
            self._requests.submit(done)

    def _call(self, call: Callable[[], None]) -> None:
        assert self._loop is not None
        with contextlib.suppress(RuntimeError):  # it has ended, and all pages with it
            self._loop.call_soon_threadsafe(call)

    def _take_run(self, run: Attached | None) -> None:
        self._run, self._starting, self._watches_beat = run, None, False
        if run is not None:
            self.pages.forget_run()

    # What pages ask for.

    async def answer(self, page: Page, message: dict[str, Any]) -> dict[str, Any]:
        """Do what a page asks for; return the answer to it, without its number."""
        do = message.get("do")
        try:
            content = validated(message)
            if do not in _FREE and not self.pages.has_control(page):
                raise ConfigError("this page does not have control; take it first")
            if do == "stop":
                return await self._stop()
            if do == "beat":
                return self._beat(page)
            if do == "take_control":
                self.pages.take_control(page)
                return {"ok": True}
            return {"ok": True} | await self._in_turn(str(do), content)
        except (InputError, RunFailedError) as error:
            return {"ok": False, "error": str(error)}

    async def start(self, request: Start) -> dict[str, Any]:
        """Start a run. Raises ConfigError if it cannot be."""
        async with self._start_lock:
            if self._run is not None or self._is_starting:
                raise ConfigError("a run is in progress; end it first")
            loop = asyncio.get_running_loop()
            self._starting = started = await loop.run_in_executor(
                self._starts, self.launcher.start, request
            )
            self._follower.expect(started)
        self.pages.tell(
            "run", state="starting", name=started.folder.name, folder=str(started.folder), text=""
        )
        return {"folder": str(started.folder)}

    @property
    def _is_starting(self) -> bool:
        return self._starting is not None and self._starting.process.returncode is None

    async def _stop(self) -> dict[str, Any]:
        """Have the torque be zero in the next cycle; tell when the run has said so."""
        asked_s = time.monotonic()
        run = self._run
        if run is None:
            if self._starting is None or not self._is_starting:
                raise ConfigError(_NO_RUN)
            self._starting.process.send_signal(signal.SIGINT)  # on its way to the first torque
            return {"ok": True, "confirmed": False}
        run.live.stop()
        while time.monotonic() - asked_s < _STOP_S:
            if self._run is not run or _has_stopped(run.live):
                return {"ok": True, "confirmed": True, "seconds": time.monotonic() - asked_s}
            await asyncio.sleep(_LOOK_S)
        return {
            "ok": False,
            "confirmed": False,
            "error": "the run does not answer: use Ctrl-C at its terminal, or the emergency stop",
        }

    def _beat(self, page: Page) -> dict[str, Any]:
        """Pass on that the page in control is there; begin to watch for it if asked to."""
        if self._run is None or not self.pages.has_control(page):
            return {"ok": False, "error": "only the page in control of a run has a beat"}
        self._run.live.beat()
        if self._dead_man_s and not self._watches_beat:
            self._watches_beat = True
            self._submit(partial(self._watch_beat, self._run))
        return {"ok": True}

    def _watch_beat(self, run: Attached) -> None:
        """Have a run watch for beats; the next beat tries again what fails."""
        try:
            run.live.request({"do": "watch_beat", "timeout_s": self._dead_man_s})
        except (InputError, RunFailedError):
            self._watches_beat = False
            raise

    async def _in_turn(self, do: str, content: Any) -> dict[str, Any]:
        if do == "start":
            return await self.start(content)
        if self._waiting >= _MOST_WAITING:
            raise ConfigError("too many requests wait for the run; this one was not passed on")
        loop = asyncio.get_running_loop()
        self._waiting += 1
        try:
            return await loop.run_in_executor(self._requests, self._carry_out, do, content)
        finally:
            self._waiting -= 1

    def _carry_out(self, do: str, content: Any) -> dict[str, Any]:
        """Carry out a request, in the thread of requests."""
        to_run = self._to_run
        if to_run is None:
            raise ConfigError(_NO_RUN)
        was_blind = self.is_blind
        try:
            return to_run.carry_out(do, content)
        finally:
            if self.is_blind != was_blind:
                self._follower.tell_settings()


def _nothing() -> None:
    pass


def _has_stopped(live: Live) -> bool:
    status = live.status()
    return status.ended or status.phase == "leaving"
