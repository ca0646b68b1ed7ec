"""SYNC consumer (CiA 301, 7.2.5): which CAN-ID the SYNC has."""

from collections.abc import Callable

from canwall.simdrive.abort import AbortCode, AccessError
from canwall.simdrive.cob_id import BIT_30, CAN_ID, check_can_id
from canwall.simdrive.dictionary import Dictionary

_DEFAULT_CAN_ID = 0x080


class SyncConsumer:
    """Serves 0x1005. The drive never produces SYNC, so bit 30 is refused."""

    def __init__(self, dictionary: Dictionary, changed: Callable[[], None]) -> None:
        """Args: dictionary: has the entry; changed: called when the CAN-ID was written."""
        self._cob_id = dictionary.number(0x1005, absent=_DEFAULT_CAN_ID)
        self._cob_id.check = self._check
        self._cob_id.react = lambda _: changed()

    @property
    def can_id(self) -> int:
        """CAN-ID of the SYNC."""
        can_id: int = self._cob_id.value & CAN_ID
        return can_id

    def _check(self, value: int) -> None:
        check_can_id(value)
        if value & BIT_30:
            raise AccessError(AbortCode.INVALID_VALUE)
