"""Error behaviour (CiA 301, 7.5.2.32): the NMT state that a lost connection leads to."""

from canwall.simdrive.dictionary import Dictionary
from canwall.simdrive.nmt import NmtSlave, NmtState

_PRE_OPERATIONAL, _NO_CHANGE, _STOPPED = range(3)


class ErrorBehaviour:
    """Serves 0x1029:01. A drive without it goes to PRE-OPERATIONAL, as CiA 301 has it."""

    def __init__(self, dictionary: Dictionary, nmt: NmtSlave) -> None:
        """Args: dictionary: has the entry; nmt: the state that changes."""
        self._nmt = nmt
        self._class = dictionary.number(0x1029, 1, absent=_PRE_OPERATIONAL)
        self._class.allow((_PRE_OPERATIONAL, _NO_CHANGE, _STOPPED))

    def communication_error(self) -> None:
        """React to a heartbeat or life guarding event, or a bus-off."""
        if self._class.value == _STOPPED:
            self._nmt.enter(NmtState.STOPPED)
        elif self._class.value == _PRE_OPERATIONAL and self._nmt.state is NmtState.OPERATIONAL:
            self._nmt.enter(NmtState.PRE_OPERATIONAL)
