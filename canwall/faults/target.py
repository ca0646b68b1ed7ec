"""Targets of faults: the parts of a drive and its encoder that faults act on."""

from typing import Protocol, TypeAlias

from canwall.frame import Frame

Source: TypeAlias = tuple[int, int]
"""(index, sub-index) of the object that notices an error."""


class TargetAxis(Protocol):
    """The power drive system (CiA 402)."""

    def fault(self, code: int, source: Source) -> None:
        """Go through the fault reaction into FAULT."""
        ...

    def sto(self, active: bool) -> None:
        """Set the input of safe torque off."""
        ...

    def undervoltage(self, active: bool) -> None:
        """Let the DC link break down, or come back."""
        ...


class TargetErrors(Protocol):
    """The errors that are present, and their EMCY messages."""

    def occurred(self, code: int, source: Source) -> None:
        """Report an error."""
        ...

    def gone(self, code: int, source: Source) -> None:
        """Report the end of an error."""
        ...


class TargetActuator(Protocol):
    """The path of the torque to the motor."""

    def follow(self, part: float) -> None:
        """Let this part of the demanded torque act."""
        ...


class TargetEncoder(Protocol):
    """The position sensor."""

    def jump(self, increments: int) -> None:
        """Read this many increments more from now on."""
        ...

    def stick(self) -> None:
        """Read the present position from now on, and no speed."""
        ...

    def release(self) -> None:
        """Read the motion again."""
        ...


class TargetDrive(Protocol):
    """The device: supply, bus controller, and its parts."""

    @property
    def axis(self) -> TargetAxis:
        """The power drive system."""
        ...

    @property
    def emcy(self) -> TargetErrors:
        """The errors that are present."""
        ...

    @property
    def actuator(self) -> TargetActuator:
        """The path of the torque to the motor."""
        ...

    def switch_off(self) -> None:
        """Take the supply away."""
        ...

    def boot(self) -> list[Frame]:
        """Switch on; return the frames that this sends."""
        ...

    def bus_off(self) -> None:
        """React to a controller that has left the bus."""
        ...

    def bus_recovered(self) -> None:
        """Report that the controller is back on the bus."""
        ...
