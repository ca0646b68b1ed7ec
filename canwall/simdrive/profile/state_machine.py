"""The power drive state machine of CiA 402-2 (clause 6; IEC 61800-7-201), without the bus."""

from collections.abc import Callable
from enum import Enum

from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile import option_codes
from canwall.simdrive.profile.option_codes import OptionCode, Ramp


class PdsState(Enum):
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
    """Commands of the controlword (CiA 402-2, table of commands); fault reset is an edge."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    ENABLE_OPERATION = 4


FAULT_RESET = 0x80

_TRANSITIONS = {
    PdsState.SWITCH_ON_DISABLED: {
        Command.SHUTDOWN: PdsState.READY_TO_SWITCH_ON,  # 2
    },
    PdsState.READY_TO_SWITCH_ON: {
        Command.DISABLE_VOLTAGE: PdsState.SWITCH_ON_DISABLED,  # 7
        Command.QUICK_STOP: PdsState.SWITCH_ON_DISABLED,  # 7
        Command.SWITCH_ON: PdsState.SWITCHED_ON,  # 3
        Command.ENABLE_OPERATION: PdsState.OPERATION_ENABLED,  # 3 and 4
    },
    PdsState.SWITCHED_ON: {
        Command.DISABLE_VOLTAGE: PdsState.SWITCH_ON_DISABLED,  # 10
        Command.QUICK_STOP: PdsState.SWITCH_ON_DISABLED,  # 10
        Command.SHUTDOWN: PdsState.READY_TO_SWITCH_ON,  # 6
        Command.ENABLE_OPERATION: PdsState.OPERATION_ENABLED,  # 4
    },
    PdsState.OPERATION_ENABLED: {
        Command.DISABLE_VOLTAGE: PdsState.SWITCH_ON_DISABLED,  # 9
        Command.QUICK_STOP: PdsState.QUICK_STOP_ACTIVE,  # 11
        Command.SHUTDOWN: PdsState.READY_TO_SWITCH_ON,  # 8
        Command.SWITCH_ON: PdsState.SWITCHED_ON,  # 5
        Command.ENABLE_OPERATION: PdsState.OPERATION_ENABLED,  # takes a slow-down back
    },
    PdsState.QUICK_STOP_ACTIVE: {
        Command.DISABLE_VOLTAGE: PdsState.SWITCH_ON_DISABLED,  # 12
        Command.ENABLE_OPERATION: PdsState.OPERATION_ENABLED,  # 16
    },
}


def decode(controlword: int) -> Command | None:
    """Return the command in bits 0 to 3 and 7; None: there is none."""
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if controlword & FAULT_RESET:
        return None  # the standard requires bit 7 clear; only stopping commands ignore it
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0x08 else Command.SWITCH_ON


class StateMachine:
    """Takes controlwords and faults; calls its owner after every change.

    A transition that ends the operation waits for the slow-down that its option code asks for
    (``ramp``); its owner carries that out and says when the drive is at rest.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        changed: Callable[[], None],
        at_rest: Callable[[], bool],
    ) -> None:
        """Begin in NOT READY TO SWITCH ON.

        Args:
            dictionary: has the option codes.
            changed: called after each change of the state or of the ramp.
            at_rest: returns True if the slow-down in progress is done.

        Raises:
            DictionaryError: an option code is not an integer, or its value is not served.
        """
        self.state = PdsState.NOT_READY_TO_SWITCH_ON
        self.ramp: Ramp | None = None
        """Way to slow down; None: the drive does not have to."""
        self.voltage = True
        """True if the DC link is up: otherwise transition 3 is not possible."""
        self.fault_present = False
        """True while the cause of a fault persists: transition 15 is not possible."""
        self._changed = changed
        self._at_rest = at_rest
        self._following: PdsState | None = None
        self._last_controlword = 0
        self._quick_stop = OptionCode(dictionary, option_codes.QUICK_STOP)
        self._fault_reaction = OptionCode(dictionary, option_codes.FAULT_REACTION)
        self._leaving = {
            Command.SHUTDOWN: OptionCode(dictionary, option_codes.SHUTDOWN),
            Command.SWITCH_ON: OptionCode(dictionary, option_codes.DISABLE_OPERATION),
        }

    @property
    def powered(self) -> bool:
        """True if the drive function is on, so that a lost connection has an effect (0x6007)."""
        return self.state in (PdsState.OPERATION_ENABLED, PdsState.QUICK_STOP_ACTIVE)

    @property
    def faulty(self) -> bool:
        """True if the drive is in FAULT, or on its way there."""
        return self.state in (PdsState.FAULT_REACTION_ACTIVE, PdsState.FAULT)

    @property
    def stays(self) -> bool:
        """True if the drive stays in QUICK STOP ACTIVE (0x605A = 5 to 7)."""
        return self.state is PdsState.QUICK_STOP_ACTIVE and self._following is None

    def reset(self) -> None:
        """Take transition 0: power-on or reset of the node."""
        self._last_controlword = 0
        self._enter(PdsState.NOT_READY_TO_SWITCH_ON)

    def control(self, controlword: int) -> None:
        """Obey a controlword (0x6040); commands without a transition are ignored."""
        fault_reset = controlword & ~self._last_controlword & FAULT_RESET
        self._last_controlword = controlword
        if self.state is not PdsState.FAULT:
            command = decode(controlword)
            if command is not None:
                self.command(command)
        elif fault_reset and not self.fault_present:
            self._enter(PdsState.SWITCH_ON_DISABLED)  # 15

    def command(self, command: Command) -> None:
        """Carry out one command, if the present state has a transition for it."""
        target = _TRANSITIONS.get(self.state, {}).get(command)
        if target is None:
            return
        if self.state is PdsState.OPERATION_ENABLED:
            self._end_operation(command, target)
        elif self._ready_for(target):
            self._enter(target)

    def _ready_for(self, target: PdsState) -> bool:
        """Return True if a transition that switches something on is possible."""
        if self.state is PdsState.READY_TO_SWITCH_ON and target is not PdsState.SWITCH_ON_DISABLED:
            return self.voltage  # 3
        if self.state is PdsState.QUICK_STOP_ACTIVE and target is PdsState.OPERATION_ENABLED:
            return self._quick_stop.stays and self._at_rest()  # 16
        return True

    def _end_operation(self, command: Command, target: PdsState) -> None:
        if target is PdsState.QUICK_STOP_ACTIVE:
            if self._quick_stop.disables:
                self._enter(PdsState.SWITCH_ON_DISABLED)
            else:
                following = None if self._quick_stop.stays else PdsState.SWITCH_ON_DISABLED
                self._enter(target, self._quick_stop.ramp, following)
        elif command in self._leaving:
            if self._following is not target:
                self._enter(self.state, self._leaving[command].ramp, target)
                if self._following is target and self._at_rest():
                    self._enter(target)
        elif target is not self.state or self._following is not None:
            self._enter(target)

    def fault(self, *, coasting: bool = False) -> None:
        """Take transition 13, and 14 where 0x605E = 0 or there is nothing to brake.

        Args:
            coasting: there is no torque to brake with.
        """
        if self.state is PdsState.FAULT_REACTION_ACTIVE:
            if coasting:
                self._enter(self.state, Ramp.MOTOR_FREE, PdsState.FAULT)
        elif self._fault_reaction.disables:
            self._enter(PdsState.FAULT)
        elif self.state is not PdsState.FAULT:
            braking = self.powered and not coasting
            ramp = self._fault_reaction.ramp if braking else Ramp.MOTOR_FREE
            self._enter(PdsState.FAULT_REACTION_ACTIVE, ramp, PdsState.FAULT)

    def step(self) -> None:
        """Take the automatic transition that is due."""
        if self.state is PdsState.NOT_READY_TO_SWITCH_ON:
            self._enter(PdsState.SWITCH_ON_DISABLED)  # 1
        elif self._following is not None and self._at_rest():
            self._enter(self._following)  # 5, 8, 12, 14

    def _enter(
        self, state: PdsState, ramp: Ramp | None = None, following: PdsState | None = None
    ) -> None:
        self.state = state
        self.ramp = ramp
        self._following = following
        self._changed()
