"""LSS slave (CiA 305): node-ID, bit rate and identity over the bus, without the dictionary."""

from collections.abc import Callable
from operator import eq, ge, le
from struct import Struct

from canwall.bus.can_ids import LSS_RESPONSE
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.communication.frame import Send
from canwall.simdrive.communication.memory import UNCONFIGURED

_NUMBER = Struct("<BL3x")
_FAST_SCAN_REQUEST = Struct("<BLBBB")
_DELAY = Struct("<xH5x")

_SWITCH_GLOBAL = 0x04
_CONFIGURE_NODE_ID = 0x11
_CONFIGURE_BIT_TIMING = 0x13
_ACTIVATE_BIT_TIMING = 0x15
_STORE = 0x17
_SWITCH_SELECTIVE = range(0x40, 0x44)
_SWITCHED = 0x44
_IDENTIFY = range(0x46, 0x4C)
_IDENTIFY_NON_CONFIGURED = 0x4C
_IDENTIFIED = 0x4F
_NON_CONFIGURED = 0x50
_FAST_SCAN = 0x51
_INQUIRE_IDENTITY = range(0x5A, 0x5E)
_INQUIRE_NODE_ID = 0x5E

_IDENTIFYING = ((0, eq), (1, eq), (2, ge), (2, le), (3, ge), (3, le))
"""Number of the LSS address in each request, and its comparison."""

_WAITING, _CONFIGURATION = range(2)
_START_OF_SCAN = 0x80

_SUCCESS = 0
_REFUSED = 1
_NO_ACCESS = 2

_STANDARD_TABLE = 0
_BIT_RATES = {1_000_000: 0, 800_000: 1, 500_000: 2, 250_000: 3, 125_000: 4, 50_000: 6, 20_000: 7,
              10_000: 8}  # fmt: skip
"""Bit/s, and index in the standard table of bit timings (CiA 305; 5 is reserved)."""


class LssSlave:
    """Is configured in CONFIGURATION; in WAITING, found and switched to the other state.

    The LSS address is the identity object: vendor-ID, product code, revision and serial number.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        node_id: int,
        bitrate: int,
        send: Send,
        store: Callable[[int], None],
        start: Callable[[], None],
        fall_silent: Callable[[int], None],
    ) -> None:
        """Serve the identity of the dictionary.

        Args:
            dictionary: has the identity object (0x1018).
            node_id: active node-ID, or UNCONFIGURED.
            bitrate: bit rate of the bus in bit/s, the only one that can be configured.
            send: takes the responses.
            store: keeps a node-ID for the next power-on; raises OSError.
            start: called when a node that had no node-ID has one now.
            fall_silent: called with the milliseconds for which nothing is to be sent, while all
                nodes change their bit timing.
        """
        self._active_node_id = node_id
        self._bit_timing = _BIT_RATES.get(bitrate)
        self._address = [dictionary.number(0x1018, n, absent=0) for n in range(1, 5)]
        self._send = send
        self._store = store
        self._start = start
        self._fall_silent = fall_silent
        self.power_on(node_id)

    def power_on(self, node_id: int) -> None:
        """Begin in WAITING, with a node-ID for the reset that follows."""
        self.node_id = node_id
        """Pending node-ID, which takes effect at the next reset."""
        self._configuring = False
        self._selected = self._identified = self._scanned = 0

    def receive(self, data: bytes) -> None:
        """Take a request. LSS frames have eight bytes."""
        if len(data) != 8:
            return
        command, number = _NUMBER.unpack(data)
        if command == _SWITCH_GLOBAL:
            self._switch(data[1])
        elif command in _IDENTIFY:
            self._identify(command - _IDENTIFY.start, number)
        elif command == _IDENTIFY_NON_CONFIGURED:
            if self._non_configured:
                self._answer(_NON_CONFIGURED)
        elif self._configuring:
            self._configure(command, data)
        elif command in _SWITCH_SELECTIVE:
            self._switch_selective(command - _SWITCH_SELECTIVE.start, number)
        elif command == _FAST_SCAN and self._non_configured:
            self._fast_scan(*_FAST_SCAN_REQUEST.unpack(data)[1:])

    @property
    def _non_configured(self) -> bool:
        return self._active_node_id == UNCONFIGURED == self.node_id

    def _switch(self, state: int) -> None:
        if state not in (_WAITING, _CONFIGURATION):
            return
        left = self._configuring and state == _WAITING
        self._configuring = state == _CONFIGURATION
        self._selected = 0
        if left and self._active_node_id == UNCONFIGURED != self.node_id:
            self._start()

    def _switch_selective(self, place: int, number: int) -> None:
        """Four matching numbers in a row select the device that is waiting."""
        matches = place == self._selected and number == self._address[place].value
        self._selected = place + 1 if matches else 0
        if self._selected == len(_SWITCH_SELECTIVE):
            self._selected = 0
            self._configuring = True
            self._answer(_SWITCHED)

    def _identify(self, place: int, number: int) -> None:
        """Vendor and product, and revision and serial number between two bounds each, in a row."""
        part, fits = _IDENTIFYING[place]
        matches = place == self._identified and fits(self._address[part].value, number)
        self._identified = place + 1 if matches else 0
        if self._identified == len(_IDENTIFY):
            self._identified = 0
            self._answer(_IDENTIFIED)

    def _fast_scan(self, number: int, bit: int, place: int, following: int) -> None:
        """Answer if the upper bits of one number of the address, down to ``bit``, match.

        The device whose four numbers match to the last bit, in their order, is selected.
        """
        if bit == _START_OF_SCAN:
            self._scanned = 0
            self._answer(_IDENTIFIED)
            return
        if bit > 31 or max(place, following) >= len(self._address) or place != self._scanned:
            return
        if (number ^ self._address[place].value) >> bit:
            return
        self._scanned = following
        self._configuring = bit == 0 and following < place
        self._answer(_IDENTIFIED)

    def _configure(self, command: int, data: bytes) -> None:
        if command == _CONFIGURE_NODE_ID:
            possible = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED
            if possible:
                self.node_id = data[1]
            self._answer(command, _SUCCESS if possible else _REFUSED)
        elif command == _CONFIGURE_BIT_TIMING:
            table, index = data[1:3]
            possible = table == _STANDARD_TABLE and index == self._bit_timing
            self._answer(command, _SUCCESS if possible else _REFUSED)
        elif command == _ACTIVATE_BIT_TIMING:
            (delay_ms,) = _DELAY.unpack(data)
            self._fall_silent(2 * delay_ms)  # before the change, and after it
        elif command == _STORE:
            self._answer(command, self._stored())
        elif command in _INQUIRE_IDENTITY:
            self._answer(command, self._address[command - _INQUIRE_IDENTITY.start].value)
        elif command == _INQUIRE_NODE_ID:
            known = self._active_node_id
            self._answer(command, self.node_id if known == UNCONFIGURED else known)

    def _stored(self) -> int:
        try:
            self._store(self.node_id)
        except OSError:
            return _NO_ACCESS
        return _SUCCESS

    def _answer(self, command: int, number: int = 0) -> None:
        self._send((LSS_RESPONSE, _NUMBER.pack(command, number)))
