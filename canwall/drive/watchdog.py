"""The drive's own watchdog against a dead master: which one it has, set and read back.

In the order of their strength: the deadline of the RPDO itself (0x1400:05) notices a cycle that
hangs; the consumer heartbeat (0x1016) and life guarding (0x100C, 0x100D) a master that is gone.
What the drive does then is set by 0x6007, or follows from 0x1029.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from canwall.bus.can_ids import ERROR_CONTROL
from canwall.drive import objects as od
from canwall.drive.node import DriveError, DriveNode
from canwall.drive.pdo import PdoLayout, while_off

_OPERATIONAL = 5
_EVENT_TIMER = 5
_MAX_MS = 0xFFFF

#: Signs of life within one watchdog time: two may be lost or late.
_BEATS = 3

#: 0x6007, the best for a wall first: no torque at once, then what a fault does, then quick stop.
_REACTIONS = {2: "disable voltage", 1: "fault", 3: "quick stop"}


@dataclass(frozen=True)
class ErrorControlFrame:
    """A frame by which the master shows that it lives."""

    can_id: int
    data: bytes = b""
    remote: bool = False


@dataclass(frozen=True)
class Watchdog:
    """What watches the master, and what the master has to send for it.

    kind: "RPDO event timer", "consumer heartbeat", "life guarding" or "none".
    time_s: silence after which the drive reacts [s].
    beat: the frame that the cycle has to send at least every `period_s` seconds, the first one
    with the first cycle; None: its RPDOs are what is watched, or nothing is.
    reaction: what the drive does then, as it confirmed it.
    passed_over: why the stronger ones are not used.
    """

    kind: str
    time_s: float = math.inf
    error_control: ErrorControlFrame | None = None
    period_s: float = math.inf
    reaction: str = "nothing"
    passed_over: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.kind == "none":
            return "none: a master that dies leaves the torque on"
        every = f", a frame every {self.period_s * 1e3:g} ms" if self.error_control else ""
        return f"{self.kind}, {self.time_s * 1e3:g} ms{every}; then {self.reaction}"


NO_WATCHDOG = Watchdog("none")


def arm(
    node: DriveNode, rpdo: PdoLayout, time_s: float, master_id: int, accept_none: bool
) -> Watchdog:
    """Set the strongest watchdog that the drive takes; it begins with the first sign of life.

    Raises DriveError where it takes none, unless that is accepted.
    """
    passed_over: list[str] = []
    time_ms = min(math.ceil(round(time_s * 1e3, 6)), _MAX_MS)
    ways: tuple[tuple[str, Callable[[], tuple[float, ErrorControlFrame | None, float]]], ...] = (
        ("RPDO event timer", lambda: _rpdo_event_timer(node, rpdo, time_ms)),
        ("consumer heartbeat", lambda: _consumer_heartbeat(node, time_ms, master_id)),
        ("life guarding", lambda: _life_guarding(node, time_ms)),
    )
    for kind, way in ways:
        try:
            held_s, beat, period_s = way()
        except DriveError as error:
            passed_over.append(f"{kind}: {error}")
        else:
            return Watchdog(kind, held_s, beat, period_s, _reaction(node), tuple(passed_over))
    if accept_none:
        return Watchdog("none", passed_over=tuple(passed_over))
    raise DriveError(
        f"node {node.node_id}: no watchdog, so a master that dies leaves the torque on "
        f"({'; '.join(passed_over)}); --accept-no-watchdog goes on without one"
    )


def disarm(node: DriveNode, rpdo: PdoLayout, watchdog: Watchdog) -> None:
    """Switch off what `arm` has set, for a drive that is disabled: it would miss its master.

    In PRE-OPERATIONAL first, which ends the PDOs, and so the deadline of the RPDO, at once. What
    `restore` has to undo stays known. Raises DriveError, can.CanError.
    """
    node.command("PRE-OPERATIONAL")
    if watchdog.kind == "RPDO event timer":
        with while_off(node, rpdo.communication):
            node.write(rpdo.communication, _EVENT_TIMER, 0)
    elif watchdog.kind == "consumer heartbeat" and watchdog.error_control is not None:
        master_id = watchdog.error_control.can_id - ERROR_CONTROL
        for subindex in _heartbeat_entries(node):
            if node.read(od.CONSUMER_HEARTBEAT_TIME, subindex) >> 16 == master_id:
                node.write(od.CONSUMER_HEARTBEAT_TIME, subindex, 0)
    elif watchdog.kind == "life guarding":
        node.write(od.LIFE_TIME_FACTOR, 0, 0)
        node.write(od.GUARD_TIME, 0, 0)


def _heartbeat_entries(node: DriveNode) -> list[int]:
    return [i for i in range(1, 128) if node.has(od.CONSUMER_HEARTBEAT_TIME, i)]


def _rpdo_event_timer(
    node: DriveNode, rpdo: PdoLayout, time_ms: int
) -> tuple[float, ErrorControlFrame | None, float]:
    if not node.has(rpdo.communication, _EVENT_TIMER):
        raise DriveError(f"no 0x{rpdo.communication:04X}:05")
    with while_off(node, rpdo.communication):
        node.set(rpdo.communication, _EVENT_TIMER, time_ms)
    return time_ms * 1e-3, None, math.inf


def _consumer_heartbeat(
    node: DriveNode, time_ms: int, master_id: int
) -> tuple[float, ErrorControlFrame | None, float]:
    entries = _heartbeat_entries(node)
    if not entries:
        raise DriveError("no 0x1016")
    present = {i: node.read(od.CONSUMER_HEARTBEAT_TIME, i) for i in entries}
    free = [i for i, value in present.items() if not value & 0xFFFF or value >> 16 == master_id]
    if not free:
        raise DriveError("0x1016: every entry watches another node")
    # An entry that is in use is changed only after it was switched off.
    if present[free[0]]:
        node.set(od.CONSUMER_HEARTBEAT_TIME, free[0], 0)
    node.set(od.CONSUMER_HEARTBEAT_TIME, free[0], master_id << 16 | time_ms)
    beat = ErrorControlFrame(ERROR_CONTROL + master_id, bytes([_OPERATIONAL]))
    return time_ms * 1e-3, beat, time_ms * 1e-3 / _BEATS


def _life_guarding(node: DriveNode, time_ms: int) -> tuple[float, ErrorControlFrame | None, float]:
    if not (node.has(od.GUARD_TIME) and node.has(od.LIFE_TIME_FACTOR)):
        raise DriveError("no 0x100C, 0x100D")
    # A node that sends heartbeats is not guarded (CiA 301, 7.2.8.3.2).
    if node.has(od.PRODUCER_HEARTBEAT_TIME) and node.read(od.PRODUCER_HEARTBEAT_TIME):
        node.set(od.PRODUCER_HEARTBEAT_TIME, 0, 0)
    guard_ms = math.ceil(time_ms / _BEATS)
    node.set(od.GUARD_TIME, 0, guard_ms)
    node.set(od.LIFE_TIME_FACTOR, 0, _BEATS)
    beat = ErrorControlFrame(ERROR_CONTROL + node.node_id, remote=True)
    return guard_ms * _BEATS * 1e-3, beat, guard_ms * 1e-3


def _reaction(node: DriveNode) -> str:
    if node.has(od.ABORT_CONNECTION_OPTION_CODE):
        for code, name in _REACTIONS.items():
            try:
                node.set(od.ABORT_CONNECTION_OPTION_CODE, 0, code)
            except DriveError:
                continue
            return f"{name} (0x6007 = {code})"
        kept = node.read(od.ABORT_CONNECTION_OPTION_CODE)
        if kept in _REACTIONS:
            return f"{_REACTIONS[kept]} (0x6007 = {kept}, as the drive has it)"
    if node.has(od.ERROR_BEHAVIOUR, 1):
        # 1 would leave the NMT state, and with it the RPDOs' last torque, as it is.
        if node.read(od.ERROR_BEHAVIOUR, 1) == 1:
            node.set(od.ERROR_BEHAVIOUR, 1, 0)
        return "leaves NMT OPERATIONAL (0x1029:01); what its torque does then, a test shows"
    return "what the drive is made to do: it has neither 0x6007 nor 0x1029"
