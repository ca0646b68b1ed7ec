"""Pages that are open: what each of them is still to get, and which of them has control.

All of it belongs to the thread of the event loop.
"""

import asyncio
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canwall.panel.frames import signals_frame
from canwall.strict_json import as_json

#: Pages at a time.
MOST_PAGES = 16
#: Looks at the run, a second of them, whose binary frames wait for a page; older ones are left out.
_MOST_LOOKS = 30
#: Answers and events that wait for a page; one that lets more of them wait is closed.
_MOST_EVENTS = 256
#: Frames that a new page gets at once: the last 16 s.
_HISTORY = 480
#: Contacts that wait for a page, and contacts and marks that a new one gets; the last ones.
_CONTACTS, _MARKS = 100, 500

#: Events of which only the last one counts.
_STATES = ("run", "status", "settings", "presets", "ab", "blind")

Signals = tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]


class Outbox:
    """Messages that a page is still to get: bounded, however slowly it reads.

    Events come first, then states, of each of which there is only the last, then contacts and
    frames, of which there are the last ones.
    """

    def __init__(self) -> None:
        self._events: deque[str] = deque()
        self._states: dict[str, str] = {}
        self._contacts: deque[str] = deque(maxlen=_CONTACTS)
        self._looks: deque[list[bytes]] = deque(maxlen=_MOST_LOOKS)
        self._frames: deque[bytes] = deque()
        self._something = asyncio.Event()
        self.is_overfull = False

    def put_event(self, text: str) -> None:
        """Put in an answer or an event, none of which is left out."""
        self.is_overfull |= len(self._events) >= _MOST_EVENTS
        if not self.is_overfull:
            self._events.append(text)
        self._something.set()

    def put_state(self, kind: str, text: str) -> None:
        """Put in a state in place of the one before."""
        self._states[kind] = text
        self._something.set()

    def put_contact(self, text: str) -> None:
        """Put in a contact, in place of the oldest one if many wait."""
        self._contacts.append(text)
        self._something.set()

    def put_frames(self, frames: list[bytes]) -> None:
        """Put in the frames of a look at the run, in place of the oldest ones if many wait."""
        self._looks.append(frames)
        self._something.set()

    async def get(self) -> str | bytes | None:
        """Wait for the next message; None if the page has let too many events wait."""
        await self._something.wait()
        if self.is_overfull:
            return None
        message: str | bytes
        if self._events:
            message = self._events.popleft()
        elif self._states:
            message = self._states.pop(next(iter(self._states)))
        elif self._contacts:
            message = self._contacts.popleft()
        else:
            if not self._frames:
                self._frames.extend(self._looks.popleft())
            message = self._frames.popleft()
        waiting = self._events, self._states, self._contacts, self._frames, self._looks
        if not any(waiting):
            self._something.clear()
        return message


class Page:
    """A page that is open."""

    def __init__(self) -> None:
        self.outbox = Outbox()

    def tell(self, event: str, **content: Any) -> None:
        """Send an event to this page."""
        self.outbox.put_event(as_json({"event": event} | content))


class Pages:
    """The pages that are open, and what a new one has to know."""

    def __init__(self) -> None:
        self._pages: list[Page] = []
        self._states: dict[str, str] = {}
        self._contacts: deque[str] = deque(maxlen=_CONTACTS)
        self._marks: deque[Mapping[str, Any]] = deque(maxlen=_MARKS)
        self._history: deque[Signals] = deque(maxlen=_HISTORY)
        self._controller: Page | None = None

    def __len__(self) -> int:
        return len(self._pages)

    def open(self) -> Page:
        """Add a page; it has control if no other one has."""
        page = Page()
        self._pages.append(page)
        if self._controller is None:
            self._controller = page
        self._tell_control()
        for kind, text in self._states.items():
            page.outbox.put_state(kind, text)
        page.tell("marks", marks=list(self._marks))
        for text in self._contacts:
            page.outbox.put_contact(text)
        if self._history:
            time_s, low, high = zip(*self._history, strict=True)
            whole = (np.concatenate(part, axis=-1) for part in (time_s, low, high))
            page.outbox.put_frames([signals_frame(*whole)])
        return page

    def close(self, page: Page) -> None:
        """Remove a page. Its control is nobody's until a page takes it, or opens."""
        self._pages.remove(page)
        if self._controller is page:
            self._controller = None
        self._tell_control()

    def has_control(self, page: Page) -> bool:
        """Return True for the page that has control."""
        return page is self._controller

    def take_control(self, page: Page) -> None:
        """Give control to a page; the others are told."""
        self._controller = page
        self._tell_control()

    def _tell_control(self) -> None:
        for page in self._pages:
            others = len(self._pages) - 1
            content = {"event": "control", "you": page is self._controller, "others": others}
            page.outbox.put_state("control", as_json(content))

    def forget_run(self) -> None:
        """Forget what belongs to the run so far; a new one is followed."""
        for kind in ("status", "settings", "ab", "blind"):
            self._states.pop(kind, None)
        self._contacts.clear()
        self._marks.clear()
        self._history.clear()

    def tell(self, event: str, **content: Any) -> None:
        """Send an event to all pages, and to those that come."""
        text = as_json({"event": event} | content)
        if event in _STATES:
            self._states[event] = text
            for page in self._pages:
                page.outbox.put_state(event, text)
            return
        if event == "contact":
            self._contacts.append(text)
            for page in self._pages:
                page.outbox.put_contact(text)
            return
        if event == "marks":
            self._marks.extend(content["marks"])
        for page in self._pages:
            page.outbox.put_event(text)

    def show(self, signals: Signals, contact_frames: Iterable[bytes]) -> None:
        """Send signals, and what the running contact has new, to all pages."""
        frames = list(contact_frames)
        if len(signals[0]):
            self._history.append(signals)
            frames.insert(0, signals_frame(*signals))
        if frames:
            for page in self._pages:
                page.outbox.put_frames(frames)
