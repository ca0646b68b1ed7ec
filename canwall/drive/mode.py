"""Selection of the torque mode: cyclic synchronous torque, else profile torque."""

import time
from dataclasses import dataclass

from canwall.drive import objects as od
from canwall.drive.node import DriveError, DriveNode

_CANDIDATES = {
    "auto": (od.CYCLIC_SYNCHRONOUS_TORQUE, od.PROFILE_TORQUE),
    "cst": (od.CYCLIC_SYNCHRONOUS_TORQUE,),
    "pt": (od.PROFILE_TORQUE,),
}
_NAMES = {
    od.CYCLIC_SYNCHRONOUS_TORQUE: "cyclic synchronous torque",
    od.PROFILE_TORQUE: "profile torque",
}
_SWITCHING_S = 0.5

#: Values tried for 0x6087, from the greatest down [per mille of the rated torque per second].
_SLOPES = (0xFFFF_FFFF, 0x7FFF_FFFF, 100_000_000, 10_000_000, 1_000_000)


@dataclass(frozen=True)
class Mode:
    """A mode of operation (0x6060) that the drive confirmed (0x6061), and why it was chosen."""

    number: int
    why: str

    @property
    def name(self) -> str:
        """Name of the mode in CiA 402."""
        return _NAMES[self.number]

    def __str__(self) -> str:
        return f"{self.name} ({self.number}): {self.why}"


def select_mode(node: DriveNode, wanted: str) -> Mode:
    """Set the best torque mode that the drive has and confirms (0x6061).

    The modes are those of 0x6502. If it lists no torque mode (some vendors leave the bits out), or
    if the mode is given by name, it is tried.

    Args:
        node: The drive.
        wanted: `[drive] mode`: "auto", "cst" or "pt".

    Raises:
        DriveError: If the drive takes no mode.
    """
    candidates = _CANDIDATES[wanted]
    supported = node.read(od.SUPPORTED_DRIVE_MODES) if node.has(od.SUPPORTED_DRIVE_MODES) else None
    listed = [mode for mode in _NAMES if supported is not None and supported >> (mode - 1) & 1]
    if wanted == "auto" and listed:
        candidates = tuple(mode for mode in candidates if mode in listed)
    reasons = []
    for mode in candidates:
        if mode == od.PROFILE_TORQUE and mode not in listed and not node.has(od.TORQUE_SLOPE):
            reasons.append("profile torque needs 0x6087, which the drive does not have")
            continue
        try:
            enter_mode(node, mode)
        except DriveError as error:
            reasons.append(str(error))
            continue
        return Mode(mode, "; ".join([_evidence(supported, mode, listed, wanted), *reasons]))
    why = "; ".join(reasons)
    if wanted != "auto":
        raise DriveError(f'{why}: drive.mode = "{wanted}" wants no other mode; try "auto"')
    raise DriveError(f"{why}: no torque mode, so this drive cannot render a wall")


def _evidence(supported: int | None, mode: int, listed: list[int], wanted: str) -> str:
    """Return the reason for choosing a mode."""
    if supported is None:
        text = "there is no 0x6502; the drive accepted the mode when it was tried"
    elif mode not in listed:
        lists = "does not list it" if listed else "lists no torque mode"
        text = f"0x6502 = {supported:#x} {lists}, yet the drive accepted it when it was tried"
    elif mode == od.PROFILE_TORQUE and od.CYCLIC_SYNCHRONOUS_TORQUE not in listed:
        text = f"0x6502 = {supported:#x} lists it, and not cyclic synchronous torque"
    else:
        text = f"0x6502 = {supported:#x} lists it"
    return text if wanted == "auto" else f'drive.mode = "{wanted}"; {text}'


def enter_mode(node: DriveNode, mode: int) -> None:
    """Set 0x6060 and wait until 0x6061 shows it. Raises DriveError."""
    node.change(od.MODES_OF_OPERATION, 0, mode)
    # The display follows once the drive has switched, which may take some time.
    deadline = time.monotonic() + _SWITCHING_S
    while True:
        shown = node.read(od.MODES_OF_OPERATION_DISPLAY)
        if shown == mode:
            return
        if time.monotonic() >= deadline:
            raise DriveError(
                f"node {node.node_id}: 0x6061 shows mode {shown} after mode {mode} was set"
            )


def set_steepest_slope(node: DriveNode) -> int:
    """Set 0x6087 to the greatest value that the drive accepts, so that the torque follows at once.

    Returns the value [per mille of the rated torque per second]. Raises DriveError.
    """
    variable = node.dictionary.get_variable(od.TORQUE_SLOPE, 0)
    greatest = None if variable is None else variable.max
    slopes = _SLOPES if greatest is None else (greatest, *(s for s in _SLOPES if s < greatest))
    refusal: DriveError | None = None
    for slope in slopes:
        try:
            node.set(od.TORQUE_SLOPE, 0, slope)
        except DriveError as error:
            refusal = refusal or error
        else:
            return slope
    assert refusal is not None
    raise refusal
