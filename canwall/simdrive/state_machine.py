"""The power drive state machine of CiA 402-2 (clause 6; IEC 61800-7-201), without the bus."""

from collections.abc import Callable
from enum import Enum

from canwall.simdrive.dictionary import Dictionary, Entry


class State(Enum):
    """The eight states; the value holds bits 0 to 3, 5 and 6 of the statusword."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """What a controlword asks for (CiA 402-2, table of commands); fault reset is an edge."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    ENABLE_OPERATION = 4


FAULT_RESET = 0x80

QUICK_STOP_DISABLE = 0
QUICK_STOP_STAY = 6
_OPTIONS = {
    0x605A: (2, (QUICK_STOP_DISABLE, 2, QUICK_STOP_STAY)),
    0x605B: (0, (0, 1)),
    0x605C: (1, (0, 1)),
    0x605E: (2, (0, 1, 2)),
}
"""Option codes: default of CiA 402 and the values served. A ramp in torque mode is torque zero
at once, so 0x605B and 0x605C come out the same with and without one."""

_TRANSITIONS = {
    State.SWITCH_ON_DISABLED: {
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,  # 2
    },
    State.READY_TO_SWITCH_ON: {
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,  # 7
        Command.QUICK_STOP: State.SWITCH_ON_DISABLED,  # 7
        Command.SWITCH_ON: State.SWITCHED_ON,  # 3
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,  # 3 and 4
    },
    State.SWITCHED_ON: {
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,  # 10
        Command.QUICK_STOP: State.SWITCH_ON_DISABLED,  # 10
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,  # 6
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,  # 4
    },
    State.OPERATION_ENABLED: {
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,  # 9
        Command.QUICK_STOP: State.QUICK_STOP_ACTIVE,  # 11
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,  # 8
        Command.SWITCH_ON: State.SWITCHED_ON,  # 5
    },
    State.QUICK_STOP_ACTIVE: {
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,  # 12
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,  # 16
    },
}


def decode(controlword: int) -> Command | None:
    """Return the command in bits 0 to 3 and 7, None if nothing is to be done."""
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if controlword & FAULT_RESET:
        return None  # the standard wants bit 7 clear; only what stops is obeyed regardless
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0x08 else Command.SWITCH_ON


class StateMachine:
    """Takes controlwords and faults; tells its owner of every change of state."""

    def __init__(self, dictionary: Dictionary, changed: Callable[[], None]) -> None:
        """Args: dictionary: has the option codes; changed: called after each change of state."""
        self.state = State.NOT_READY_TO_SWITCH_ON
        self._changed = changed
        self._last_controlword = 0
        options = {index: _option(dictionary, index) for index in _OPTIONS}
        self._quick_stop_option = options[0x605A]
        self._fault_reaction_option = options[0x605E]

    @property
    def powered(self) -> bool:
        """Whether the drive function is on: a lost connection matters (0x6007)."""
        return self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)

    @property
    def faulty(self) -> bool:
        """Whether the drive is in FAULT, or about to be."""
        return self.state in (State.FAULT_REACTION_ACTIVE, State.FAULT)

    def reset(self) -> None:
        """Transition 0: power-on or reset of the node."""
        self._last_controlword = 0
        self._enter(State.NOT_READY_TO_SWITCH_ON)

    def control(self, controlword: int) -> None:
        """Obey a controlword (0x6040); commands without a transition are ignored."""
        fault_reset = controlword & ~self._last_controlword & FAULT_RESET
        self._last_controlword = controlword
        if self.state is not State.FAULT:
            command = decode(controlword)
            if command is not None:
                self.command(command)
        elif fault_reset:
            self._enter(State.SWITCH_ON_DISABLED)  # 15

    def command(self, command: Command) -> None:
        """Carry out one command, if the present state has a transition for it."""
        target = _TRANSITIONS.get(self.state, {}).get(command)
        option = self._quick_stop_option.value
        if target is State.QUICK_STOP_ACTIVE and option == QUICK_STOP_DISABLE:
            target = State.SWITCH_ON_DISABLED
        elif self.state is State.QUICK_STOP_ACTIVE and command is Command.ENABLE_OPERATION:
            target = target if option == QUICK_STOP_STAY else None
        if target is not None:
            self._enter(target)

    def fault(self) -> None:
        """Transition 13, from every state; with 0x605E = 0 there is no reaction to wait for."""
        if not self.faulty:
            reacting = self._fault_reaction_option.value != 0
            self._enter(State.FAULT_REACTION_ACTIVE if reacting else State.FAULT)

    def step(self) -> None:
        """Take the automatic transition that is due: what the drive had to do is done."""
        if self.state is State.NOT_READY_TO_SWITCH_ON:
            self._enter(State.SWITCH_ON_DISABLED)  # 1
        elif self.state is State.FAULT_REACTION_ACTIVE:
            self._enter(State.FAULT)  # 14
        elif (
            self.state is State.QUICK_STOP_ACTIVE
            and self._quick_stop_option.value != QUICK_STOP_STAY
        ):
            self._enter(State.SWITCH_ON_DISABLED)  # 12

    def _enter(self, state: State) -> None:
        self.state = state
        self._changed()


def _option(dictionary: Dictionary, index: int) -> Entry:
    default, served = _OPTIONS[index]
    return dictionary.number(index, absent=default).allow(served)
