"""Node guarding and life guarding (CiA 301, 7.2.8.3.2.1): remote frames answered and awaited."""

from collections.abc import Callable

from canwall.bus.can_ids import ERROR_CONTROL
from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.frame import NS_PER_MS, Clock, Send
from canwall.simdrive.communication.heartbeat import Report

_GUARD_TIME = (0x100C, 0)
_LIFE_TIME_FACTOR: Key = (0x100D, 0)
_TOGGLE = 0x80


class NodeGuarding:
    """Answers the guarding master, and monitors it from its first remote frame on.

    The node life time is 0x100C (ms) times 0x100D; 0: the master is not monitored. A drive without
    0x100C cannot be guarded, and one that sends heartbeats (0x1017) is not.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        clock: Clock,
        send: Send,
        lost: Report,
        regained: Report,
    ) -> None:
        """Serve 0x100C and 0x100D of the dictionary.

        Args:
            dictionary: has the entries.
            clock: protocol time.
            send: takes the answers.
            lost: called with (index, sub-index) when the life time has run out.
            regained: called likewise when the master is back, or is not monitored any more.
        """
        self._clock = clock
        self._send = send
        self._lost = lost
        self._regained = regained
        self._heartbeat_time = dictionary.number(0x1017, absent=0)
        self._guard_time = dictionary.number(*_GUARD_TIME, absent=0)
        self._life_time_factor = dictionary.number(*_LIFE_TIME_FACTOR, absent=0)
        self._supported = _GUARD_TIME in dictionary
        self._can_id = ERROR_CONTROL + dictionary.node_id
        for entry in (self._guard_time, self._life_time_factor):
            entry.react = lambda _: self._stop()
        self.reset()

    def reset(self) -> None:
        """Start with toggle bit 0, and wait for the first remote frame again."""
        self._toggle = 0
        self._deadline_ns: int | None = None

    def routes(self, nmt_state: int) -> dict[int, Callable[[], None]]:
        """Return the function that answers the guarding master's remote frames, by CAN-ID."""
        return {self._can_id: lambda: self._guard(nmt_state)} if self._supported else {}

    def tick(self) -> None:
        """Report a master that has been silent for too long, once."""
        if self._deadline_ns is not None and self._heartbeat_time.value:
            self._stop()  # no node is guarded and sends heartbeats
        if self._deadline_ns is not None and self._clock.now_ns >= self._deadline_ns:
            self._deadline_ns = None
            self._lost(_LIFE_TIME_FACTOR)

    def _guard(self, nmt_state: int) -> None:
        if self._heartbeat_time.value:
            return
        self._send((self._can_id, bytes([self._toggle | nmt_state])))
        self._toggle ^= _TOGGLE
        life_time_ms = self._guard_time.value * self._life_time_factor.value
        if life_time_ms:
            self._deadline_ns = self._clock.now_ns + life_time_ms * NS_PER_MS
            self._regained(_LIFE_TIME_FACTOR)

    def _stop(self) -> None:
        self._deadline_ns = None
        self._regained(_LIFE_TIME_FACTOR)
