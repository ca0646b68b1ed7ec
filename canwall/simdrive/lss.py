"""LSS slave (CiA 305): node-ID and identity over the bus, without the object dictionary."""

from collections.abc import Callable
from struct import Struct

from canwall.simdrive.dictionary import Dictionary
from canwall.simdrive.frame import Send

CAN_ID = 0x7E5
_RESPONSE_ID = 0x7E4
_NUMBER = Struct("<BL3x")

_SWITCH_GLOBAL = 0x04
_CONFIGURE_NODE_ID = 0x11
_CONFIGURE_BIT_TIMING = 0x13
_STORE = 0x17
_SWITCH_SELECTIVE = range(0x40, 0x44)
_SWITCHED = 0x44
_INQUIRE_IDENTITY = range(0x5A, 0x5E)
_INQUIRE_NODE_ID = 0x5E

_SUCCESS = 0
_REFUSED = 1
_NO_ACCESS = 2


class LssSlave:
    """Answers in CONFIGURATION; in WAITING it heeds the switching of the state only.

    The LSS address is the identity object: vendor-ID, product code, revision and serial number.
    """

    def __init__(self, dictionary: Dictionary, send: Send, store: Callable[[int], None]) -> None:
        """Begin in WAITING.

        Args:
            dictionary: has the identity object (0x1018), and is loaded for the node-ID.
            send: takes the responses.
            store: keeps a node-ID for the next power-on; raises OSError.
        """
        self.node_id = dictionary.node_id
        """Pending node-ID: it holds from the next reset on."""
        self._address = [dictionary.number(0x1018, n, absent=0) for n in range(1, 5)]
        self._send = send
        self._store = store
        self._configuring = False
        self._matched = 0

    def receive(self, data: bytes) -> None:
        """Take a request. LSS frames have eight bytes."""
        if len(data) != 8:
            return
        command, number = _NUMBER.unpack(data)
        if command == _SWITCH_GLOBAL:
            self._configuring = data[1] == 1
            self._matched = 0
        elif command in _SWITCH_SELECTIVE:
            self._switch_selective(command, number)
        elif self._configuring:
            self._configure(command, data[1])

    def _switch_selective(self, command: int, number: int) -> None:
        """Four matching numbers in a row select the device that is waiting."""
        place = command - _SWITCH_SELECTIVE.start
        matches = place == self._matched and number == self._address[place].value
        self._matched = place + 1 if matches else 0
        if self._matched == len(self._address):
            self._matched = 0
            self._configuring = True
            self._answer(_SWITCHED, 0)

    def _configure(self, command: int, argument: int) -> None:
        if command == _CONFIGURE_NODE_ID:
            possible = 1 <= argument <= 127  # 0xFF, no node-ID at all, is not supported
            if possible:
                self.node_id = argument
            self._answer(command, _SUCCESS if possible else _REFUSED)
        elif command == _CONFIGURE_BIT_TIMING:
            self._answer(command, _REFUSED)  # the bit rate is that of the bus it is on
        elif command == _STORE:
            self._answer(command, self._stored())
        elif command in _INQUIRE_IDENTITY:
            self._answer(command, self._address[command - _INQUIRE_IDENTITY.start].value)
        elif command == _INQUIRE_NODE_ID:
            self._answer(command, self.node_id)

    def _stored(self) -> int:
        try:
            self._store(self.node_id)
        except OSError:
            return _NO_ACCESS
        return _SUCCESS

    def _answer(self, command: int, number: int) -> None:
        self._send((_RESPONSE_ID, _NUMBER.pack(command, number)))
