"""Heartbeat (CiA 301, 7.2.8.3.2): the producer of 0x1017 and the consumer of 0x1016."""

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from canwall.bus.can_ids import ERROR_CONTROL
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Dictionary, Entry, Key
from canwall.simdrive.communication.frame import NS_PER_MS, Clock, Send

Report: TypeAlias = Callable[[Key], None]
"""Called with the (index, sub-index) of an entry."""

_NMT_STATE = 0x7F
_BOOT_UP = 0


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 milliseconds, beginning one period after the write."""

    def __init__(self, dictionary: Dictionary, clock: Clock, send: Send) -> None:
        """Serve 0x1017 of the dictionary."""
        self._can_id = ERROR_CONTROL + dictionary.node_id
        self._clock = clock
        self._send = send
        self._time_ms = dictionary.number(0x1017, absent=0)
        self._time_ms.react = lambda _: self.reset()
        self.reset()

    def reset(self) -> None:
        """Start a new period now, with the time in 0x1017."""
        self._period_ns = self._time_ms.value * NS_PER_MS
        self._due_ns = self._clock.now_ns + self._period_ns

    def boot_up(self) -> None:
        """Send the boot-up message."""
        self._send((self._can_id, bytes([_BOOT_UP])))

    def tick(self, nmt_state: int) -> None:
        """Send the heartbeat that is due; missed periods are not made up for."""
        now_ns = self._clock.now_ns
        if self._period_ns and now_ns >= self._due_ns:
            self._send((self._can_id, bytes([nmt_state])))
            self._due_ns += self._period_ns
            if self._due_ns <= now_ns:
                self._due_ns = now_ns + self._period_ns


class HeartbeatConsumer:
    """Monitors the nodes of 0x1016, each from its first heartbeat on.

    A boot-up message is no heartbeat: a master that restarts is missed like one that died.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        clock: Clock,
        changed: Callable[[], None],
        lost: Report,
        regained: Report,
    ) -> None:
        """Serve 0x1016 of the dictionary.

        Args:
            dictionary: has the entries.
            clock: protocol time.
            changed: called when other nodes are to be monitored.
            lost: called with the (index, sub-index) of the entry whose time has run out.
            regained: called with the entry whose node is back, or is not monitored any more.
        """
        self._changed = changed
        self._nodes = [
            _MonitoredNode(dictionary[0x1016, subindex], clock, lost, regained)
            for subindex in range(1, 128)
            if (0x1016, subindex) in dictionary
        ]
        for node in self._nodes:
            node.entry.check = partial(self._check, node)
            node.entry.react = partial(self._react, node)

    def reset(self) -> None:
        """Wait for the first heartbeat of every node again."""
        for node in self._nodes:
            node.deadline_ns = None

    def routes(self) -> dict[int, Callable[[bytes], None]]:
        """Return the receiver of the heartbeats of each monitored node, by CAN-ID."""
        return {
            ERROR_CONTROL + _node_id(node.entry.value): node.receive
            for node in self._nodes
            if _is_used(node.entry.value)
        }

    def tick(self) -> None:
        """Report the nodes that have been silent for too long, once."""
        for node in self._nodes:
            node.tick()

    def _check(self, node: "_MonitoredNode", value: int) -> None:
        if value >> 24 or _node_id(value) > 127:
            raise AccessError(AbortCode.INVALID_VALUE)
        others = [other.entry.value for other in self._nodes if other is not node]
        monitored = [_node_id(other) for other in others if _is_used(other)]
        if _is_used(value) and _node_id(value) in monitored:
            raise AccessError(AbortCode.INCOMPATIBLE_PARAMETER)

    def _react(self, node: "_MonitoredNode", _: int) -> None:
        node.stop()
        self._changed()


class _MonitoredNode:
    """One monitored node: bits 16 to 23 of the entry are its ID, bits 0 to 15 the time in ms."""

    def __init__(self, entry: Entry, clock: Clock, lost: Report, regained: Report) -> None:
        self.entry = entry
        self.deadline_ns: int | None = None
        self._clock = clock
        self._lost = lost
        self._regained = regained

    def receive(self, data: bytes) -> None:
        if len(data) == 1 and data[0] & _NMT_STATE != _BOOT_UP:
            time_ms = self.entry.value & 0xFFFF
            self.deadline_ns = self._clock.now_ns + time_ms * NS_PER_MS
            self._regained(self.entry.key)

    def tick(self) -> None:
        if self.deadline_ns is not None and self._clock.now_ns >= self.deadline_ns:
            self.deadline_ns = None
            self._lost(self.entry.key)

    def stop(self) -> None:
        self.deadline_ns = None
        self._regained(self.entry.key)


def _node_id(value: int) -> int:
    return value >> 16 & 0xFF


def _is_used(value: int) -> bool:
    return bool(_node_id(value) and value & 0xFFFF)
