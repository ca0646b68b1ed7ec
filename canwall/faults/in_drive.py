"""Faults of the drive: its supply, its bus controller, its power stage and its encoder."""

from canwall.faults.kind import INDEX, Amount, FaultKind
from canwall.frame import BUS_OFF, Frame

_SOURCE = (INDEX, 1)
"""Object that EMCY names as the one that noticed."""


class Reboot(FaultKind):
    """The drive loses its supply for the duration (without one: for an instant), then boots.

    It sends its boot-up message and starts from its power-on values.
    """

    name = "reboot"
    number = 7
    direction = "both"
    stops = True
    momentary = True

    def begin(self) -> None:
        self.drive.switch_off()

    def end(self) -> list[Frame]:
        return self.drive.boot()


class Emergency(FaultKind):
    """An error is reported (EMCY, 0x1001, 0x1003), and later its end; nothing else changes."""

    name = "emcy"
    number = 8
    amount = Amount(0x1000, 1, 0xFFFF, "error code", "0x{:04X}")

    @property
    def effect(self) -> object:
        return type(self), self.plan.amount

    def begin(self) -> None:
        self.drive.emcy.occurred(self.plan.amount, _SOURCE)

    def end(self) -> None:
        self.drive.emcy.gone(self.plan.amount, _SOURCE)


class DriveFault(FaultKind):
    """The drive goes through its fault reaction into FAULT with this error code.

    A fault reset ends it.
    """

    name = "fault"
    number = 9
    amount = Amount(0x5000, 1, 0xFFFF, "error code", "0x{:04X}")

    def begin(self) -> None:
        self.drive.axis.fault(self.plan.amount, _SOURCE)


class EncoderJump(FaultKind):
    """The encoder jumps; at the end it jumps back."""

    name = "encoder_jump"
    number = 10
    amount = Amount(1000, -(2**31), 2**31 - 1, "increments")
    independent = True

    def begin(self) -> None:
        self.encoder.jump(self.plan.amount)

    def end(self) -> None:
        self.encoder.jump(-self.plan.amount)


class EncoderStuck(FaultKind):
    """The encoder keeps reading the same position, and no speed."""

    name = "encoder_stuck"
    number = 11

    def begin(self) -> None:
        self.encoder.stick()

    def end(self) -> None:
        self.encoder.release()


class PartialTorque(FaultKind):
    """A part of the demanded torque acts; 0x6077 shows it, 0x6074 the demand."""

    name = "torque"
    number = 12
    amount = Amount(0, -1000, 1000, "per mille of the demand")

    def begin(self) -> None:
        self.drive.actuator.follow(self.plan.amount / 1000.0)

    def end(self) -> None:
        self.drive.actuator.follow(1.0)


class SafeTorqueOff(FaultKind):
    """Safe torque off (0x60FD bit 3)."""

    name = "sto"
    number = 13

    def begin(self) -> None:
        self.drive.axis.sto(True)

    def end(self) -> None:
        self.drive.axis.sto(False)


class Undervoltage(FaultKind):
    """The DC link breaks down (0x6079)."""

    name = "undervoltage"
    number = 14

    def begin(self) -> None:
        self.drive.axis.undervoltage(True)

    def end(self) -> None:
        self.drive.axis.undervoltage(False)


class BusOff(FaultKind):
    """After an error frame the drive neither sends nor receives.

    It reacts by 0x6007 and 0x1029; its watchdogs run on. At the end it sends EMCY 0x8140.
    """

    name = "bus_off"
    number = 15
    direction = "both"
    stops = True

    def begin(self) -> list[Frame]:
        self.drive.bus_off()
        return [BUS_OFF]

    def end(self) -> None:
        self.drive.bus_recovered()
