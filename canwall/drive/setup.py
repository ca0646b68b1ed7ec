"""From a drive that is found somehow to one that is ready for the cycle: everything over SDO."""

from dataclasses import dataclass

from canwall.config import Drive as DriveSettings
from canwall.drive import objects as od
from canwall.drive.node import DriveError, DriveNode
from canwall.drive.pdo import PdoLayout, configure_rpdo, configure_tpdo
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

_MODE_POLLS = 100


@dataclass(frozen=True)
class DriveSetup:
    """What the cycle needs to know of a drive that is set up."""

    units: DriveUnits
    sync_cob_id: int
    tpdo: PdoLayout
    rpdo: PdoLayout
    #: 0x1019: from 1 to this counts the SYNC that the drive wants; 0: it carries nothing.
    sync_counter_overflow: int = 0


def set_up(node: DriveNode, settings: DriveSettings) -> DriveSetup:
    """Cyclic synchronous torque, zero torque, PDOs on the SYNC; ends in NMT OPERATIONAL.

    Nothing is enabled and nothing is stored in the drive. Raises DriveError, and ConfigError's
    kin ValueError where the configuration has to supply what the drive cannot say.
    """
    node.wait_until_present(settings.wait_s)
    node.command("PRE-OPERATIONAL")
    units = read_units(node, settings)
    _select_torque_mode(node)
    node.write_confirmed(od.TARGET_TORQUE, 0, 0)
    measured = [od.POSITION_ACTUAL_VALUE, od.STATUSWORD]
    if node.has(od.TORQUE_ACTUAL_VALUE):
        measured.append(od.TORQUE_ACTUAL_VALUE)
    tpdo = configure_tpdo(node, 1, measured)
    rpdo = configure_rpdo(node, 1, [od.CONTROLWORD, od.TARGET_TORQUE])
    sync = node.read(od.SYNC_COB_ID) & 0x7FF if node.has(od.SYNC_COB_ID) else 0x80
    overflow = node.read(od.SYNC_COUNTER_OVERFLOW) if node.has(od.SYNC_COUNTER_OVERFLOW) else 0
    node.command("OPERATIONAL")
    return DriveSetup(units, sync, tpdo, rpdo, overflow)


def read_units(node: DriveNode, settings: DriveSettings) -> DriveUnits:
    """Scales from 0x608F, 0x6091 and 0x6076; what `[drive]` gives goes first.

    Raises DriveError that names the key which would settle it.
    """
    gear = settings.gear_ratio
    if gear is None:
        gear = 1.0
        if node.has(od.GEAR_RATIO, 1):
            gear = _quotient(node, od.GEAR_RATIO)
    if settings.counts_per_rev is not None:
        counts = settings.counts_per_rev
    elif node.has(od.POSITION_ENCODER_RESOLUTION, 1):
        counts = _quotient(node, od.POSITION_ENCODER_RESOLUTION)
    else:
        raise DriveError(
            "the drive has no 0x608F: give drive.counts_per_rev (increments per turn of the motor)"
        )
    if settings.rated_torque_nm is not None:
        rated = settings.rated_torque_nm
    elif node.has(od.MOTOR_RATED_TORQUE):
        rated = node.read(od.MOTOR_RATED_TORQUE) / 1000.0
    else:
        raise DriveError("the drive has no 0x6076: give drive.rated_torque_nm")
    try:
        return DriveUnits.behind_gear(counts, rated, gear)
    except ValueError as error:
        raise DriveError(f"node {node.node_id}: {error}; correct it in [drive]") from None


def _quotient(node: DriveNode, index: int) -> float:
    numerator, denominator = node.read(index, 1), node.read(index, 2)
    if numerator <= 0 or denominator <= 0:
        raise DriveError(
            f"node {node.node_id}, 0x{index:04X}: {numerator}/{denominator} is no scale"
        )
    return numerator / denominator


def _select_torque_mode(node: DriveNode) -> None:
    mode = od.CYCLIC_SYNCHRONOUS_TORQUE
    if node.has(od.SUPPORTED_DRIVE_MODES):
        supported = node.read(od.SUPPORTED_DRIVE_MODES)
        if not supported >> (mode - 1) & 1:
            raise DriveError(
                f"node {node.node_id}: 0x6502 = {supported:#x}: no cyclic synchronous torque mode"
            )
    node.write(od.MODES_OF_OPERATION, 0, mode)
    # The display follows when the drive has switched, which may take it a while.
    for _ in range(_MODE_POLLS):
        if node.read(od.MODES_OF_OPERATION_DISPLAY) == mode:
            return
    shown = node.read(od.MODES_OF_OPERATION_DISPLAY)
    raise DriveError(f"node {node.node_id}: 0x6061 shows mode {shown} after mode {mode} was set")
