"""The CiA 402 state machine from the master's side: which controlword leads where.

Pure functions of the statusword, so they serve a cycle as well as a set-up over SDO.
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


#: Statusword bits beside those of the state, with their names in CiA 402-2; 12 and 13 depend on
#: the mode, 8, 14 and 15 on the maker.
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
    """The state that a statusword (0x6041) shows."""
    for state in DriveState:
        mask, value = state.value
        if statusword & mask == value:
            return state
    return DriveState.NOT_READY_TO_SWITCH_ON  # no other is left


def status_text(statusword: int) -> str:
    """DriveState and bits of a statusword, for people."""
    bits = [name for bit, name in _BITS.items() if statusword >> bit & 1]
    said = f": {', '.join(bits)}" if bits else ""
    return f"{state_of(statusword)} (statusword {statusword:#06x}{said})"


_UP = {
    DriveState.NOT_READY_TO_SWITCH_ON: Controlword.DISABLE_VOLTAGE,
    DriveState.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,
    DriveState.SWITCHED_ON: Controlword.ENABLE_OPERATION,
    DriveState.OPERATION_ENABLED: Controlword.ENABLE_OPERATION,
    # Transition 16 back to OPERATION ENABLED is optional; through SWITCH ON DISABLED every drive
    # goes.
    DriveState.QUICK_STOP_ACTIVE: Controlword.DISABLE_VOLTAGE,
    DriveState.FAULT_REACTION_ACTIVE: Controlword.DISABLE_VOLTAGE,
    DriveState.FAULT: Controlword.FAULT_RESET,
}

_DOWN = {
    DriveState.OPERATION_ENABLED: Controlword.SWITCH_ON,  # transition 5, disable operation
    DriveState.SWITCHED_ON: Controlword.SHUTDOWN,
}


def controlword_up(state: DriveState, previous: int) -> int:
    """Next controlword on the way to OPERATION ENABLED, from any state.

    The fault reset acts on the rising edge of bit 7, so it alternates with a word without it.
    """
    if state is DriveState.FAULT and previous & Controlword.FAULT_RESET:
        return Controlword.DISABLE_VOLTAGE
    return _UP[state]


def controlword_down(state: DriveState) -> int:
    """Next controlword on the way to SWITCH ON DISABLED, from any state, step by step."""
    return _DOWN.get(state, Controlword.DISABLE_VOLTAGE)


#: Resets after which a fault that comes back is taken for one that stays.
_RESETS = 3


class Enabling:
    """The way to OPERATION ENABLED from any state, one statusword and controlword at a time.

    Serves a cycle as well as SDO: whoever has a new statusword asks for the next controlword.
    """

    def __init__(self) -> None:
        self._controlword: int = Controlword.DISABLE_VOLTAGE
        self._resets = 0
        self._faulty = False

    def next(self, statusword: int) -> int:
        """Controlword to send now. HALT and every other stale bit are clear in all of them."""
        state = state_of(statusword)
        faulty = state is DriveState.FAULT
        if faulty and not self._faulty:
            self._resets += 1
        self._faulty = faulty
        self._controlword = controlword_up(state, self._controlword)
        return self._controlword

    @property
    def gave_up(self) -> bool:
        """Whether the fault has come back after as many resets as make sense."""
        return self._resets > _RESETS
