"""Homing mode (CiA 402-2, clause 11) on the current position: methods 37 and 35.

The present position becomes the home position, and its value the home offset (0x607C), as
IEC 61800-7-201 and KEB's drives have it for method 37; 35 is its older number.
"""

from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.profile.feedback import Feedback

_ON_CURRENT_POSITION = (35, 37)
START = 1 << 4  # controlword

_TARGET_REACHED = 1 << 10
_ATTAINED = 1 << 12
_ERROR = 1 << 13


class Homing:
    """Starts on the edge of bit 4 of the controlword; shows bits 10, 12 and 13 of the statusword.

    Other methods, which a dictionary may begin with, end in a homing error.
    """

    def __init__(self, dictionary: Dictionary, feedback: Feedback) -> None:
        """Serve 0x607C and 0x6098 of the dictionary.

        Raises:
            DictionaryError: one of them is not an integer.
        """
        self._feedback = feedback
        self._offset = dictionary.number(0x607C, absent=0)
        self._method = dictionary.number(0x6098, absent=_ON_CURRENT_POSITION[0])
        self._method.allow((*_ON_CURRENT_POSITION, self._method.default))
        self._started = False
        self.status = _TARGET_REACHED
        """The mode's bits of the statusword: at first, not started."""

    def stop(self) -> None:
        """Reset to not started: the mode or the operation has ended."""
        self._started = False
        self.status = _TARGET_REACHED

    def control(self, controlword: int) -> None:
        """Follow bit 4 while the mode is operating."""
        starting = bool(controlword & START)
        if starting and not self._started:
            if self._method.value in _ON_CURRENT_POSITION:
                self._feedback.home(self._offset.value)
                self.status = _TARGET_REACHED | _ATTAINED
            else:
                self.status = _TARGET_REACHED | _ERROR
        self._started = starting
