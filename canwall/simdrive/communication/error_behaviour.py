"""Error behaviour (CiA 301, 7.5.2.32): the NMT state that a lost connection leads to."""

from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.nmt import NmtSlave, NmtState

_REACTIONS = range(3)
ERROR_BEHAVIOUR: Key = (0x1029, 1)

_PRE_OPERATIONAL, _NO_CHANGE, _STOPPED = _REACTIONS


class ErrorBehaviour:
    """Serves 0x1029. A drive without it goes to PRE-OPERATIONAL, as CiA 301 has it.

    Sub-index 1 is for errors of the communication. The others are for those of the device.
    """

    def __init__(self, dictionary: Dictionary, nmt: NmtSlave) -> None:
        """Serve the entries of the dictionary; errors change the state of ``nmt``."""
        self._nmt = nmt
        self._class = dictionary.number(*ERROR_BEHAVIOUR, absent=_PRE_OPERATIONAL)
        for subindex in range(1, 255):
            if (0x1029, subindex) in dictionary:
                dictionary.number(0x1029, subindex, absent=_NO_CHANGE).allow(_REACTIONS)

    def communication_error(self) -> None:
        """React to a heartbeat or life guarding event, or a bus-off."""
        if self._class.value == _STOPPED:
            self._nmt.enter(NmtState.STOPPED)
        elif self._class.value == _PRE_OPERATIONAL and self._nmt.state is NmtState.OPERATIONAL:
            self._nmt.enter(NmtState.PRE_OPERATIONAL)
