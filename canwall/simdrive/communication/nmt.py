"""NMT slave (CiA 301, 7.2.8): the state of the node and the commands that change it."""

from collections.abc import Callable
from enum import IntEnum


class NmtState(IntEnum):
    """States as a heartbeat shows them (CiA 301, 7.2.8.3.2.2); 0 is INITIALISATION."""

    INITIALISATION = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


_STATE_COMMANDS = {
    1: NmtState.OPERATIONAL,
    2: NmtState.STOPPED,
    128: NmtState.PRE_OPERATIONAL,
}
_RESET_NODE = 129
_RESET_COMMUNICATION = 130


class NmtSlave:
    """Obeys the commands for this node and for all; its owner carries them out."""

    def __init__(
        self,
        node_id: int,
        leaving: Callable[[NmtState], None],
        entered: Callable[[], None],
        reset: Callable[[bool], None],
    ) -> None:
        """Begin in INITIALISATION.

        Args:
            node_id: own node-ID.
            leaving: called with the new state before the state changes.
            entered: called after the state has changed.
            reset: called for a reset, with True if it is one of the communication only.
        """
        self.state = NmtState.INITIALISATION
        self._addresses = (0, node_id)
        self._leaving = leaving
        self._entered = entered
        self._reset = reset

    def receive(self, data: bytes) -> None:
        """Take an NMT message; other than commands to this node are ignored."""
        if len(data) != 2 or data[1] not in self._addresses:
            return
        command = data[0]
        if command in _STATE_COMMANDS:
            self.enter(_STATE_COMMANDS[command])
        elif command in (_RESET_NODE, _RESET_COMMUNICATION):
            self._reset(command == _RESET_COMMUNICATION)

    def enter(self, state: NmtState) -> None:
        """Go to a state, unless the node is in it."""
        if state is not self.state:
            self._leaving(state)
            self.state = state
            self._entered()
