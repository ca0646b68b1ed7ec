"""The doctor: finds the drive, explains how it would be set up, and tests its watchdog.

The drive is set up as for a run, enabled with zero torque for the test, disabled, and everything
that was changed is put back.
"""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field

from canwall.bench.budget import USABLE, cycle_budget
from canwall.bench.latency import measurement_settings
from canwall.config import Settings
from canwall.cycle import Exchange, Loop, WallAxis, run_laws, run_loop
from canwall.drive import DriveError, DriveNode, DriveSetup, Link, PdoLayout, disable, set_up
from canwall.drive import objects as od
from canwall.drive.cia402 import DriveState, state_of, status_text
from canwall.eds import load_eds
from canwall.errors import RunFailedError
from canwall.record import Ring
from canwall.run import make_exchange

#: Seconds of a living master before it falls silent: some drives watch from the second sign on.
_ALIVE_S = 0.2
#: A watchdog that is later than its time by this much does not work.
_LATE_S = 0.5


@dataclass(frozen=True)
class Finding:
    """One line: of what, what was found, and whether all is well with it."""

    section: str
    what: str
    found: str
    well: bool = True


@dataclass
class Findings:
    """Findings in their order."""

    lines: list[Finding] = field(default_factory=list)

    @property
    def well(self) -> bool:
        """True if a run may be tried."""
        return all(line.well for line in self.lines)

    def add(self, section: str, what: str, found: str, well: bool = True) -> None:
        """Note one finding."""
        self.lines.append(Finding(section, what, found, well))


def examine(
    link: Link,
    settings: Settings,
    required: tuple[int, ...],
    announce: Callable[[str], None],
    findings: Findings,
) -> None:
    """Examine the drive; announce gets each step before it is done.

    Whatever happens, torque is zero, the drive is disabled and put back at the end. Raises
    DriveError where the drive cannot be set up or does not follow, can.CanError.
    """
    settings = measurement_settings(settings)
    dictionary = load_eds(settings.drive.eds, settings.drive.node_id, required)
    node = DriveNode(link, settings.drive.node_id, dictionary, settings.drive.sdo_timeout_s)
    try:
        announce("setting the drive up; nothing is enabled")
        # In doubt the doctor goes on: that there is no watchdog is a finding, not an end.
        lenient = settings.drive.model_copy(update={"accept_no_watchdog": True})
        setup = set_up(node, lenient, settings.bus, settings.limits.torque_nm, real_time=True)
        _describe(setup, settings, findings)
        _describe_budget(node, setup, settings, findings)
        _test(node, setup, settings, announce, findings)
    finally:
        announce("putting the drive back as it was")
        failures = node.restore()
        for failure in failures:
            findings.add("put back", "not done", failure, well=False)
        if not failures:
            findings.add("put back", "changes", "all undone; nothing was stored")


def _describe(setup: DriveSetup, settings: Settings, findings: Findings) -> None:
    findings.add("identity", "0x1000, 0x1018", str(setup.identity))
    findings.add("mode", "0x6060", str(setup.mode))
    if setup.scales is not None:
        for found, whence in setup.scales.sources:
            findings.add("units", whence, found)
    enough = setup.torque_limit_nm >= settings.limits.torque_nm
    if not enough:
        findings.add(
            "units",
            "limits.torque_nm",
            f"{settings.limits.torque_nm:g} N·m is more than the drive gives",
            well=False,
        )
    findings.add("PDO", "TPDO, with every SYNC", _shown(setup.tpdo))
    effect = "at the next SYNC" if setup.synchronous else "on reception"
    findings.add("PDO", f"RPDO, effective {effect}", _shown(setup.rpdo))
    findings.add("PDO", "SYNC", f"{setup.sync_cob_id:#x}")
    for note in setup.notes:
        findings.add("notes", "drive", note)
    watchdog = setup.watchdog
    present = watchdog.kind != "none"
    findings.add(
        "watchdog", "set", str(watchdog), well=present or settings.drive.accept_no_watchdog
    )
    for passed_over in watchdog.passed_over:
        findings.add("watchdog", "passed over", passed_over)


def _describe_budget(
    node: DriveNode, setup: DriveSetup, settings: Settings, findings: Findings
) -> None:
    """Describe the budget of all that the drive sends with a SYNC, needed or not."""
    bus, budget = settings.bus, cycle_budget(node, setup, settings.bus)
    for line in budget.lines:
        frame = line.frame
        over = f"{line.earliest_s * 1e6:.0f} to {line.latest_s * 1e6:.0f} µs"
        findings.add(
            "bus budget",
            f"{frame.name} {frame.can_id:#05x}, {frame.length} bytes",
            f"at most {line.bits} bits, {line.share:.1%} of the cycle; over {over} after the SYNC "
            f"begins, by the bus alone",
        )
    findings.add(
        "bus budget",
        f"cycle of {bus.cycle_s * 1e3:g} ms at {bus.bitrate / 1000:g} kbit/s",
        f"{budget.share:.1%} used of {USABLE:.0%} that leave room for SDO, EMCY and heartbeats; "
        f"the highest rate that fits is {budget.highest_hz:g} Hz",
        well=budget.fits,
    )


def _shown(pdo: PdoLayout) -> str:
    return f"{pdo.cob_id:#x}: {', '.join(str(field) for field in pdo.fields)}"


def _test(
    node: DriveNode,
    setup: DriveSetup,
    settings: Settings,
    announce: Callable[[str], None],
    findings: Findings,
) -> None:
    """Enable with zero torque, fall silent, and watch the drive let go."""
    axis = WallAxis(node, setup, settings, run_laws(settings), Ring.create())
    announce("enabling the drive with zero torque: keep clear of the handle")

    def work(loop: Loop) -> bool:
        findings.add("enabling", "0x6041", "OPERATION ENABLED with zero torque")
        if setup.watchdog.kind != "none":
            _fall_silent(axis, loop, announce, findings)
        return loop.stops()

    try:
        with closing(make_exchange(node.link, [axis])) as exchange:
            outcome = run_loop(exchange, work)
        if outcome.trips:
            raise DriveError(f"node {node.node_id}: {'; '.join(outcome.trips)}")
        # The drive has left by its watchdog or by its RPDOs; what is in its objects is put to rest.
        disable(node)
        for note in outcome.notes:
            findings.add("put back", "not done", note, well=False)
    finally:
        axis.ring.close()


def _fall_silent(
    axis: WallAxis, loop: Loop, announce: Callable[[str], None], findings: Findings
) -> None:
    node, watchdog, exchange = axis.node, axis.setup.watchdog, loop.exchange
    alive_until = time.monotonic() + max(_ALIVE_S, 2.0 * watchdog.time_s)
    while time.monotonic() < alive_until and not loop.stops():
        exchange.cycle()
        statusword = int(axis.cycle["statusword"][0])
        if state_of(statusword) is not DriveState.OPERATION_ENABLED:
            raise RunFailedError(
                f"went to {status_text(statusword)} while its master was alive: drive.watchdog_s "
                f"= {watchdog.time_s:g} may be too short for this machine"
            )
    if loop.stops():
        return
    last_sign_s = _last_sign_of_life_s(axis, exchange)
    announce(f"falling silent, as a dead master would: {watchdog.kind}")
    while True:
        statusword = node.read(od.STATUSWORD)
        silent_s = time.perf_counter() - last_sign_s
        if state_of(statusword) is not DriveState.OPERATION_ENABLED:
            break
        if silent_s >= watchdog.time_s + _LATE_S:
            findings.add(
                "watchdog",
                "tested",
                f"no reaction within {silent_s:.3f} s: the drive stays in "
                f"{status_text(statusword)}",
                well=False,
            )
            return
    findings.add(
        "watchdog",
        "tested",
        f"{status_text(statusword)} {silent_s * 1e3:.0f} ms after the last sign of life",
    )
    # What 0x1029 makes of it may be another NMT state, without PDOs.
    node.command("OPERATIONAL")


def _last_sign_of_life_s(axis: WallAxis, exchange: Exchange) -> float:
    """Return when the drive last saw a frame that its watchdog waits for [s, perf_counter]."""
    if axis.setup.watchdog.error_control is not None:
        return exchange.last_error_control_ns * 1e-9
    return exchange.last_sync_ns * 1e-9 + float(axis.row["latency_s"][0])
