"""Draft of a configuration from what a drive tells: soft, with every assumption in a comment."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w
from canopen.objectdictionary import ObjectDictionary

from canwall.analysis.felt import HANDLE_RADIUS_M
from canwall.bench.soft_wall import (
    TORQUE_PART,
    WORST_DELAY,
    rounded_down,
    soft_stiffness,
    soft_torque,
)
from canwall.config import Bus as BusSettings
from canwall.config import Drive as DriveSettings
from canwall.drive import REQUIRED_OBJECTS, DriveNode, Link
from canwall.drive import objects as od
from canwall.drive.identity import Identity, identify
from canwall.drive.scales import Scales, angles_per_rev, read_scales
from canwall.eds import load_eds

#: Keys of `[drive]` that are the same for all drives of a kind.
KEYS_OF_A_KIND = (
    "mode",
    "torque_pdo",
    "rated_torque_unit_nm",
    "drive_cycle_s",
    "current_bandwidth_hz",
    "parameters",
    "download_dcf",
)
#: Distance from the handle to the wall, and on both sides to the limits [rad].
_TO_WALL, _TO_LIMITS = 0.1, 1.0
_SPEED_RAD_S = 20.0


@dataclass(frozen=True)
class DriveFacts:
    """Facts that a drive tells of itself.

    Attributes:
        identity: Its identity.
        scales: Its scales.
        position_rad: Position of its shaft [rad].
    """

    identity: Identity
    scales: Scales
    position_rad: float

    @property
    def rated_torque_nm(self) -> float:
        """Rated torque at the shaft [N·m]."""
        return self.scales.units.rated_torque_nm


def read_drive(link: Link, drive: DriveSettings) -> DriveFacts:
    """Read identity, scales and position of a drive; nothing is written to it.

    Raises:
        DictionaryError: If its dictionary cannot be used.
        DriveError: If it does not answer, is no drive, or does not tell a scale.
    """
    dictionary = load_eds(drive.eds, drive.node_id, REQUIRED_OBJECTS)
    node = _PlannedDrive(link, drive, dictionary)
    node.wait_until_present(drive.wait_s)
    identity = identify(node)
    node.refuse_twin()
    # No torque is asked for yet: the rated torque is believed, and is there to be compared.
    scales = read_scales(node, drive, identity, None)
    position = node.read(od.POSITION_ACTUAL_VALUE) * node.rad_per_count(scales)
    return DriveFacts(identity, scales, position)


class _PlannedDrive(DriveNode):
    """A drive whose objects read as they will once `[drive] parameters` are written."""

    def __init__(self, link: Link, drive: DriveSettings, dictionary: ObjectDictionary) -> None:
        super().__init__(link, drive.node_id, dictionary, drive.sdo_timeout_s)
        self._parameters = drive.parameters_by_index

    def read(self, index: int, subindex: int = 0) -> int:
        present = super().read(index, subindex)
        return self._parameters.get((index, subindex), present)

    def rad_per_count(self, scales: Scales) -> float:
        """Return the size of a count at present, which the parameters may change."""
        if (od.SI_UNIT_POSITION, 0) in self._parameters and self.has(od.SI_UNIT_POSITION):
            angles = angles_per_rev(super().read(od.SI_UNIT_POSITION))
            if angles is not None:
                return 2.0 * math.pi / angles[0]
        return scales.units.rad_per_count


def draft(
    bus: BusSettings,
    drive: DriveSettings,
    facts: DriveFacts,
    title: str,
    inertia_kg_m2: float,
    output: Path,
) -> str:
    """Return a configuration as TOML, to be written to `output`.

    Args:
        bus: `[bus]`.
        drive: `[drive]`.
        facts: What the drive tells.
        title: Name of the drive.
        inertia_kg_m2: Inertia of drive and handle.
        output: File of the configuration; the EDS is given relative to its folder if it is in it.
    """
    torque, part = soft_torque(facts.rated_torque_nm), f"{TORQUE_PART:.0%} of the rated torque"
    if facts.scales.torque_limit_nm < torque:
        torque, part = rounded_down(facts.scales.torque_limit_nm, 2), "all that the drive gives"
    stiffness = soft_stiffness(inertia_kg_m2, 0.0, bus.cycle_s)
    # Tenths of a radian: the wall is where the handle was, and easy to move.
    here = round(facts.position_rad, 1)
    low, high = round(here - _TO_LIMITS, 1), round(here + _TO_LIMITS, 1)
    found = "\n".join(f"# - {value} ({whence})" for value, whence in facts.scales.sources)
    return f"""\
# {title}: a soft wall to begin with, written by `canwall init`.
#
# The drive says: {facts.identity}
{found}
# Compare the rated torque with the data sheet: every torque on the bus is in per mille of it.
#
# Next, with this file: `canwall doctor`, then with --move, the handle free; `canwall identify`,
# which replaces what is assumed here; `canwall run`, a hand at the supply's switch.
# `canwall config sim` has every key.

[bus]
interface = {_toml(bus.interface)}
channel = {_toml(bus.channel)}
bitrate = {bus.bitrate:_}
cycle_s = {bus.cycle_s}

[drive]
{_drive_keys(drive, output)}

[mechanics]                    # of drive and handle, without a hand: assumed until identified
inertia_kg_m2 = {inertia_kg_m2}
viscous_nm_s_per_rad = 0.0
coulomb_nm = 0.0

[wall]
law = "mean_force"
{_line("position_rad", round(here - _TO_WALL, 1), f"the handle was at {facts.position_rad:.2f}")}
side = "below"                 # the wall fills positions below (or "above")
# A tenth of K = (b + b_h)/(T/2 + D·T), up to which the plain wall (standard) is stable, at the
# worst delay, D = {WORST_DELAY} periods, in the lightest hand: b = 0, and b_h is that of a
# fingertip, 2 N·s/m at a handle of {HANDLE_RADIUS_M * 1e3:.0f} mm. No law chatters in any hand;
# raise it step by step.
stiffness_nm_per_rad = {stiffness}
damping_ratio = 0.5
cap = 0.8                      # the stiffness in force is at most cap·mass/cycle_s²
tension = "clamp"              # the wall never pulls

[operator]
adapt = true                   # the hand is identified in the cycle

[guard]
action = "warn"                # a wall that buzzes is reported; "act": it is made softer at once

[limits]
{_line("torque_nm", torque, part)}
{_line("speed_rad_s", _SPEED_RAD_S, "beyond: torque zero, drive disabled")}
{_line("position_rad", [low, high], "outside: likewise")}
"""


def _drive_keys(drive: DriveSettings, output: Path) -> str:
    """Return the keys of `[drive]` that are not as they are without being given."""
    given = drive.model_dump(exclude_defaults=True, exclude={"eds", "parameters"})
    eds, folder = drive.eds.resolve(), output.resolve().parent
    shown = eds.relative_to(folder) if eds.is_relative_to(folder) else eds
    keys = {"node_id": given.pop("node_id"), "eds": str(shown)} | given
    comments = {
        "rated_torque_nm": "N·m at the motor's shaft for 1000 in 0x6071",
        "counts_per_rev": "increments of 0x6064 per turn of the motor",
        "rated_torque_unit_nm": "unit of 0x6076",
        "drive_cycle_s": "the drive's own cycle and its current loop: assumed,",
        "current_bandwidth_hz": "`canwall identify` measures them",
    }
    lines = [_line(key, value, comments.get(key, "")) for key, value in keys.items()]
    if drive.parameters:
        lines += ["", "[drive.parameters]             # written at the set-up"]
        for name, value in drive.parameters.items():
            # TOML has no negative hexadecimal numbers.
            lines.append(f'"{name}" = {value:{"#x" if value >= 0 else "d"}}')
    return "\n".join(lines)


def _line(key: str, value: Any, comment: str) -> str:
    line = f"{key} = {_toml(value)}"
    return f"{line:<30} # {comment}" if comment else line


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")
