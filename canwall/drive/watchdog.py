"""Watchdog of the drive against a dead master.

In the order of their strength: the deadline of the RPDO itself (0x1400:05) detects a cycle that
hangs; the consumer heartbeat (0x1016) and life guarding (0x100C, 0x100D) detect a master that is
gone. The reaction of the drive is set by 0x6007, or follows from 0x1029.
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

#: Frames within one watchdog time, so that two may be lost or late.
_FRAMES_PER_TIMEOUT = 3

#: Values of 0x6007, the best for a wall first: no torque at once, reaction to a fault, quick stop.
_REACTIONS = {2: "disable voltage", 1: "fault", 3: "quick stop"}


@dataclass(frozen=True)
class ErrorControlFrame:
    """A frame that shows the drive a living master: a heartbeat or a guarding request."""

    can_id: int
    data: bytes = b""
    remote: bool = False


@dataclass(frozen=True)
class Watchdog:
    """Watchdog of a drive, and the frames that the master has to send for it.

    Attributes:
        kind: "RPDO event timer", "consumer heartbeat", "life guarding" or "none".
        time_s: Silence of the master after which the drive reacts [s].
        error_control: Frame to send, from the first cycle on; None if the RPDOs are monitored, or
            nothing is.
        period_s: Longest interval between two of these frames [s].
        reaction: Reaction of the drive, as it confirmed it.
        passed_over: Why stronger watchdogs are not used.
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
    """Set the strongest watchdog that the drive accepts; it starts with the first frame.

    Args:
        node: The drive.
        rpdo: RPDO of the cycle.
        time_s: Silence of the master after which the drive is to react [s].
        master_id: Node-ID of the master.
        accept_none: Accept a drive without a watchdog.

    Raises:
        DriveError: If the drive accepts none.
    """
    passed_over: list[str] = []
    time_ms = min(math.ceil(round(time_s * 1e3, 6)), _MAX_MS)
    kinds: tuple[tuple[str, Callable[[], tuple[float, ErrorControlFrame | None, float]]], ...] = (
        ("RPDO event timer", lambda: _rpdo_event_timer(node, rpdo, time_ms)),
        ("consumer heartbeat", lambda: _consumer_heartbeat(node, time_ms, master_id)),
        ("life guarding", lambda: _life_guarding(node, time_ms)),
    )
    for kind, set_watchdog in kinds:
        before = node.changes
        try:
            held_s, frame, period_s = set_watchdog()
            reaction = _set_reaction(node)
        except DriveError as error:
            # Half set, it might run all the same.
            passed_over.append("; ".join((f"{kind}: {error}", *node.undo(before))))
        else:
            return Watchdog(kind, held_s, frame, period_s, reaction, tuple(passed_over))
    if accept_none:
        return Watchdog("none", passed_over=tuple(passed_over))
    raise DriveError(
        f"node {node.node_id}: no watchdog, so a master that dies leaves the torque on "
        f"({'; '.join(passed_over)}); --accept-no-watchdog accepts that"
    )


def disarm(node: DriveNode, rpdo: PdoLayout, watchdog: Watchdog) -> None:
    """Switch off the watchdog of a drive that is disabled, which would report its master as lost.

    PRE-OPERATIONAL comes first: it ends the PDOs, and with them the deadline of the RPDO, at once.
    `restore` still knows the values from before `arm`. Raises DriveError, can.CanError.
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
    # No two entries may watch one node: that of a master before us comes first.
    free.sort(key=lambda i: present[i] >> 16 != master_id)
    # An entry in use has to be switched off before it is changed.
    if present[free[0]]:
        node.set(od.CONSUMER_HEARTBEAT_TIME, free[0], 0)
    node.set(od.CONSUMER_HEARTBEAT_TIME, free[0], master_id << 16 | time_ms)
    frame = ErrorControlFrame(ERROR_CONTROL + master_id, bytes([_OPERATIONAL]))
    return time_ms * 1e-3, frame, time_ms * 1e-3 / _FRAMES_PER_TIMEOUT


def _life_guarding(node: DriveNode, time_ms: int) -> tuple[float, ErrorControlFrame | None, float]:
    if not (node.has(od.GUARD_TIME) and node.has(od.LIFE_TIME_FACTOR)):
        raise DriveError("no 0x100C, 0x100D")
    # A node that sends heartbeats is not guarded (CiA 301, 7.2.8.3.2).
    if node.has(od.PRODUCER_HEARTBEAT_TIME) and node.read(od.PRODUCER_HEARTBEAT_TIME):
        node.set(od.PRODUCER_HEARTBEAT_TIME, 0, 0)
    guard_ms = math.ceil(time_ms / _FRAMES_PER_TIMEOUT)
    node.set(od.GUARD_TIME, 0, guard_ms)
    node.set(od.LIFE_TIME_FACTOR, 0, _FRAMES_PER_TIMEOUT)
    frame = ErrorControlFrame(ERROR_CONTROL + node.node_id, remote=True)
    return guard_ms * _FRAMES_PER_TIMEOUT * 1e-3, frame, guard_ms * 1e-3


def _set_reaction(node: DriveNode) -> str:
    """Set the reaction of the watchdog and return it as text."""
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
        if kept == 0:
            raise DriveError("0x6007 = 0, no action, and the drive lets nobody change it")
    if node.has(od.ERROR_BEHAVIOUR, 1):
        # 1 would keep the NMT state, and with it the last torque of the RPDO.
        if node.read(od.ERROR_BEHAVIOUR, 1) == 1:
            node.set(od.ERROR_BEHAVIOUR, 1, 0)
        return "leaves NMT OPERATIONAL (0x1029:01); test what its torque does then"
    return "unknown: the drive has neither 0x6007 nor 0x1029"
