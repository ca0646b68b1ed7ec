"""Calls in threads of their own, which are given up if they do not come back.

Compiled code and blocking system calls cannot be interrupted, so whoever must go on in spite of
them has them called by another thread, and looks at its progress.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

#: Interval at which a call is looked at [s].
LOOK_S = 0.01

given_up: list[threading.Thread] = []
"""Threads that may still be running; only the end of the process ends them."""


def interruptible(function: Callable[[], object]) -> None:
    """Call a function in a thread of its own, which Ctrl-C leaves behind."""
    call = Call(function, lambda: None)
    try:
        while not call.has_ended():
            pass
    except KeyboardInterrupt:
        call.give_up()
        raise
    if call.error is not None:
        raise call.error


class Call:
    """A call in a thread of its own.

    Attributes:
        error: What the function raised, once it has ended.
        seen: Progress at the last look.
        waited_s: Time without progress in which the thread waited, not for a processor [s].
        computed_s: Time without progress in which it computed [s].
    """

    def __init__(self, function: Callable[[], object], progress: Callable[[], object]) -> None:
        """Start the call.

        Args:
            function: The function to be called.
            progress: Returns a value that changes as long as the function gets on.
        """
        self.error: BaseException | None = None
        self.waited_s = self.computed_s = 0.0
        self._function, self._progress = function, progress
        self._ended = threading.Event()
        self._clock: int | None = None
        self.seen: Any = progress()
        self._looked_s, self._passed_s = time.monotonic(), 0.0
        self._begun = (0.0, 0.0)
        self._thread = threading.Thread(target=self._run, daemon=True)
        try:
            self._thread.start()
        except RuntimeError:  # no more threads: without supervision rather than not at all
            self._run()

    def _run(self) -> None:
        self._clock = time.pthread_getcpuclockid(threading.get_ident())
        try:
            self._function()
        except BaseException as error:
            self.error = error
        finally:
            self._ended.set()

    def has_ended(self) -> bool:
        """Wait for LOOK_S; return True if the call has ended."""
        if self._ended.wait(LOOK_S):
            return True
        self._look()
        return False

    def give_up(self) -> None:
        """Leave the thread behind."""
        given_up.append(self._thread)

    def place(self) -> str:
        """Name the function that does not come back, as far as Python knows."""
        frame = sys._current_frames().get(self._thread.ident or 0)
        if frame is None:
            return "a call"
        code = frame.f_code
        return f"{code.co_qualname} ({Path(code.co_filename).name}:{frame.f_lineno})"

    def _look(self) -> None:
        progress, now_s = self._progress(), time.monotonic()
        # If this thread did not run either, the machine stood still, and not the call.
        self._passed_s += min(now_s - self._looked_s, 2.0 * LOOK_S)
        self._looked_s = now_s
        if progress != self.seen:
            self.seen, self._passed_s, self._begun = progress, 0.0, self._spent()
            self.waited_s = self.computed_s = 0.0
            return
        computed_s, queued_s = (
            now - then for now, then in zip(self._spent(), self._begun, strict=True)
        )
        self.computed_s = computed_s
        self.waited_s = max(0.0, self._passed_s - computed_s - queued_s)

    def _spent(self) -> tuple[float, float]:
        """Return the thread's time on a processor, and in the queue for one [s]."""
        computed_s = queued_s = 0.0
        with contextlib.suppress(OSError, ValueError, IndexError):  # the thread has just ended
            if self._clock is not None:
                computed_s = time.clock_gettime(self._clock)
            queue = Path(f"/proc/self/task/{self._thread.native_id}/schedstat").read_text()
            queued_s = int(queue.split()[1]) * 1e-9
        return computed_s, queued_s
