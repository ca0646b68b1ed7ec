"""From a drive that is found somehow to one that is ready for the cycle: everything over SDO."""

import math
import time
from dataclasses import dataclass

from canwall.bus.can_ids import SYNC
from canwall.config import Bus as BusSettings
from canwall.config import Drive as DriveSettings
from canwall.drive import objects as od
from canwall.drive.cia402 import Controlword, DriveState, state_of, status_text
from canwall.drive.identity import Identity, identify
from canwall.drive.mode import Mode, select_mode, steepest_slope
from canwall.drive.node import DriveError, DriveNode
from canwall.drive.pdo import PdoLayout, configure_rpdo, configure_tpdo, with_constant
from canwall.drive.scales import Scales, read_scales
from canwall.drive.watchdog import NO_WATCHDOG, Watchdog, arm
from canwall.units import DriveUnits

#: Without these objects a drive cannot render a wall, whatever its maker.
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

#: A watchdog shorter than this many cycles would bite a master that lives.
_WATCHDOG_CYCLES = 3
#: In simulated time the master and its drive wait for each other, the drive's timers for nobody: a
#: machine that has other things to do is no dead master.
_SIMULATED_WATCHDOG_S = 30.0


@dataclass(frozen=True)
class DriveSetup:
    """What the cycle needs to know of a drive that is set up.

    units: scales at the shaft. sync_cob_id: CAN-ID of the SYNC that the drive consumes.
    tpdo, rpdo: where statusword, position, torque, controlword and target torque lie in them.
    watchdog: what the cycle has to send beside the RPDOs, and how often.
    sync_counter_overflow: 0x1019: from 1 to this counts the SYNC; 0: it carries nothing.
    synchronous: whether the RPDO's torque waits for the next SYNC.
    torque_limit_nm: what the drive itself holds the torque to, at the shaft [N·m].
    scales, mode, identity: as they were found, for people.
    notes: what the drive would not do and the cycle can live without.
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
    node: DriveNode, settings: DriveSettings, bus: BusSettings, real_time: bool
) -> DriveSetup:
    """Torque mode, zero torque, PDOs on the SYNC, watchdog; ends in NMT OPERATIONAL.

    Nothing is enabled and nothing is stored in the drive; `node.restore` undoes it. Raises
    DriveError, that names the key where the configuration has to supply what the drive cannot say.
    """
    node.wait_until_present(settings.wait_s)
    node.command("PRE-OPERATIONAL")
    identity = identify(node)
    disable(node)
    notes = list(identity.doubts)
    _write_parameters(node, settings)
    scales = read_scales(node, settings)
    mode = select_mode(node, settings.mode)
    if mode.number == od.PROFILE_TORQUE and node.has(od.TORQUE_SLOPE):
        steepest_slope(node)
    node.write(od.TARGET_TORQUE, 0, 0)
    node.confirm(od.TARGET_TORQUE, 0, 0)
    _set_interpolation_period(node, bus.cycle_s, notes)
    _settle_sync(node, bus.cycle_s, real_time, notes)
    immediate = settings.torque_pdo == "immediate"
    tpdo = configure_tpdo(node, _MEASURED, _MEASURED_TOO, notes)
    rpdo = configure_rpdo(node, _COMMANDED, immediate, notes)
    rpdo = with_constant(node, rpdo, _COMMANDED)
    watchdog_s = settings.watchdog_s if real_time else _SIMULATED_WATCHDOG_S
    watchdog = arm(
        node,
        rpdo,
        max(watchdog_s, _WATCHDOG_CYCLES * bus.cycle_s),
        bus.master_id,
        settings.accept_no_watchdog,
    )
    sync = node.read(od.SYNC_COB_ID) & 0x7FF if node.has(od.SYNC_COB_ID) else SYNC
    node.command("OPERATIONAL")
    return DriveSetup(
        scales.units,
        sync,
        tpdo,
        rpdo,
        watchdog,
        not immediate,
        scales.torque_limit_nm,
        mode,
        scales,
        identity,
        tuple(notes),
        node.read(od.SYNC_COUNTER_OVERFLOW) if node.has(od.SYNC_COUNTER_OVERFLOW) else 0,
    )


def disable(node: DriveNode) -> None:
    """Take the torque away, and HALT and whatever else a predecessor has left in 0x6040.

    From any state; a fault stays, its reset belongs to enabling. Raises DriveError.
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
    """What the DCF and `[drive] parameters` want, in this order."""
    if settings.download_dcf:
        _download_dcf(node)
    for (index, subindex), value in settings.written.items():
        node.set(index, subindex, value)


def _download_dcf(node: DriveNode) -> None:
    """Every ParameterValue of the DCF but those of the PDOs, which are set up for the wall.

    Raises DriveError.
    """
    for variable in node.configured():
        if variable.index >= od.RPDO_COMMUNICATION and variable.index < 0x1C00:
            continue
        if variable.index in _COMMANDED or "w" not in variable.access_type:
            continue
        node.change(variable.index, variable.subindex, variable.value)


def _settle_sync(node: DriveNode, cycle_s: float, real_time: bool, notes: list[str]) -> None:
    """What the drive expects of the SYNC: its period where it watches it (0x1006), no window.

    An RPDO after the synchronous window (0x1007) is dropped without a word; without one, a late
    torque acts a cycle later, is counted, and in the end trips (limits.late_cycles). In simulated
    time SYNC has no period by the clock.
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
    """0x60C2: how often a new torque comes, for drives that watch over it or interpolate."""
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
