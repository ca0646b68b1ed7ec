"""The CiA 402 side of the drive: controlword and mode in, statusword, torque and position out."""

from typing import Protocol

from canwall.simdrive.dictionary import Dictionary, Key
from canwall.simdrive.emcy import EmergencyProducer
from canwall.simdrive.state_machine import Command, State, StateMachine

NO_MODE = 0
PROFILE_TORQUE = 4
CYCLIC_SYNCHRONOUS_TORQUE = 10
_TORQUE_MODES = {PROFILE_TORQUE: 1 << 3, CYCLIC_SYNCHRONOUS_TORQUE: 1 << 9}
"""Modes of operation with their bits in 0x6502."""

_HALT = 1 << 8  # controlword

# Statusword; bit 10 is reserved in cyclic synchronous torque mode, bit 12 in profile torque mode.
_VOLTAGE_ENABLED = 1 << 4
_REMOTE = 1 << 9
_TARGET_REACHED = 1 << 10
_INTERNAL_LIMIT_ACTIVE = 1 << 11
_FOLLOWS_TARGET = 1 << 12

# Abort connection option code (0x6007)
_NO_ACTION, _FAULT, _DISABLE_VOLTAGE, _QUICK_STOP = range(4)

_INT32 = 1 << 31
_PER_MILLE_MILLI = 1e6
"""Per mille of a rated torque in mN m, to N m."""


class Motion(Protocol):
    """What motor, encoder and hand present to the drive."""

    def counts(self) -> int:
        """Return the encoder position in increments; the drive shows its low 32 bits."""
        ...

    def speed_counts_per_s(self) -> float:
        """Return the velocity in increments per second."""
        ...

    def advance(self, torque_nm: float, duration_s: float) -> None:
        """Move on by ``duration_s`` under a motor torque that is constant meanwhile."""
        ...


class Axis:
    """State machine, mode of operation, torque path and measured values of the one axis."""

    def __init__(self, dictionary: Dictionary, motion: Motion, emcy: EmergencyProducer) -> None:
        """Serve the 0x6000 objects of the dictionary.

        Raises:
            DictionaryError: one of them is not an integer.
        """
        self._motion = motion
        self._emcy = emcy
        number = dictionary.number
        self._abort_option = number(0x6007, absent=_FAULT)
        self._controlword = number(0x6040, absent=0)
        self._statusword = number(0x6041, absent=0)
        self._mode = number(0x6060, absent=NO_MODE)
        self._mode_display = number(0x6061, absent=NO_MODE)
        self._position = number(0x6064, absent=0)
        self._velocity = number(0x606C, absent=0)
        self._target_torque = number(0x6071, absent=0)
        self._torque_demand = number(0x6074, absent=0)
        self._torque_slope = number(0x6087, absent=_INT32)
        self._max_torque = number(0x6072, absent=_INT32)
        self._rated_torque = number(0x6076, absent=0)
        self._actual_torque = number(0x6077, absent=0)
        self._positive_limit = number(0x60E0, absent=_INT32)
        self._negative_limit = number(0x60E1, absent=_INT32)
        self._follows_target = False
        self._ramps = False
        self._ramp = 0.0
        self._limited = False
        self._reached = False
        self.state_machine = StateMachine(dictionary, self._refresh)
        self._abort_option.allow((_NO_ACTION, _FAULT, _DISABLE_VOLTAGE, _QUICK_STOP))
        modes = _torque_modes(dictionary)
        self._mode.allow((NO_MODE, *modes)).react = lambda _: self._refresh()
        self._controlword.react = self._control

    def reset(self) -> None:
        """Begin in NOT READY TO SWITCH ON, with the objects as they stand."""
        self.state_machine.reset()
        self.sample()

    def disable(self) -> None:
        """Take the torque away at once, whatever the state."""
        self.state_machine.command(Command.DISABLE_VOLTAGE)

    def abort_connection(self, code: int, source: Key) -> None:
        """React to a lost master as 0x6007 says, if the drive function is on.

        Args:
            code: error code, for the fault.
            source: (index, sub-index) of the object that noticed.
        """
        if not self.state_machine.powered:
            return
        option = self._abort_option.value
        if option == _FAULT:
            self._emcy.occurred(code, source)
            self._emcy.latched = True
            self.state_machine.fault()
        elif option == _DISABLE_VOLTAGE:
            self.state_machine.command(Command.DISABLE_VOLTAGE)
        elif option == _QUICK_STOP:
            self.state_machine.command(Command.QUICK_STOP)

    @property
    def torque_nm(self) -> float:
        """Torque demanded of the motor, in N m."""
        torque_nm: float = self._torque_demand.value * self._rated_torque.value / _PER_MILLE_MILLI
        return torque_nm

    def show_torque(self, torque_nm: float) -> None:
        """Let 0x6077 show a torque that is not the one demanded (0x6074)."""
        rated = self._rated_torque.value
        self._actual_torque.value = round(torque_nm * _PER_MILLE_MILLI / rated) if rated else 0

    def apply_torque(self, duration_s: float) -> None:
        """Let the target torque take effect: it is demanded from now on.

        Args:
            duration_s: time that a slope goes on by, in seconds.
        """
        actual = 0
        limited = reached = False
        if self._follows_target or self._ramps:
            wanted = self._target_torque.value
            if self._ramps:
                reached, wanted = self._next_of_ramp(duration_s)
            limit = self._max_torque.value
            highest = min(limit, self._positive_limit.value)
            lowest = -min(limit, self._negative_limit.value)
            actual = max(lowest, min(highest, wanted))
            limited = actual != wanted
        self._actual_torque.value = self._torque_demand.value = actual
        if limited is not self._limited or reached is not self._reached:
            self._limited = limited
            self._reached = reached
            self._show_status()

    def _next_of_ramp(self, duration_s: float) -> tuple[bool, int]:
        """Return whether the torque has come where it was to go, and the torque."""
        end = 0 if self._controlword.value & _HALT else self._target_torque.value
        step = self._torque_slope.value * duration_s
        self._ramp += max(-step, min(step, end - self._ramp))
        return self._ramp == end, round(self._ramp)

    def sample(self) -> None:
        """Latch position and velocity."""
        self._position.value = (self._motion.counts() + _INT32) % (2 * _INT32) - _INT32
        speed = round(self._motion.speed_counts_per_s())
        self._velocity.value = max(-_INT32, min(_INT32 - 1, speed))

    def _control(self, controlword: int) -> None:
        self.state_machine.control(controlword)
        self._refresh()

    def _refresh(self) -> None:
        """Follow a change of state, mode or controlword."""
        self._mode_display.value = self._mode.value
        enabled = self.state_machine.state is State.OPERATION_ENABLED
        mode = self._mode.value
        halted = self._controlword.value & _HALT
        self._follows_target = enabled and mode == CYCLIC_SYNCHRONOUS_TORQUE and not halted
        self._ramps = enabled and mode == PROFILE_TORQUE
        if not self._ramps:
            self._ramp = 0.0
            self._reached = False
            if not self._follows_target:
                self._actual_torque.value = self._torque_demand.value = 0
                self._limited = False
        if self._emcy.latched and not self.state_machine.faulty:
            self._emcy.acknowledge()
        self._show_status()

    def _show_status(self) -> None:
        state = self.state_machine.state
        status: int = state.value
        if state is not State.NOT_READY_TO_SWITCH_ON:
            status |= _VOLTAGE_ENABLED | _REMOTE
        if self._follows_target:
            status |= _FOLLOWS_TARGET
        if self._reached:
            status |= _TARGET_REACHED
        if self._limited:
            status |= _INTERNAL_LIMIT_ACTIVE
        self._statusword.value = status


def _torque_modes(dictionary: Dictionary) -> list[int]:
    """Return the torque modes that the dictionary has.

    They are those of 0x6502. Some vendors leave its value or its torque bits out: then there is
    cyclic synchronous torque, as the target torque is there, and profile torque if the slope is.
    """
    said = dictionary.number(0x6502, absent=0).value
    modes = [mode for mode, bit in _TORQUE_MODES.items() if said & bit]
    if not modes:
        modes = [CYCLIC_SYNCHRONOUS_TORQUE]
        if (0x6087, 0) in dictionary:
            modes.append(PROFILE_TORQUE)
    dictionary.supply(0x6502, 0, sum(_TORQUE_MODES[mode] for mode in modes))
    return modes
