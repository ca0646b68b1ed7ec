"""Transmit PDOs (CiA 301, 7.5.2.37 and 7.5.2.38)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.cob_id import BIT_30
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.communication.frame import NS_PER_100_US, NS_PER_MS, Send
from canwall.simdrive.communication.pdo import CYCLIC, EVENT_DRIVEN, SYNCHRONOUS_REMOTE, Pdo
from canwall.simdrive.state import CYCLIC_OBJECTS, DriveRecord

_HIGHEST_COUNTER = 240


class Tpdo(Pdo):
    """One transmit PDO, sent with every n-th SYNC (1 to 240) or when its content has changed.

    Types 252 and 253 are sent only on request by a remote frame, with the content of the last SYNC
    or the present one. Other types also answer remote frames while bit 30 of the COB-ID is clear.
    With a SYNC counter, the first of every n-th waits for the SYNC start value (0x1800:06).
    An event is a change of the mapped values. It is sent with the next SYNC (type 0), or directly
    (254, 255), no sooner than the inhibit time after the last; the event timer sends without one.
    """

    transmit = True
    communication = range(0x1800, 0x1A00)

    def __init__(
        self,
        dictionary: Dictionary,
        index: int,
        state: DriveRecord,
        send: Send,
        changed: Callable[[], None],
    ) -> None:
        """Serve the communication parameter ``index`` and its mapping.

        Args:
            dictionary: has the entries.
            index: of the communication parameter.
            state: of the drive.
            send: takes the frames.
            changed: called when the PDO became active or inactive, or moved.

        Raises:
            DictionaryError: as Pdo.
        """
        self._send = send
        self._inhibit_time = dictionary.number(index, 3, absent=0)
        self._inhibit_time.check = self._check_inhibit_time
        self._start_value = dictionary.number(index, 6, absent=0)
        self._start_value.check = self._check_start_value
        super().__init__(dictionary, index, state, changed)

    @property
    def answers_remote(self) -> bool:
        """True if remote frames are answered, i.e. bit 30 of the COB-ID is clear."""
        return not self._cob_id.value & BIT_30

    @property
    def event_driven(self) -> bool:
        """True if a change of the content is sent without waiting for a SYNC."""
        return self._type.value in EVENT_DRIVEN

    @property
    def steady(self) -> bool:
        """True if `steady.take` may send it, with every SYNC."""
        return self._divider == 1 and self.in_state

    @property
    def payload(self) -> memoryview:
        """Data that `steady.take` has made up, in the record."""
        data: NDArray[np.int64] = self._record["tpdos"]["data"][0, self.number : self.number + 1]
        return data.view(np.uint8).data[: self._struct.size]

    @property
    def quiet(self) -> bool:
        """True if it is sent on events, and SYNCs and torques alone cause none."""
        constant = all(entry.index not in CYCLIC_OBJECTS for entry in self._entries)
        return constant and not self._event_ns and self._sent == self._payload()

    def configure(self) -> None:
        """Compile the mapping and start over."""
        super().configure()
        self._inhibit_ns = self._inhibit_time.value * NS_PER_100_US
        self._event_ns = self._event_time.value * NS_PER_MS
        self._frame_id = self.can_id
        # How many SYNCs make one transmission; None: an event does.
        self._divider = self._type.value if self._type.value in CYCLIC else None
        self._sampled = self._type.value == SYNCHRONOUS_REMOTE
        self.start()

    def start(self) -> None:
        """Start over, as on entering OPERATIONAL: the present content counts as an event."""
        self._syncs = 0
        self._awaited = self._start_value.value
        self._sent: bytes | None = None
        self._sample = self._payload()
        self._event_due_ns = 0
        self._inhibited_until_ns = 0

    def sync(self, counter: int) -> None:
        """Send with this SYNC if it is due; ``counter`` is 0 where SYNC has none."""
        if self._divider is None:
            payload = self._payload()
            if self._sampled:
                self._sample = payload
            elif payload != self._sent:
                self._transmit(payload)
            return
        if self._awaited and counter:
            if counter != self._awaited:
                return
            self._awaited = 0
            self._syncs = self._divider - 1
        self._syncs += 1
        if self._syncs >= self._divider:
            self._syncs = 0
            self._send((self._frame_id, self._payload()))

    def poll(self) -> None:
        """Send an event-driven PDO if its content has changed or its timer has run out."""
        payload = self._payload()
        now_ns = self._state.now_ns
        timer_due = self._event_ns and now_ns >= self._event_due_ns
        if (payload != self._sent or timer_due) and now_ns >= self._inhibited_until_ns:
            self._event_due_ns = now_ns + self._event_ns
            self._inhibited_until_ns = now_ns + self._inhibit_ns
            self._transmit(payload)

    def respond(self) -> None:
        """Answer a remote frame."""
        self._transmit(self._sample if self._sampled else self._payload())

    def _payload(self) -> bytes:
        return self._struct.pack(*[entry.value for entry in self._entries])

    def _transmit(self, payload: bytes) -> None:
        self._sent = payload
        self._send((self._frame_id, payload))

    def _check_start_value(self, value: int) -> None:
        self._check_not_valid()
        if value > _HIGHEST_COUNTER:
            raise AccessError(AbortCode.INVALID_VALUE)

    def _check_inhibit_time(self, _: int) -> None:
        self._check_not_valid()
