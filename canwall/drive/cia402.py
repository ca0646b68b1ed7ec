"""State machine of CiA 402 from the master's side: controlwords by state.

Pure functions of the statusword, for a cycle as well as for a set-up over SDO.
"""

from enum import Enum, IntEnum


class DriveState(Enum):
    """States of the power drive system (CiA 402-2), with mask and value of the statusword."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    def __str__(self) -> str:
        return self.name.replace("_", " ")


class Controlword(IntEnum):
    """Commands of 0x6040."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


#: Statusword bits besides those of the state, with their names in CiA 402-2; 12 and 13 depend on
#: the mode, 8, 14 and 15 on the manufacturer.
_BITS = {
    4: "voltage enabled",
    7: "warning",
    8: "bit 8",
    9: "remote",
    10: "target reached",
    11: "internal limit active",
    12: "bit 12",
    13: "bit 13",
    14: "bit 14",
    15: "bit 15",
}


def state_of(statusword: int) -> DriveState:
    """Return the state in a statusword (0x6041)."""
    for state in DriveState:
        mask, value = state.value
        if statusword & mask == value:
            return state
    return DriveState.NOT_READY_TO_SWITCH_ON  # other values do not occur


def status_text(statusword: int) -> str:
    """Return state and bits of a statusword as text."""
    bits = [name for bit, name in _BITS.items() if statusword >> bit & 1]
    listed = f": {', '.join(bits)}" if bits else ""
    return f"{state_of(statusword)} (statusword {statusword:#06x}{listed})"


_UP = {
    DriveState.NOT_READY_TO_SWITCH_ON: Controlword.DISABLE_VOLTAGE,
    DriveState.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,
    DriveState.SWITCHED_ON: Controlword.ENABLE_OPERATION,
    DriveState.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
    # Transition 16 back to OPERATION ENABLED is optional; the way through SWITCH ON DISABLED is
    # not.
    DriveState.QUICK_STOP_ACTIVE: Controlword.DISABLE_VOLTAGE,
    DriveState.FAULT_REACTION_ACTIVE: Controlword.DISABLE_VOLTAGE,
    DriveState.FAULT: Controlword.FAULT_RESET,
}


def controlword_up(state: DriveState, previous: int) -> int:
    """Return the next controlword on the way to OPERATION ENABLED, from any state.

    A fault reset acts on the rising edge of bit 7, so it alternates with a word without the bit.
    """
    if state is DriveState.FAULT and previous & Controlword.FAULT_RESET:
        return Controlword.DISABLE_VOLTAGE
    return _UP[state]


#: Resets after which a fault that returns is considered permanent.
_RESETS = 3


class Enabling:
    """Sequence of controlwords to OPERATION ENABLED from any state, one per new statusword."""

    def __init__(self) -> None:
        self._controlword: int = Controlword.DISABLE_VOLTAGE
        self._resets = 0
        self._faulty = False

    def next(self, statusword: int) -> int:
        """Return the controlword to send now, in which HALT and all other stale bits are clear."""
        state = state_of(statusword)
        faulty = state is DriveState.FAULT
        if faulty and not self._faulty:
            self._resets += 1
        self._faulty = faulty
        self._controlword = controlword_up(state, self._controlword)
        return self._controlword

    @property
    def gave_up(self) -> bool:
        """True if the fault has returned after _RESETS resets."""
        return self._resets > _RESETS
