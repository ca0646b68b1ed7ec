"""A run in progress, as other processes on this machine see it and act on it.

The run publishes its rows (`Ring`), its status and its settings (`Snapshot`) in shared memory that
others open to read; it takes requests (`Mailbox`) and looks at the words of `Controls`. It waits
for none of them. `LiveRun` is the reader's side.
"""

import mmap
import os
import threading
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from canwall.config import (
    ChangeWall,
    ConfigError,
    Guard,
    Limits,
    Operator,
    Request,
    Section,
    TakeTurns,
    Wall,
    WallChange,
    absolute_law,
    parse_request,
)
from canwall.errors import RunFailedError
from canwall.record.controls import Controls
from canwall.record.folder import RunFolder, of_several_drives
from canwall.record.mailbox import Mailbox
from canwall.record.ring import Ring
from canwall.record.shared_memory import (
    LiveAddresses,
    MemoryAddress,
    address_of,
    create_memory,
    exists,
    open_memory,
)
from canwall.record.snapshot import Snapshot
from canwall.record.status import KILLED, STATUS, Status, to_status

_C = TypeVar("_C", bound=WallChange)

_KIND = "state"
#: Room for the settings [bytes].
_SETTINGS = 1 << 16
_STATUS_SIZE = Snapshot.size(STATUS.itemsize)
_SIZE = _STATUS_SIZE + Snapshot.size(_SETTINGS)


class LiveOption(Section):
    """Option of a law."""

    name: str
    default: float
    low: float | None = None
    high: float | None = None


class LiveLaw(Section):
    """Law of the run."""

    name: str
    options: tuple[LiveOption, ...] = ()


class LiveSettings(Section):
    """Settings in force in a run.

    Attributes:
        revision: Number of changes so far.
        wall: Wall in force.
        limits: Limits in force.
        guard: Guard in force.
        operator: Identification of the operator in force.
        turns: Walls that alternate from strike to strike; one if none do.
        laws: Laws that a change may name.
        config: Path of the resolved configuration of the run.
        rated_torque_nm: Torque of 1000 ‰.
        torque_limit_nm: Torque that the drive itself gives at the most, if it has a limit.
        count_rad: One count of the encoder.
        cycle_s: Period of the SYNC.
        handle_radius_m: Radius of the handle, if it is known.
        side: Side of the wall.
        node_id: Node-ID of the drive.
        bus: Interface and channel.
    """

    revision: int
    wall: Wall
    limits: Limits
    guard: Guard
    operator: Operator
    turns: tuple[Wall, ...]
    laws: tuple[LiveLaw, ...]
    config: str
    rated_torque_nm: float
    torque_limit_nm: float | None
    count_rad: float
    cycle_s: float
    handle_radius_m: float | None
    side: str
    node_id: int
    bus: str


class LiveMemory:
    """Shared memory of a run, with what it publishes and the requests to it; the run's side."""

    def __init__(self, ring: Ring) -> None:
        """Make the memory of a run with this ring. Raises OSError."""
        self._ring = ring
        self.mailbox = Mailbox.create()
        self.controls = Controls.create()
        self._descriptor = create_memory(_KIND, _SIZE)
        self._status, self._settings = _snapshots(mmap.mmap(self._descriptor, _SIZE))

    @property
    def addresses(self) -> LiveAddresses:
        """Addresses for other processes on this machine."""
        return LiveAddresses(
            self.mailbox.address,
            self._ring.address,
            address_of(self._descriptor),
            self.controls.address,
        )

    def publish(self, status: NDArray[np.void]) -> None:
        """Publish a record STATUS, shape (1,)."""
        self._status.publish(status.tobytes())

    def publish_settings(self, settings: LiveSettings) -> None:
        """Publish the settings in force. Raises ValueError if they are too long."""
        self._settings.publish(settings.model_dump_json().encode())

    def close(self) -> None:
        """Close it in this process; readers keep what they have open."""
        self.mailbox.close()
        self.controls.close()
        os.close(self._descriptor)


class LiveRun:
    """A run in progress in another process, read and changed from this one.

    Each method may be called by a thread of its own; `rows` by one at a time.

    Attributes:
        folder: Its record.
        pid: Process of the run.
        rows_lost: Number of rows that were overwritten before `rows` read them.
    """

    def __init__(self, folder: RunFolder, addresses: LiveAddresses) -> None:
        """Open the memory of a run; see `open`. Raises OSError."""
        self.folder = folder
        self.pid = addresses.mailbox.pid
        self.rows_lost = 0
        self._place: MemoryAddress = addresses.state
        self._next: int | None = None
        self._posting = threading.Lock()
        self._last_status: Status | None = None
        self._last_settings: tuple[int, LiveSettings] | None = None
        self._closed = False
        self._mailbox = Mailbox.open(addresses.mailbox)
        self._controls = Controls.open(addresses.controls)
        self._ring = Ring.open(addresses.rows)
        descriptor = open_memory(_KIND, addresses.state, _SIZE)
        memory = mmap.mmap(descriptor, _SIZE, access=mmap.ACCESS_READ)
        os.close(descriptor)
        self._status, self._settings = _snapshots(memory)

    @classmethod
    def open(cls, folder: RunFolder | Path) -> Self:
        """Open the run that writes a folder. Raises ConfigError if none is in progress."""
        if isinstance(folder, Path):
            folder = RunFolder(folder)
        try:
            return cls(folder, folder.read_live())
        except (OSError, ValueError):
            raise ConfigError(
                of_several_drives(folder.path)
                or f"{folder.path}: no run in progress; give the folder of one that is"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """Close what is open; the run goes on. Once is enough, and again does nothing."""
        if self._closed:
            return
        self._closed = True
        self._mailbox.close()
        self._controls.close()
        self._ring.close()

    @property
    def alive(self) -> bool:
        """True as long as the process of the run has its memory."""
        return exists(self._place)

    def rows(self) -> NDArray[np.void]:
        """Return the rows since the last call, at first the last 16 000; shape (n,), dtype ROW."""
        start = self._next or 0
        self._next, rows = self._ring.rows_since(start)
        if start:
            self.rows_lost += self._next - start - len(rows)
        return rows

    def status(self) -> Status:
        """Return the latest status; after a run that was killed, the last one, as ended.

        Raises RunFailedError if the run has published none.
        """
        alive = self.alive  # first: then comes its last status
        found = self._status.read()
        if found is not None:
            self._last_status = to_status(np.frombuffer(found, STATUS, 1))
        if self._last_status is None:
            raise RunFailedError(f"{self.folder.path}: the run does not say how it is")
        if not alive and not self._last_status.ended:
            trip = self._last_status.trip or KILLED
            self._last_status = self._last_status._replace(ended=True, trip=trip)
        return self._last_status

    def settings(self) -> LiveSettings:
        """Return the settings in force. Raises RunFailedError if the run has published none."""
        number = self._settings.number
        if self._last_settings is None or number != self._last_settings[0]:
            found = self._settings.read()
            if found is not None:
                self._last_settings = number, LiveSettings.model_validate_json(found)
        if self._last_settings is None:
            raise RunFailedError(f"{self.folder.path}: the run does not say how it is set")
        return self._last_settings[1]

    def request(self, values: dict[str, Any] | Request, timeout_s: float = 5.0) -> int:
        """Make a request (docs/formats.md), and wait until it is taken.

        Returns:
            The cycle from which on it is in force.

        Raises:
            ConfigError: If it is wrong, the run refuses it, or this is closed; with the reason.
            RunFailedError: If the run has ended, or does not take it in time.
        """
        self._refuse_closed()
        request = parse_request(values) if isinstance(values, dict) else values
        text = _with_absolute_laws(request).model_dump_json(exclude_none=True)
        try:
            with self._posting:
                return self._mailbox.post(text, timeout_s)
        except OSError:  # not answered in time, or closed at the end of the run
            ended = self._status.read() is not None and self.status().ended
            why = "has ended" if ended else "does not take the change"
            raise RunFailedError(f"{self.folder.path}: the run {why}") from None

    def stop(self) -> None:
        """Have the torque zero in the next RPDO, and the run end; no process has to wake up.

        Raises ConfigError if this is closed.
        """
        self._refuse_closed()
        self._controls.stop()

    def beat(self) -> None:
        """Show a sign of life, for a run that was asked to watch for it (`watch_beat`).

        Raises ConfigError if this is closed.
        """
        self._refuse_closed()
        self._controls.beat()

    def _refuse_closed(self) -> None:
        if self._closed:
            raise ConfigError(f"{self.folder.path}: is detached from; attach to it again")


def _snapshots(memory: mmap.mmap) -> tuple[Snapshot, Snapshot]:
    """Return the snapshots of status and settings in their memory."""
    return Snapshot(memory, 0, STATUS.itemsize), Snapshot(memory, _STATUS_SIZE, _SETTINGS)


def _with_absolute_laws(request: Request) -> Request:
    """Return the request with laws in files by their absolute paths."""
    if isinstance(request, ChangeWall):
        return _with_absolute_law(request)
    if isinstance(request, TakeTurns):
        walls = tuple(map(_with_absolute_law, request.walls))
        return request.model_copy(update={"walls": walls})
    return request


def _with_absolute_law(change: _C) -> _C:
    if change.law is None:
        return change
    return change.model_copy(update={"law": absolute_law(change.law, Path())})
