"""Set-up of a drive over SDO, from any state to readiness for the cycle."""

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

from canwall.bus.can_ids import SYNC
from canwall.config import Bus as BusSettings
from canwall.config import Drive as DriveSettings
from canwall.drive import objects as od
from canwall.drive.cia402 import Controlword, DriveState, state_of, status_text
from canwall.drive.identity import Identity, identify
from canwall.drive.mode import Mode, select_mode, set_steepest_slope
from canwall.drive.node import DriveError, DriveNode
from canwall.drive.pdo import PdoLayout, configure_rpdo, configure_tpdo, with_constant
from canwall.drive.scales import Scales, read_scales
from canwall.drive.watchdog import NO_WATCHDOG, Watchdog, arm
from canwall.units import DriveUnits

#: Objects without which no drive can render a wall.
REQUIRED_OBJECTS = (
    od.TPDO_COMMUNICATION,
    od.TPDO_MAPPING,
    od.RPDO_COMMUNICATION,
    od.RPDO_MAPPING,
    od.CONTROLWORD,
    od.STATUSWORD,
    od.MODES_OF_OPERATION,
    od.MODES_OF_OPERATION_DISPLAY,
    od.POSITION_ACTUAL_VALUE,
    od.TARGET_TORQUE,
)

_MEASURED = (od.POSITION_ACTUAL_VALUE, od.STATUSWORD)
_MEASURED_TOO = (od.TORQUE_ACTUAL_VALUE, od.VELOCITY_ACTUAL_VALUE)
_COMMANDED = (od.CONTROLWORD, od.TARGET_TORQUE)

_DISABLING_S = 2.0

#: Shortest watchdog in cycles; a shorter one would trip with a master that is alive.
_WATCHDOG_CYCLES = 3
#: Watchdog in simulated time. Master and drive wait for each other, but the drive's timers run on:
#: they must not expire on a busy machine.
_SIMULATED_WATCHDOG_S = 30.0


@dataclass(frozen=True)
class DriveSetup:
    """A drive that is set up, as the cycle uses it.

    Attributes:
        units: Scales at the shaft.
        sync_cob_id: CAN-ID of the SYNC that the drive consumes.
        tpdo: TPDO with position and statusword, and torque and velocity if there is room.
        rpdo: RPDO with controlword and target torque.
        watchdog: Watchdog, and the frames that the cycle has to send for it.
        synchronous: True if a torque acts at the next SYNC, False if on reception.
        torque_limit_nm: Largest torque that the drive gives, at the shaft [N·m].
        mode: Mode of operation and why it was chosen.
        scales: Scales and where they come from.
        identity: Identity of the drive.
        notes: What the drive refused and the cycle does not need.
        sync_counter_overflow: 0x1019: the SYNC counts from 1 to this; 0: it has no counter.
    """

    units: DriveUnits
    sync_cob_id: int
    tpdo: PdoLayout
    rpdo: PdoLayout
    watchdog: Watchdog = NO_WATCHDOG
    synchronous: bool = True
    torque_limit_nm: float = math.inf
    mode: Mode | None = None
    scales: Scales | None = None
    identity: Identity | None = None
    notes: tuple[str, ...] = ()
    sync_counter_overflow: int = 0


def set_up(
    node: DriveNode, settings: DriveSettings, bus: BusSettings, torque_nm: float, real_time: bool
) -> DriveSetup:
    """Set up torque mode, zero torque, PDOs on the SYNC and watchdog; end in NMT OPERATIONAL.

    Nothing is enabled, and nothing is stored in the drive; `node.restore` undoes the changes.

    Args:
        node: The drive.
        settings: `[drive]`.
        bus: `[bus]`.
        torque_nm: `limits.torque_nm`, which the scale of the torque has to suit.
        real_time: Whether SYNCs keep to the clock.

    Raises:
        DriveError: If the drive cannot be set up; names the key for each value that it does not
            provide, and what differs from its object dictionary.
    """
    node.wait_until_present(settings.wait_s)
    boot_ups = node.boot_ups
    node.command("PRE-OPERATIONAL")
    identity = identify(node)
    node.refuse_twin()
    notes: list[str] = []
    troubles: list[str] = []
    scales: Scales | None = None
    prepared: _Prepared | None = None
    try:
        disable(node)
        _write_parameters(node, settings)
        try:
            scales = read_scales(node, settings, identity, torque_nm)
        except DriveError as error:
            # What else has to be settled is said together with it.
            troubles.extend(error.troubles)
        prepared = _prepare(node, settings, bus, real_time, notes)
    except DriveError as error:
        troubles.extend(error.troubles)
    node.refuse_twin()
    if node.boot_ups > boot_ups:
        troubles.append(
            f"node {node.node_id} sent a boot-up message: it restarted during the set-up, or a "
            f"second drive with its node-ID started"
        )
    differences = [*identity.doubts, *_absent(node)]
    if troubles or scales is None or prepared is None:
        raise DriveError(*troubles, *differences)
    node.command("OPERATIONAL")
    return DriveSetup(
        scales.units,
        prepared.sync_cob_id,
        prepared.tpdo,
        prepared.rpdo,
        prepared.watchdog,
        settings.torque_pdo == "sync",
        scales.torque_limit_nm,
        prepared.mode,
        scales,
        identity,
        (*differences, *notes),
        prepared.sync_counter_overflow,
    )


def _absent(node: DriveNode) -> list[str]:
    """Return a line about the objects that the dictionary lists and the drive does not have."""
    if not node.absent:
        return []
    listed = ", ".join(node.absent)
    return [f"{listed} in drive.eds, but not in the drive: file and drive differ; passed over"]


class _Prepared(NamedTuple):
    """Part of a `DriveSetup`: mode, PDOs, SYNC and watchdog."""

    mode: Mode
    tpdo: PdoLayout
    rpdo: PdoLayout
    watchdog: Watchdog
    sync_cob_id: int
    sync_counter_overflow: int


def _prepare(
    node: DriveNode, settings: DriveSettings, bus: BusSettings, real_time: bool, notes: list[str]
) -> _Prepared:
    """Set mode, zero torque, SYNC, PDOs and watchdog. Raises DriveError."""
    mode = select_mode(node, settings.mode)
    if mode.number == od.PROFILE_TORQUE and node.has(od.TORQUE_SLOPE):
        set_steepest_slope(node)
    node.write(od.TARGET_TORQUE, 0, 0)
    node.confirm(od.TARGET_TORQUE, 0, 0)
    _set_interpolation_period(node, bus.cycle_s, notes)
    _configure_sync(node, bus.cycle_s, real_time, notes)
    tpdo = configure_tpdo(node, _MEASURED, _MEASURED_TOO, notes)
    rpdo = configure_rpdo(node, _COMMANDED, settings.torque_pdo == "immediate", notes)
    rpdo = with_constant(node, rpdo, _COMMANDED)
    watchdog = arm(
        node,
        rpdo,
        max(
            settings.watchdog_s if real_time else _SIMULATED_WATCHDOG_S,
            _WATCHDOG_CYCLES * bus.cycle_s,
        ),
        bus.master_id,
        settings.accept_no_watchdog,
    )
    return _Prepared(
        mode,
        tpdo,
        rpdo,
        watchdog,
        node.read(od.SYNC_COB_ID) & 0x7FF if node.has(od.SYNC_COB_ID) else SYNC,
        node.read(od.SYNC_COUNTER_OVERFLOW) if node.has(od.SYNC_COUNTER_OVERFLOW) else 0,
    )


def disable(node: DriveNode) -> None:
    """Disable the drive from any state, and clear all bits of 0x6040 that an earlier master set.

    A fault stays; it is reset when the drive is enabled. Raises DriveError.
    """
    deadline = time.monotonic() + _DISABLING_S
    node.write(od.CONTROLWORD, 0, Controlword.DISABLE_VOLTAGE)
    while True:
        statusword = node.read(od.STATUSWORD)
        if state_of(statusword) in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT):
            return
        if time.monotonic() >= deadline:
            raise DriveError(
                f"node {node.node_id} stays in {status_text(statusword)} after DISABLE VOLTAGE"
            )


def _write_parameters(node: DriveNode, settings: DriveSettings) -> None:
    """Write the values of the DCF, then `[drive] parameters`."""
    if settings.download_dcf:
        _download_dcf(node)
    for (index, subindex), value in settings.parameters_by_index.items():
        try:
            # Written all the same it would be a large number, and the drive might keep it.
            if value < 0 and node.has(index, subindex) and not node.is_signed(index, subindex):
                raise DriveError(f"0x{index:04X}:{subindex:02X}: cannot be negative, as {value} is")
            node.set(index, subindex, value)
        except DriveError as error:
            raise DriveError(f"drive.parameters: {error}") from None


def _download_dcf(node: DriveNode) -> None:
    """Write every ParameterValue of the DCF except those of the PDOs, which are set up here.

    Raises DriveError.
    """
    for variable in node.dcf_objects():
        if variable.index >= od.RPDO_COMMUNICATION and variable.index < 0x1C00:
            continue
        if variable.index in _COMMANDED or "w" not in variable.access_type:
            continue
        if node.has(variable.index, variable.subindex):
            node.change(variable.index, variable.subindex, variable.value)


def _configure_sync(node: DriveNode, cycle_s: float, real_time: bool, notes: list[str]) -> None:
    """Set the period of the SYNC if the drive monitors it (0x1006), and no window (0x1007).

    An RPDO after the synchronous window is dropped silently. Without a window a late torque acts a
    cycle later, is counted, and eventually trips (limits.late_cycles). In simulated time the SYNC
    has no period by the clock.
    """
    wanted = {od.SYNCHRONOUS_WINDOW: 0}
    if node.has(od.COMMUNICATION_CYCLE_PERIOD) and node.read(od.COMMUNICATION_CYCLE_PERIOD):
        wanted[od.COMMUNICATION_CYCLE_PERIOD] = round(cycle_s * 1e6) if real_time else 0
    for index, value in wanted.items():
        if node.has(index) and node.read(index) != value:
            try:
                node.set(index, 0, value)
            except DriveError as error:
                notes.append(f"0x{index:04X} stays as it is: {error}")


def _set_interpolation_period(node: DriveNode, cycle_s: float, notes: list[str]) -> None:
    """Set the interval of new torques (0x60C2), for drives that monitor it or interpolate."""
    if not node.has(od.INTERPOLATION_TIME_PERIOD, 2):
        return
    for exponent in (-3, -4, -5, -6):
        units = cycle_s / 10.0**exponent
        if round(units) <= 0xFF and math.isclose(units, round(units), rel_tol=1e-9):
            break
    else:
        notes.append(f"0x60C2 cannot hold a cycle of {cycle_s:g} s; it stays as it is")
        return
    try:
        node.set(od.INTERPOLATION_TIME_PERIOD, 2, exponent)
        node.set(od.INTERPOLATION_TIME_PERIOD, 1, round(units))
    except DriveError as error:
        notes.append(f"0x60C2 stays as it is: {error}")
