"""Scales of a drive, one count and one per mille: from the configuration or the drive's objects."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from canwall.config import Drive as DriveSettings
from canwall.config.drive import MILLI_NM
from canwall.drive import objects as od
from canwall.drive.identity import Identity
from canwall.drive.node import DriveError, DriveNode
from canwall.units import DriveUnits

#: Units of 0x60A8 (bits 16 to 23) that are angles, in units per revolution (CiA 303-2).
_ANGLES = {0x10: 2.0 * math.pi, 0x41: 360.0, 0xB4: 1.0}
_ANGLE_NAMES = {0x10: "radian", 0x41: "degree", 0xB4: "revolution"}
#: Increments, and no unit at all, which means the same.
_INCREMENTS = (0xB5, 0x00)

#: Bits of 0x607E: position, and torque with some manufacturers.
_REVERSED = 1 << 7 | 1 << 5

#: Unit of 0x6076 that drives use instead of CiA 402-2's [N·m].
_MICRO_NM = 1e-6
#: maxon: its vendor-ID (0x1018:01), and in 0x3001 nominal current [mA], torque constant [µN·m/A].
_VENDOR, _MAXON = 1, 0xFB
_MAXON_MOTOR, _MAXON_CURRENT, _MAXON_CONSTANT = 0x3001, 1, 5
_SAME = 0.02

#: Plausible `limits.torque_nm`: least in steps of one per mille, most in rated torques.
_LEAST_STEPS, _MOST_RATED = 10.0, 20.0

_GIVE_COUNTS = "give drive.counts_per_rev (increments per turn of the motor)"
_GIVE_GEAR = "give drive.gear_ratio (turns of the motor per turn of the shaft)"
_GIVE_RATED = "give drive.rated_torque_nm"


@dataclass(frozen=True)
class Scales:
    """Units and torque limit of a drive.

    Attributes:
        units: Scales at the shaft.
        torque_limit_nm: Largest torque that the drive gives, at the shaft [N·m].
        sources: Pairs of a value as text and where it comes from.
    """

    units: DriveUnits
    torque_limit_nm: float
    sources: tuple[tuple[str, str], ...]


def read_scales(
    node: DriveNode, settings: DriveSettings, identity: Identity, torque_nm: float | None
) -> Scales:
    """Read the scales from 0x608F, 0x6091, 0x6092, 0x60A8 and 0x6076, unless `[drive]` has them.

    Args:
        node: The drive.
        settings: `[drive]`.
        identity: Identity of the drive.
        torque_nm: `limits.torque_nm`; a rated torque that does not suit it is not believed. None:
            any is.

    Raises:
        DriveError: If a scale cannot be read or believed; names the key to give for each.
    """
    troubles: list[str] = []

    def found(read: Callable[[], tuple[float, str]]) -> tuple[float, str]:
        try:
            return read()
        except DriveError as error:
            troubles.extend(error.troubles)
            return 1.0, ""

    gear, gear_source = found(lambda: _gear_ratio(node, settings))
    counts, counts_source = found(lambda: _counts_per_rev(node, settings, gear))
    at_motor_nm = None if torque_nm is None else torque_nm / gear
    rated, rated_source = found(lambda: _rated_torque(node, settings, identity, at_motor_nm))
    per_mille, limit_source = found(lambda: _torque_limit(node))
    try:
        _check_polarity(node)
        units = DriveUnits(counts, rated * gear)
    except DriveError as error:
        troubles.extend(error.troubles)
    except ValueError as error:
        troubles.append(f"node {node.node_id}: {error}; correct it in [drive]")
    if troubles:
        raise DriveError(*troubles)
    limit_nm = per_mille * units.nm_per_mille
    return Scales(
        units,
        limit_nm,
        (
            (f"{counts:g} counts per turn of the shaft", counts_source),
            (f"{gear:g} turns of the motor per turn of the shaft", gear_source),
            (f"{rated:g} N·m rated torque of the motor", rated_source),
            (
                f"{limit_nm:g} N·m at most" if math.isfinite(limit_nm) else "no torque limit",
                limit_source,
            ),
        ),
    )


def _gear_ratio(node: DriveNode, settings: DriveSettings) -> tuple[float, str]:
    if settings.gear_ratio is not None:
        return settings.gear_ratio, "drive.gear_ratio"
    if node.has(od.GEAR_RATIO, 1):
        return _quotient(node, od.GEAR_RATIO, _GIVE_GEAR), "0x6091"
    return 1.0, "no 0x6091: assumed to have no gear"


def _counts_per_rev(node: DriveNode, settings: DriveSettings, gear: float) -> tuple[float, str]:
    """Return the units of 0x6064 per turn of the shaft (CiA 402-2, factor group), and a source."""
    if settings.counts_per_rev is not None:
        return settings.counts_per_rev * gear, "drive.counts_per_rev"
    if node.has(od.SI_UNIT_POSITION):
        unit = node.read(od.SI_UNIT_POSITION)
        angles = angles_per_rev(unit)
        if angles is not None:
            return angles
        if unit >> 16 & 0xFF not in _INCREMENTS:
            raise DriveError(
                f"node {node.node_id}, 0x60A8 = {unit:#010x}: neither increments nor an angle; "
                f"{_GIVE_COUNTS}"
            )
    # A quotient of one is the default of a drive whose encoder or feed was never set.
    if node.has(od.FEED_CONSTANT, 1):
        feed = _quotient(node, od.FEED_CONSTANT, _GIVE_COUNTS)
        if feed != 1.0:
            return feed, "0x6092: units per turn of the shaft"
    if not node.has(od.POSITION_ENCODER_RESOLUTION, 1):
        raise DriveError(f"the drive has no 0x608F: {_GIVE_COUNTS}")
    counts = _quotient(node, od.POSITION_ENCODER_RESOLUTION, _GIVE_COUNTS)
    if counts == 1.0:
        raise DriveError(f"node {node.node_id}, 0x608F: 1/1 is not an encoder; {_GIVE_COUNTS}")
    return counts * gear, "0x608F" + (" and the gear" if gear != 1.0 else "")


def angles_per_rev(unit: int) -> tuple[float, str] | None:
    """Return the units per turn and their name if 0x60A8 is a unit of angle, otherwise None."""
    code, exponent = unit >> 16 & 0xFF, int.from_bytes([unit >> 24 & 0xFF], signed=True)
    if code not in _ANGLES:
        return None
    name = f"0x60A8 = {unit:#010x}: {10.0**exponent:g} {_ANGLE_NAMES[code]}"
    return _ANGLES[code] / 10.0**exponent, name


def _rated_torque(
    node: DriveNode, settings: DriveSettings, identity: Identity, torque_nm: float | None
) -> tuple[float, str]:
    """Return the rated torque of the motor and its source; torque_nm: limit at the motor."""
    if settings.rated_torque_nm is not None:
        return settings.rated_torque_nm, "drive.rated_torque_nm"
    if not node.has(od.MOTOR_RATED_TORQUE):
        raise DriveError(f"the drive has no 0x6076: {_GIVE_RATED}")
    value = node.read(od.MOTOR_RATED_TORQUE)
    if value == 0:
        raise DriveError(f"node {node.node_id}, 0x6076 = 0: {_GIVE_RATED}")
    if settings.rated_torque_unit_nm is not None:
        unit = settings.rated_torque_unit_nm
        return value * unit, f"0x6076 = {value}, in drive.rated_torque_unit_nm = {unit:g}"
    maxon = _rated_by_maxon(node, identity)
    for unit, name in ((MILLI_NM, "mN·m"), (_MICRO_NM, "µN·m")):
        if maxon and math.isclose(value * unit, maxon, rel_tol=_SAME):
            return value * unit, f"0x6076 = {value}, in {name} by 0x3001:01 and 0x3001:05"
    rated = value / 1000.0
    suits = torque_nm is None or _LEAST_STEPS * rated / 1000.0 <= torque_nm <= _MOST_RATED * rated
    if not suits:
        raise DriveError(
            f"node {node.node_id}, 0x6076 = {value}: in mN·m, one per mille of it would be "
            f"{rated / 1000.0:g} N·m, which does not suit limits.torque_nm (at the motor "
            f"{torque_nm:g} N·m); give drive.rated_torque_unit_nm (1e-6 if 0x6076 is in µN·m, "
            f"1e-3 to confirm mN·m) or drive.rated_torque_nm"
        )
    return rated, "0x6076, in mN·m"


def _rated_by_maxon(node: DriveNode, identity: Identity) -> float | None:
    """Return nominal current times torque constant of a drive of maxon [N·m], None of others."""
    keys = (_MAXON_MOTOR, _MAXON_CURRENT), (_MAXON_MOTOR, _MAXON_CONSTANT)
    if identity.numbers.get(_VENDOR) != _MAXON or not all(node.has(*key) for key in keys):
        return None
    current, constant = (node.read(*key) for key in keys)
    return current * 1e-3 * constant * 1e-6


def _torque_limit(node: DriveNode) -> tuple[float, str]:
    """Return the lowest of 0x6072, 0x6073, 0x60E0 and 0x60E1 in per mille, and which it is.

    0x6073 is in per mille of the rated current, which gives the rated torque.
    """
    indices = (od.MAX_TORQUE, od.MAX_CURRENT, od.POSITIVE_TORQUE_LIMIT, od.NEGATIVE_TORQUE_LIMIT)
    limits = {index: node.read(index) for index in indices if node.has(index)}
    if not limits:
        return math.inf, "the drive has no 0x6072"
    index = min(limits, key=lambda i: limits[i])
    if limits[index] == 0:
        raise DriveError(
            f"node {node.node_id}, 0x{index:04X} = 0: the drive gives no torque; raise it at the "
            f'drive, or for the run by drive.parameters = {{ "0x{index:04X}" = 1000 }}'
        )
    return float(limits[index]), f"0x{index:04X} = {limits[index]}"


def _check_polarity(node: DriveNode) -> None:
    """Raise DriveError if position and torque may have opposite signs, as the wall would pull."""
    if not node.has(od.POLARITY):
        return
    polarity = node.read(od.POLARITY)
    if polarity & _REVERSED:
        raise DriveError(
            f"node {node.node_id}, 0x607E = {polarity:#04x} may reverse the position relative to "
            f"the torque: clear it at the drive, or for the run by drive.parameters = "
            f'{{ "0x607E" = 0 }}, and use wall.side'
        )


def _quotient(node: DriveNode, index: int, do: str) -> float:
    numerator, denominator = node.read(index, 1), node.read(index, 2)
    if numerator <= 0 or denominator <= 0:
        raise DriveError(
            f"node {node.node_id}, 0x{index:04X}: {numerator}/{denominator} is not a scale; {do}"
        )
    return numerator / denominator
