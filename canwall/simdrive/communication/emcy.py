"""Emergency producer (CiA 301, 7.2.7): error register, error history and EMCY messages."""

from struct import Struct

from canwall.bus.can_ids import EMCY
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.cob_id import (
    BIT_30,
    CAN_ID,
    NOT_VALID,
    check_can_id,
    check_unchanged_while_valid,
)
from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.frame import Send

DC_LINK_UNDERVOLTAGE = 0x3220
COMMUNICATION = 0x8100
HEARTBEAT_LOST = 0x8130
RECOVERED_FROM_BUS_OFF = 0x8140
PDO_TOO_SHORT = 0x8210
PDO_TOO_LONG = 0x8220
SYNC_LENGTH = 0x8240
RPDO_TIMEOUT = 0x8250
SYNC_LOST = 0x8700
EXTERNAL_ERROR = 0x9000

_NO_ERROR = 0x0000
_GENERIC = 0x01
_REGISTER_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x80}
"""Bit of 0x1001 by the first digit of the error code: current, voltage, temperature, monitoring
(communication), manufacturer's."""

# Error code, error register, and in the manufacturer's bytes the object that detects it.
_MESSAGE = Struct("<HBHBxx")


class EmergencyProducer:
    """Keeps the errors that are present and reports each that comes and goes.

    An error is its code and the (index, sub-index) of the object that detects it. It is reported
    once until it has gone. While ``latched`` (the drive is in FAULT) none goes by itself.
    """

    def __init__(self, dictionary: Dictionary, send: Send) -> None:
        """Serve 0x1001, 0x1003, 0x1014 and 0x603F of the dictionary."""
        self._send = send
        self._register = dictionary.number(0x1001, absent=0)
        self._error_code = dictionary.number(0x603F, absent=0)
        self._count = dictionary.number(0x1003, absent=0)
        self._count.check = self._check_count
        self._count.react = self._clear_history
        self._history = [
            dictionary[0x1003, subindex]
            for subindex in range(1, 255)
            if (0x1003, subindex) in dictionary
        ]
        self._cob_id = dictionary.number(0x1014, absent=EMCY + dictionary.node_id)
        self._cob_id.check = self._check_cob_id
        self.present: dict[tuple[int, Key], None] = {}
        """Errors that have not gone, in the order of their coming."""
        self.latched = False
        self.silent = False
        """True if NMT forbids EMCY (STOPPED); errors are kept nevertheless."""

    def reset(self, *, communication_only: bool) -> None:
        """Start over with an empty history; a fault outlives a reset of the communication."""
        if not (communication_only and self.latched):
            self.present.clear()
            self.latched = False
        self._clear_history(0)
        self._update()

    def occurred(self, code: int, source: Key) -> None:
        """Report an error, unless it is present already."""
        if (code, source) in self.present:
            return
        self.present[code, source] = None
        for newer, older in reversed(list(zip(self._history, self._history[1:], strict=False))):
            older.value = newer.value
        if self._history:
            self._history[0].value = code | source[0] << 16
            self._count.value = min(self._count.value + 1, len(self._history))
        self._update()
        self._report(code, source)

    def gone(self, code: int, source: Key) -> None:
        """Report the end of an error, if it is present and not latched."""
        if not self.latched and (code, source) in self.present:
            del self.present[code, source]
            self._update()
            self._report(_NO_ERROR, source)

    def acknowledge(self) -> None:
        """Drop every error: the fault was reset."""
        self.latched = False
        if self.present:
            self.present.clear()
            self._update()
            self._report(_NO_ERROR, (0, 0))

    def _update(self) -> None:
        register = 0
        for code, _ in self.present:
            register |= _GENERIC | _REGISTER_BITS.get(code >> 12, 0)
        self._register.value = register
        self._error_code.value = next(reversed(self.present), (_NO_ERROR,))[0]

    def _report(self, code: int, source: Key) -> None:
        cob_id = self._cob_id.value
        if not self.silent and not cob_id & NOT_VALID:
            self._send((cob_id & CAN_ID, _MESSAGE.pack(code, self._register.value, *source)))

    def _check_count(self, value: int) -> None:
        if value != 0:
            raise AccessError(AbortCode.INVALID_VALUE)

    def _clear_history(self, _: int) -> None:
        self._count.value = 0
        for entry in self._history:
            entry.value = None

    def _check_cob_id(self, value: int) -> None:
        check_can_id(value)
        if value & BIT_30:
            raise AccessError(AbortCode.INVALID_VALUE)
        check_unchanged_while_valid(self._cob_id.value, value)
