"""The CiA 402 side of the drive: controlword and mode in, statusword, torque and position out."""

from collections.abc import Callable

from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.emcy import (
    DC_LINK_UNDERVOLTAGE,
    EXTERNAL_ERROR,
    EmergencyProducer,
)
from canwall.simdrive.profile import option_codes
from canwall.simdrive.profile.feedback import Feedback, Motion
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.homing import Homing
from canwall.simdrive.profile.inputs import DigitalInputs
from canwall.simdrive.profile.option_codes import OptionCode, Ramp
from canwall.simdrive.profile.slow_down import STANDSTILL_RAD_S, SlowDown
from canwall.simdrive.profile.state_machine import Command, PdsState, StateMachine
from canwall.simdrive.profile.torque import TorquePath
from canwall.simdrive.state import DriveRecord

__all__ = ["Motion", "PowerDriveSystem"]

NO_MODE = 0
PROFILE_TORQUE = 4
HOMING = 6
CYCLIC_SYNCHRONOUS_TORQUE = 10

_HALT = 1 << 8  # controlword

# Statusword; bit 10 is reserved in cyclic synchronous torque mode, bit 12 in profile torque mode.
_VOLTAGE_ENABLED = 1 << 4
_WARNING = 1 << 7
_REMOTE = 1 << 9
_TARGET_REACHED = 1 << 10
_INTERNAL_LIMIT_ACTIVE = 1 << 11
_FOLLOWS_TARGET = 1 << 12

# Abort connection option code (0x6007)
_NO_ACTION, _FAULT, _DISABLE_VOLTAGE, _QUICK_STOP = range(4)

_DIGITAL_INPUTS: Key = (0x60FD, 0)
_DC_LINK_VOLTAGE: Key = (0x6079, 0)
_FASTEST_SLOPE = 1 << 31


class PowerDriveSystem:
    """State machine and mode of operation of the axis, which steer all its parts."""

    def __init__(
        self,
        dictionary: Dictionary,
        state: DriveRecord,
        motion: Motion,
        emcy: EmergencyProducer,
        hardware: Hardware,
        period_s: float,
    ) -> None:
        """Serve the 0x6000 objects of the dictionary.

        Args:
            dictionary: of this drive.
            state: of this drive.
            motion: motor, encoder and hand.
            emcy: reports faults.
            hardware: properties that the dictionary does not have.
            period_s: of the SYNC, in seconds; the drive's own control goes by it.

        Raises:
            DictionaryError: the type or value of one of them is not served.
        """
        self._state = state.fields
        self._emcy = emcy
        self._hardware = hardware
        self._feedback = Feedback(dictionary, state, hardware, motion)
        self._inputs = DigitalInputs(dictionary, state, hardware)
        self._torque = TorquePath(dictionary, state, hardware)
        self._slow_down = SlowDown(dictionary, hardware, self._feedback, period_s)
        self._homing = Homing(dictionary, self._feedback)
        number = dictionary.number
        self._abort_option = number(0x6007, absent=_FAULT)
        self._halt_option = OptionCode(dictionary, option_codes.HALT)
        self._controlword = number(0x6040, absent=0)
        self._statusword = number(0x6041, absent=0)
        self._mode = number(0x6060, absent=NO_MODE)
        self._mode_display = number(0x6061, absent=NO_MODE)
        self._target_torque = number(0x6071, absent=0)
        self._torque_slope = number(0x6087, absent=_FASTEST_SLOPE)
        self._dc_link_voltage = number(0x6079, absent=0)
        self._undervoltage = False
        self._ramp: Ramp | None = None
        self._slope_torque = 0.0
        self._produce: Callable[[float], None] | None = None
        """Demands the torque; None: the motor is free."""
        self._slowing_in = NO_MODE
        self._obeyed: int | None = None
        self._halted = self._follows_target = self._homes = False
        self._profiles = self._slopes = False
        self._reached = False
        self._shown = (False, False, False)
        self.state_machine = StateMachine(dictionary, self._refresh, self._at_rest)
        self._abort_option.allow((_NO_ACTION, _FAULT, _DISABLE_VOLTAGE, _QUICK_STOP))
        # The power-on mode may be one that is not served, and may be gone back to.
        self._mode.allow((NO_MODE, self._mode.default, *_supported_modes(dictionary)))
        self._mode.react = lambda _: self._refresh()
        self._controlword.react = self._control

    def reset(self) -> None:
        """Begin in NOT READY TO SWITCH ON, with the objects as they stand."""
        self._torque.reset()
        self._feedback.reset()
        self._obeyed = None
        self.undervoltage(self._undervoltage)
        self.state_machine.reset()
        self.sample()

    def disable(self) -> None:
        """Disable the voltage, whatever the state."""
        self.state_machine.command(Command.DISABLE_VOLTAGE)

    def abort_connection(self, code: int, source: Key) -> None:
        """React to a lost master as 0x6007 says, if the drive function is on.

        Args:
            code: error code, for the fault.
            source: (index, sub-index) of the object that detected it.
        """
        if not self.state_machine.powered:
            return
        option = self._abort_option.value
        if option == _FAULT:
            self.fault(code, source)
        elif option == _DISABLE_VOLTAGE:
            self.state_machine.command(Command.DISABLE_VOLTAGE)
        elif option == _QUICK_STOP:
            self.state_machine.command(Command.QUICK_STOP)

    def fault(self, code: int, source: Key) -> None:
        """Go through the fault reaction (0x605E) into FAULT, from every state.

        Args:
            code: error code of the EMCY and of 0x603F.
            source: (index, sub-index) of the object that detected it.
        """
        self._latch(code, source)
        self.state_machine.fault()

    def sto(self, active: bool) -> None:
        """Set the input of safe torque off (0x60FD bit 3).

        A powered motor is free immediately and the drive goes into FAULT without a slow-down, as it
        does when it is enabled meanwhile. As with maxon's EPOS4 (STO error), the error comes
        with the power stage, not with the input alone, and no fault reset succeeds before the
        input is released. CiA 301 has no code for it: 0x9000 is its external error.
        """
        self._inputs.sto(active)
        self._check_supplies()

    def undervoltage(self, active: bool) -> None:
        """Let the DC link break down (0x6079, statusword bit 4), or come back.

        EMCY 0x3220. A drive that is switched on goes into FAULT with its motor free, as there is
        no voltage to brake with; otherwise the error goes with its cause.
        """
        self._undervoltage = active
        self._show_dc_link()
        if active:
            self._emcy.occurred(DC_LINK_UNDERVOLTAGE, _DC_LINK_VOLTAGE)
        else:
            self._emcy.gone(DC_LINK_UNDERVOLTAGE, _DC_LINK_VOLTAGE)
        self.state_machine.voltage = not active
        self._check_supplies()

    @property
    def slowing_down(self) -> bool:
        """True while the drive brakes by itself, and has not come to rest."""
        return self._ramp is not None and not self._slow_down.done

    @property
    def steady(self) -> bool:
        """True if it follows the target torque, and no switch is passed on the way."""
        return self._follows_target and not self._inputs.wired and not self._inputs.closed

    @property
    def motor_free(self) -> bool:
        """True if there is no torque, whatever is demanded."""
        return self._produce is None

    @property
    def torque_nm(self) -> float:
        """Torque demanded of the motor, at the shaft, in N m."""
        return self._torque.torque_nm

    def show_torque(self, torque_nm: float) -> None:
        """Let 0x6077 show a torque that is not the one demanded (0x6074)."""
        self._torque.show_actual(torque_nm)

    def apply_torque(self, passed_s: float) -> None:
        """Let the torque that is due take effect: it is demanded from now on.

        Args:
            passed_s: time since the last call, in seconds, for the slope.
        """
        self._torque.pass_time(passed_s)
        if self._produce is not None:
            self._produce(passed_s)
        shown = (self._torque.limited, self._reached, self._torque.overload.warning)
        if shown != self._shown:
            self._shown = shown
            self._show_status()

    def sample(self) -> None:
        """Latch position, velocity and inputs."""
        self._feedback.sample()
        if self._inputs.wired and self._inputs.sample(self._feedback.counts):
            self._show_status()

    def _follow_target(self, passed_s: float) -> None:
        self._torque.give(self._target_torque.value)

    def _follow_slope(self, passed_s: float) -> None:
        """Profile torque: along 0x6087 to the target, or to zero where the drive slows down."""
        end = 0 if self._ramp else self._target_torque.value
        step = self._torque_slope.value * passed_s
        self._slope_torque += max(-step, min(step, end - self._slope_torque))
        self._torque.give(round(self._slope_torque))
        self._reached = self._slope_torque == end and not (
            self._halted and abs(self._feedback.speed_rad_s()) >= STANDSTILL_RAD_S
        )

    def _brake(self, passed_s: float) -> None:
        self._torque.brake(self._slow_down.torque_nm(passed_s, self._torque.largest_nm))
        self._reached = self._slow_down.done

    def _at_rest(self) -> bool:
        """Return True if the slow-down is done: standstill, or no torque left along 0x6087."""
        return self._slope_torque == 0.0 if self._slopes else self._slow_down.done

    def _control(self, controlword: int) -> None:
        machine = self.state_machine
        if (
            controlword == self._obeyed
            and machine.state is PdsState.OPERATION_ENABLED
            and machine.ramp is None
        ):
            return  # obeyed already, as nearly always in the cycle
        self._obeyed = controlword
        machine.control(controlword)
        self._refresh()

    def _refresh(self) -> None:
        """Follow a change of state, mode or controlword."""
        machine = self.state_machine
        enabled = machine.state is PdsState.OPERATION_ENABLED
        if enabled and self._inputs.torque_is_off:
            self._check_supplies()
            return
        mode = self._mode_display.value = self._mode.value
        operating = enabled and machine.ramp is None
        in_torque_mode = mode in (PROFILE_TORQUE, CYCLIC_SYNCHRONOUS_TORQUE)
        self._halted = bool(operating and in_torque_mode and self._controlword.value & _HALT)
        self._slow(self._halt_option.ramp if self._halted else machine.ramp, mode)
        self._follows_target = operating and mode == CYCLIC_SYNCHRONOUS_TORQUE and not self._halted
        self._profiles = operating and mode == PROFILE_TORQUE
        sloped = self._slopes
        self._slopes = mode == PROFILE_TORQUE and (
            self._ramp is Ramp.SLOW_DOWN if self._ramp else self._profiles
        )
        if self._slopes:
            self._produce = self._follow_slope
            self._reached = self._reached and sloped
        else:
            self._slope_torque = 0.0
            self._reached = self._slow_down.done
            self._produce = self._torque_without_slope()
        self._homes = operating and mode == HOMING
        if self._homes:
            self._homing.control(self._controlword.value)
        else:
            self._homing.stop()
        if self._emcy.latched and not machine.faulty:
            self._emcy.acknowledge()
        self._show_status()

    def _torque_without_slope(self) -> Callable[[float], None] | None:
        if self._follows_target:
            return self._follow_target
        braking = self._ramp is not None and self._slow_down.braking
        if not braking or not self._slow_down.begun:
            # Before the controller begins to brake, the master's torque is gone.
            self._torque.off()
        return self._brake if braking else None

    def _slow(self, ramp: Ramp | None, mode: int) -> None:
        """Begin to slow down, or go on, or (None) end it."""
        if ramp is not None and (ramp, mode) != (self._ramp, self._slowing_in):
            self._slow_down.begin(ramp)
        self._ramp = ramp
        self._slowing_in = mode

    def _latch(self, code: int, source: Key) -> None:
        self._emcy.occurred(code, source)
        self._emcy.latched = True

    def _check_supplies(self) -> None:
        """Go into FAULT if a supply that the operation needs is missing."""
        machine = self.state_machine
        machine.fault_present = self._inputs.torque_is_off or self._undervoltage
        powered = machine.powered or machine.state is PdsState.FAULT_REACTION_ACTIVE
        if self._inputs.torque_is_off and powered:
            self._latch(EXTERNAL_ERROR, _DIGITAL_INPUTS)
            machine.fault(coasting=True)
        elif self._undervoltage and (powered or machine.state is PdsState.SWITCHED_ON):
            self._latch(DC_LINK_UNDERVOLTAGE, _DC_LINK_VOLTAGE)
            machine.fault(coasting=True)
        self._show_status()

    def _show_dc_link(self) -> None:
        volts = 0.0 if self._undervoltage else self._hardware.dc_link_v
        self._dc_link_voltage.value = round(1000.0 * volts)

    def _show_status(self) -> None:
        # What changes here may end steady operation: the drive decides anew.
        self._state.steady = False
        machine = self.state_machine
        status: int = machine.state.value
        if machine.state is not PdsState.NOT_READY_TO_SWITCH_ON:
            status |= _REMOTE
            if not self._undervoltage:
                status |= _VOLTAGE_ENABLED
        if self._homes:
            status |= self._homing.status
        elif self._follows_target:
            status |= _FOLLOWS_TARGET
        elif self._reached and (machine.stays or self._profiles):
            status |= _TARGET_REACHED
        if self._torque.limited or self._inputs.at_limit:
            status |= _INTERNAL_LIMIT_ACTIVE
        if self._torque.overload.warning:
            status |= _WARNING
        self._statusword.value = status


def _supported_modes(dictionary: Dictionary) -> list[int]:
    """Return the modes that the dictionary has, of those that are served.

    They are those of 0x6502. Some vendors leave its value or its torque bits out: then they are
    cyclic synchronous torque, profile torque if there is a slope (0x6087), and, without a value,
    homing if there is a method (0x6098).
    """
    said = dictionary.number(0x6502, absent=0).value
    modes = [mode for mode in (PROFILE_TORQUE, CYCLIC_SYNCHRONOUS_TORQUE) if said & _bit(mode)]
    if not modes:
        modes = [CYCLIC_SYNCHRONOUS_TORQUE]
        if (0x6087, 0) in dictionary:
            modes.append(PROFILE_TORQUE)
    if (0x6098, 0) in dictionary and (said & _bit(HOMING) or not said):
        modes.append(HOMING)
    dictionary.supply(0x6502, 0, sum(_bit(mode) for mode in modes))
    return modes


def _bit(mode: int) -> int:
    """Return the bit of a mode of operation in 0x6502."""
    return 1 << mode - 1
