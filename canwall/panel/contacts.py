"""Contacts of a run in progress, measured while they last, and the chatter of the last moments.

The metrics are those of `canwall.analysis`, as in the summary of a run.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canwall.analysis import metrics
from canwall.analysis.felt import band_rms, felt_band, handle_radius
from canwall.record import ROW, Phase

#: Time over which chatter and felt ripple are judged [s].
_WINDOW_S = 2.0 * metrics.EVENT_WINDOW_S


@dataclass(frozen=True)
class Scale:
    """Periods, steps and names of a run, as the metrics need them.

    Attributes:
        cycle_s: Period of the SYNC [s].
        count_rad: One encoder count [rad].
        handle_radius_m: Radius of the handle [m]; None: HANDLE_RADIUS_M.
        laws: Names of the run's laws, to which the rows have indices.
        orientation: Direction out of the wall on the drive's axis, 1 or −1.
    """

    cycle_s: float
    count_rad: float
    handle_radius_m: float | None = None
    laws: Sequence[str] = ()
    orientation: float = 1.0


@dataclass(frozen=True)
class Contact:
    """A contact that has ended.

    Attributes:
        n: Its number, from 1.
        start_s: Start [s].
        end_s: End [s].
        energy_j: Energy that the wall has put out [J].
        passive: False if the wall had at any time put out more than quantisation explains.
        peak_force_nm: Largest force [N·m].
        depth_rad: Deepest position [rad].
        law: Law of the wall at the start.
        stiffness: Stiffness asked at the start [N·m/rad].
    """

    n: int
    start_s: float
    end_s: float
    energy_j: float
    passive: bool
    peak_force_nm: float
    depth_rad: float
    law: str
    stiffness: float


@dataclass
class _Running:
    """Sums of the contact that lasts; `whole`: its beginning was seen."""

    start_s: float
    law: str
    stiffness: float
    whole: bool
    energy_j: float = 0.0
    most_j: float = 0.0
    force_nm: float = 0.0
    largest_nm: float = 0.0
    depth_rad: float = 0.0

    def add(self, rows: NDArray[np.void], orientation: float) -> None:
        y, force = rows["y"], rows["force_applied"]
        # A wall that moves, to which y is relative, is no motion of the handle.
        handle = y + orientation * rows["wall_position_rad"]
        work = self.energy_j + metrics.energy_out(handle, force)
        self.energy_j, self.most_j = float(work[-1]), max(self.most_j, float(work.max()))
        self.force_nm = max(self.force_nm, float(force.max()))
        self.largest_nm = max(self.largest_nm, float(np.abs(force).max()))
        self.depth_rad = max(self.depth_rad, -float(y.min()))


@dataclass(frozen=True)
class Stretch:
    """Rows of one contact, as far as they have come.

    Attributes:
        begins: True if the contact begins with them.
        stiffness: Stiffness in force at the last of them [N·m/rad].
        rows: Rows, dtype ROW, shape (n,), each of them given once.
        ended: The contact, if it ended with them and its beginning was seen.
    """

    begins: bool
    stiffness: float
    rows: NDArray[np.void]
    ended: Contact | None


class ContactMeter:
    """Finds and measures contacts in the rows of a run."""

    def __init__(self, scale: Scale) -> None:
        self._scale = scale
        self._band = felt_band(scale.cycle_s)
        self._length = round(_WINDOW_S / scale.cycle_s)
        self._last: NDArray[np.void] | None = None
        self._recent = np.empty((2, 0))
        self._running: _Running | None = None
        self._contacts = 0
        self._free_since_s: float | None = None
        self._struck = 0

    def strike_ended(self) -> int | None:
        """Return the SYNC count at which a strike began, once after each of them; otherwise None.

        A strike has ended when a contact would no more belong to it.
        """
        if self._free_since_s is None or self._last is None or self.in_contact:
            return None
        if float(self._last["t_s"][0]) - self._free_since_s <= metrics.STRIKE_GAP_S:
            return None
        self._free_since_s = None
        return self._struck

    @property
    def in_contact(self) -> bool:
        """True if the handle is in contact in the last row."""
        return self._running is not None

    def take(self, rows: NDArray[np.void]) -> Iterator[Stretch]:
        """Measure rows; yield the stretches of contact in them.

        Args:
            rows: Rows of the record, dtype ROW, shape (n,). A contact in which rows are missing is
                left out.
        """
        if not len(rows):
            return
        new = 0
        if self._last is not None and rows["j"][0] == self._last["j"][0] + 1:
            # The energy of a period is known with the position at its end.
            rows, new = np.concatenate([self._last, rows]), 1
        else:
            self._running, self._recent = None, self._recent[:, :0]
        self._last = rows[-1:].copy()
        rendering = rows["phase"] == Phase.RENDERING
        y, force = np.where(rendering, rows["y"], np.inf), rows["force_applied"]
        recent = np.stack([rows["y"], force])[:, new:]
        self._recent = np.concatenate([self._recent, recent], axis=1)[:, -self._length :]
        touches_still = bool(metrics.contacts(y[-1:], force[-1:]))
        for touched in metrics.contacts(y, force):
            lasts = touches_still and touched.stop == len(rows)
            # Before the first row of all, or of those after a gap, it may have lasted already; and
            # a wall that fades in around the handle has not been struck.
            whole = touched.start > 0 and bool(rendering[touched.start - 1])
            yield self._measured(rows[touched], max(new - touched.start, 0), lasts, whole)

    def _measured(self, rows: NDArray[np.void], known: int, lasts: bool, whole: bool) -> Stretch:
        running, begins = self._running, self._running is None
        if running is None:
            first, known = rows[0], 0
            if self._free_since_s is None:
                self._struck = int(first["j"])
            law = int(first["law"])
            name = self._scale.laws[law] if law < len(self._scale.laws) else ""
            running = _Running(float(first["t_s"]), name, float(first["stiffness"]), whole)
        running.add(rows, self._scale.orientation)
        ended = None
        if not lasts:
            self._free_since_s = float(rows["t_s"][-1])
            ended = self._ended(running, self._free_since_s) if running.whole else None
        self._running = running if lasts else None
        return Stretch(begins, float(rows["stiffness_in_force"][-1]), rows[known:], ended)

    def _ended(self, contact: _Running, end_s: float) -> Contact:
        self._contacts += 1
        tolerance = self._scale.count_rad * contact.largest_nm
        return Contact(
            self._contacts,
            contact.start_s,
            end_s,
            contact.energy_j,
            contact.most_j <= tolerance,
            contact.force_nm,
            contact.depth_rad,
            contact.law,
            contact.stiffness,
        )

    def chatter(self) -> tuple[bool, float, float]:
        """Return whether the wall chatters now, at which frequency [Hz], and the felt ripple [N].

        It is the verdict of `metrics.chatter` without a referent on the last 0.4 s; the ripple is
        that of its second half, NaN unless all of it is contact.
        """
        scale, (y, force) = self._scale, self._recent
        touched = metrics.contacts(y, force)
        if not touched:
            return False, 0.0, math.nan
        ripple = math.nan
        if len(y) == self._length and touched[0] == slice(0, len(y)):
            felt = band_rms(self._band, np.ascontiguousarray(force), len(y) // 2, len(y))
            ripple = felt / handle_radius(scale.handle_radius_m)
        energy_tolerance = scale.count_rad * float(np.abs(force).max())
        verdict = metrics.chatter(
            np.ascontiguousarray(y),
            None,
            scale.cycle_s,
            scale.count_rad,
            bool(metrics.energy_out(y, force).max() > energy_tolerance),
            metrics.Ripple(ripple),
        )
        if not verdict.chatters:
            return False, 0.0, ripple
        moves = force[len(y) // 2 :] if verdict.by == "ripple" else y
        return (
            True,
            float(metrics.limit_cycle(np.ascontiguousarray(moves), scale.cycle_s)[1]),
            ripple,
        )


def prepare() -> None:
    """Load what measures a contact: not when a run begins, which needs the processors itself."""
    rows = np.zeros(500, ROW)
    rows["j"], rows["phase"] = np.arange(len(rows)), Phase.RENDERING
    rows["y"], rows["force_applied"] = -1.0, np.arange(len(rows)) % 2
    meter = ContactMeter(Scale(1e-3, 1e-3))
    for _ in meter.take(rows):
        meter.chatter()
