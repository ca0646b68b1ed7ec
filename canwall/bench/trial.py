"""The doctor's trial of an enabled drive: timing, a first motion, the watchdog.

Nothing but the first motion gives a torque.
"""

import re
import time
from collections.abc import Callable
from contextlib import closing

import can

from canwall.bench.findings import Findings, noted
from canwall.bench.first_motion import FirstMotion
from canwall.config import Settings
from canwall.cycle import (
    Exchange,
    ExperimentError,
    Loop,
    WallAxis,
    percentile_ns,
    run_laws,
    run_loop,
)
from canwall.drive import DriveError, DriveNode, DriveSetup, disable
from canwall.drive import objects as od
from canwall.drive.cia402 import Controlword, DriveState, state_of, status_text
from canwall.record import Phase, Ring
from canwall.run import make_exchange, make_monitor

#: Time for which the timing of the cycle is measured [s]. The master then falls silent; some drives
#: watch from its second sign of life on.
_ALIVE_S, _SIGNS = 0.5, 2.5
#: A watchdog that is later than its time by this much does not work.
_LATE_S = 0.5
#: Parts of the cycles without a TPDO, and with an RPDO after the next SYNC, that no run bears.
_MOST_MISSED, _MOST_LATE = 0.05, 0.25
#: Part of the torque that 0x6077 has to show.
_LEAST_SHOWN = 0.5


#: What to do by the error code of EMCY and 0x603F, its upper digits (CiA 402-2, table of error
#: codes).
_BY_ERROR_CODE = {
    "2": "look for a short circuit of the motor, and to its current limits",
    "31": "look to the mains",
    "32": "switch the supply of the power stage on, or look to its voltage (0x6079)",
    "4": "let drive and motor cool",
    "5": "the drive's manual has its hardware errors",
    "61": "the drive's manual has its firmware errors",
    "63": "look to the drive's parameters in the vendor's tool",
    "7": "look to motor, brake and encoder, and to their cables",
    "81": "look to the bus and to drive.watchdog_s",
    "825": "look to the bus and to drive.watchdog_s",
    "82": "look for somebody else who sends PDOs to the drive",
    "86": "the vendor's tool has the limits of position and speed",
    "87": "look for what keeps SYNC from the drive, or from its time (0x1006, bus.cycle_s)",
    "9": "release the emergency stop or safe torque off, and look to its wiring",
}
_INTERLOCK, _VOLTAGE_ENABLED = 1 << 3, 1 << 4


class Trial:
    """Tests with the drive enabled."""

    def __init__(
        self,
        node: DriveNode,
        setup: DriveSetup,
        settings: Settings,
        announce: Callable[[str], None],
        findings: Findings,
        move: bool,
    ) -> None:
        self._node, self._setup, self._settings = node, setup, settings
        self._announce, self._findings, self._move = announce, findings, move

    def make(self) -> None:
        """Enable the drive unless there is trouble, try it, disable it. Raises can.CanError."""
        settings, findings = self._settings, self._findings
        if not findings.well:
            findings.add("enabling", "0x6041", "not tried", do="mend the troubles first")
            return
        ring = Ring.create()
        enabled = len(findings.lines)
        try:
            ring.take_rows()  # compiled before any SYNC
            axis = WallAxis(self._node, self._setup, settings, run_laws(settings), ring)
            self._announce("enabling the drive with zero torque: keep clear of the handle")
            counted = self._node.link.on_error_frame
            with closing(make_exchange(self._node.link, [axis])) as exchange:
                monitor = make_monitor(self._node.link, [axis])
                judged = self._node.link.on_error_frame

                def both(message: can.Message) -> None:
                    for each in (counted, judged):
                        if each is not None:
                            each(message)

                self._node.link.on_error_frame = both
                outcome = run_loop(exchange, lambda loop: self._try(axis, loop))
            was_enabled = len(findings.lines) > enabled
            if outcome.trips:
                self._announce("asking the drive for the cause of its end")
            for trip in outcome.trips:
                section = "cycle" if was_enabled else "enabling"
                findings.add_trouble(section, "0x6041", trip, self._cause(trip))
            for note in (*monitor.notes, *outcome.notes):
                findings.add("put back", "not done", note, well=False)
            # The drive has left by its watchdog or by its RPDOs; what is in its objects is put to
            # rest.
            with noted(findings, "put back", "disabling"):
                disable(self._node)
        finally:
            ring.close()

    def _try(self, axis: WallAxis, loop: Loop) -> bool:
        findings, settings = self._findings, self._settings
        findings.add("enabling", "0x6041", "OPERATION ENABLED with zero torque")
        period, watchdog = settings.bus.cycle_s, self._setup.watchdog
        signs_s = _SIGNS * watchdog.period_s if watchdog.error_control is not None else 0.0
        cycles = round(max(_ALIVE_S, signs_s) / period)
        first, missed, late = loop.j, int(axis.cycle["missed_tpdo"][0]), axis.late_rpdo
        if loop.measure([_Stillness(axis, cycles)]):
            return True
        count = max(1, loop.j - first)
        self._describe_timing(
            axis,
            (int(axis.cycle["missed_tpdo"][0]) - missed) / count,
            (axis.late_rpdo - late) / count,
        )
        if (found_s := loop.exchange.other_period_s) is not None:
            findings.add_trouble(
                "latency",
                "SYNC",
                f"comes every {found_s * 1e3:.3g} ms, but bus.cycle_s is {period * 1e3:g} ms",
                "correct it, or the producer of the SYNC",
            )
        if self._move and self._first_motion(axis, loop):
            return True
        if watchdog.kind != "none":
            # What the drive reports of a master that is silent is no trouble.
            axis.cycle["phase"] = Phase.ENABLING
            _fall_silent(axis, loop, self._announce, findings)
        return loop.stops()

    def _describe_timing(self, axis: WallAxis, missed: float, late: float) -> None:
        p50, p99 = (percentile_ns(axis.sync_to_rpdo, percent) * 1e-3 for percent in (50, 99))
        largest = float(axis.sync_to_rpdo["largest_ns"][0]) * 1e-3
        well = missed <= _MOST_MISSED and late <= _MOST_LATE
        do = ""
        if missed:
            do = "look to the bus and to the time that the drive takes, or lengthen bus.cycle_s"
        elif late:
            do = "set the machine up for real time, or lengthen bus.cycle_s (`canwall latency`)"
        self._findings.add(
            "latency",
            "from SYNC to RPDO",
            f"{p50:.0f} µs, 99 % within {p99:.0f}, at most {largest:.0f}; {missed:.1%} of the "
            f"TPDOs missing, {late:.1%} of the RPDOs after the next SYNC",
            well=well,
            do=do,
        )

    def _first_motion(self, axis: WallAxis, loop: Loop) -> bool:
        """Try the first motion; return True if stopped."""
        findings = self._findings
        if not findings.well:
            findings.add("first motion", "0x6064", "not tried", do="mend the troubles first")
            return False
        self._announce("moving the handle a little, to and fro: keep clear of it")
        motion = FirstMotion(axis)
        if loop.measure([motion]):
            return True
        answer = motion.answers[-1]
        torque = f"{answer.torque_nm:.3g} N·m ({answer.part:.0%} of the rated torque)"
        if answer.shown is not None and answer.shown < _LEAST_SHOWN:
            findings.add(
                "first motion",
                "0x6077",
                f"of {torque} the drive shows {answer.shown:.0%}",
                well=False,
                do="look to power stage, brake and motor phases, and to the current loop in the "
                "vendor's tool",
            )
        if not answer.moved:
            findings.add(
                "first motion",
                "0x6064",
                f"at {torque} the handle moved by less than {answer.least_rad * 1e3:.2g} mrad",
                well=False,
                do="look for a brake, a blocked handle or an encoder that stands still; raise "
                "limits.torque_nm if friction is more",
            )
            return False
        forward = answer.travel_rad > 0.0
        findings.add(
            "first motion",
            "direction",
            f"{torque} turned the handle by {answer.travel_rad * 1e3:+.1f} mrad"
            + ("" if forward else ": against the torque"),
            well=forward,
            do="" if forward else "let motor and encoder turn in one direction, or a wall pulls",
        )
        return False

    def _cause(self, trip: str) -> str:
        """Return what to do about a drive that tripped, by what it says of itself."""
        node = self._node
        if "the master had stood still" in trip:
            return "set the machine up for real time, or lengthen drive.watchdog_s"
        no_tpdo = "no TPDO" in trip
        try:
            if node.has(od.DIGITAL_INPUTS) and node.read(od.DIGITAL_INPUTS) & _INTERLOCK:
                return (
                    "0x60FD bit 3, interlock: release safe torque off or the emergency stop, and "
                    "look to its wiring"
                )
            statusword = node.read(od.STATUSWORD)
            code = re.search(r"EMCY 0x([0-9a-f]{4})", trip)
            digits = code[1] if code is not None else f"{self._error_code():04x}"
            reported = digits != "0000"  # which is the end of an error
            for known, do in _BY_ERROR_CODE.items():
                if digits.startswith(known):
                    return do
            if reported:
                return "the drive's manual has its error codes"
            if no_tpdo:
                return (
                    "look whether SYNC reaches it (0x1005), and what holds back its TPDO (0x1800)"
                )
            if "stays in" not in trip:
                return ""
            if not statusword & _VOLTAGE_ENABLED:
                return "switch the supply of the power stage on (statusword bit 4, 0x6079)"
            if self._follows_sdo():
                return (
                    f"it follows 0x6040 by SDO, not by its RPDO ({self._setup.rpdo.cob_id:#05x}): "
                    f"look for what keeps the RPDO from it, or who else sends it"
                )
        except DriveError:
            if no_tpdo:
                return "it answers no request either: look to its cable and to its supply"
        except can.CanError:
            pass
        return ""

    def _error_code(self) -> int:
        return self._node.read(od.ERROR_CODE) if self._node.has(od.ERROR_CODE) else 0

    def _follows_sdo(self) -> bool:
        """Return True if SHUTDOWN over SDO, which enables nothing, takes the drive a state up."""
        node = self._node
        node.write(od.CONTROLWORD, 0, Controlword.SHUTDOWN)
        followed = state_of(node.read(od.STATUSWORD)) is DriveState.READY_TO_SWITCH_ON
        node.write(od.CONTROLWORD, 0, Controlword.DISABLE_VOLTAGE)
        return followed


class _Stillness:
    """Zero torque for some time, as an experiment on one axis, while bus and drive are watched."""

    def __init__(self, axis: WallAxis, cycles: int) -> None:
        self._axis, self._left = axis, cycles

    def excite(self) -> bool:
        """Set zero torque; return False at the end."""
        self._axis.cycle["test_per_mille"] = 0
        self._left -= 1
        return self._left >= 0

    def note(self) -> None:
        """Keep no row. Raises ExperimentError if the drive is not enabled any more."""
        self._axis.ring.take_rows()
        statusword = int(self._axis.cycle["statusword"][0])
        if state_of(statusword) is not DriveState.OPERATION_ENABLED:
            raise ExperimentError(
                self._axis, f"went to {status_text(statusword)} while its master was alive"
            )

    def conclude(self) -> None:
        """Conclude."""


def _fall_silent(
    axis: WallAxis, loop: Loop, announce: Callable[[str], None], findings: Findings
) -> None:
    """Stop all signs of life, and watch the drive let go."""
    node, watchdog = axis.node, axis.setup.watchdog
    loop.exchange.cycle()
    last_sign_s = _last_sign_of_life_s(axis, loop.exchange)
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
                do="do not run it: nothing stops it if its master dies; look to 0x6007 and 0x1029",
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
