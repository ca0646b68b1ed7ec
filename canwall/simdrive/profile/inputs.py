"""Digital inputs (0x60FD): limit switches, home switch, interlock."""

from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.state import DriveRecord

NEGATIVE_LIMIT, POSITIVE_LIMIT, HOME, INTERLOCK = (1 << bit for bit in range(4))


class DigitalInputs:
    """The switches that the axis passes, and the input for safe torque off.

    A limit switch stays closed beyond the position where it closes.
    """

    def __init__(self, dictionary: Dictionary, state: DriveRecord, hardware: Hardware) -> None:
        """Serve 0x60FD of the dictionary.

        Raises:
            DictionaryError: it is not an integer.
        """
        self._object = dictionary.number(0x60FD, absent=0)
        self._negative_limit = hardware.negative_limit
        self._positive_limit = hardware.positive_limit
        self._home = hardware.home
        self._interlock = 0
        self.wired = bool(
            hardware.home or (self._negative_limit, self._positive_limit) != (None, None)
        )
        """True if the position closes a switch anywhere."""
        self._state = state.fields
        self._state.inputs = 0

    @property
    def closed(self) -> int:
        """The bits of 0x60FD."""
        closed: int = self._state.inputs
        return closed

    @property
    def at_limit(self) -> bool:
        """True while a limit switch is closed."""
        return bool(self.closed & (NEGATIVE_LIMIT | POSITIVE_LIMIT))

    @property
    def torque_is_off(self) -> bool:
        """True while STO is active."""
        return bool(self._interlock)

    def sto(self, active: bool) -> None:
        """Set the input of safe torque off."""
        self._interlock = INTERLOCK if active else 0
        self._show(self.closed & ~INTERLOCK | self._interlock)

    def sample(self, counts: int) -> bool:
        """Set the switches that an encoder position closes; return True if any has changed."""
        closed = self._interlock
        if self._negative_limit is not None and counts <= self._negative_limit:
            closed |= NEGATIVE_LIMIT
        if self._positive_limit is not None and counts >= self._positive_limit:
            closed |= POSITIVE_LIMIT
        if self._home is not None and self._home[0] <= counts <= self._home[1]:
            closed |= HOME
        changed = closed != self.closed
        self._show(closed)
        return changed

    def _show(self, closed: int) -> None:
        self._state.inputs = self._object.value = closed
