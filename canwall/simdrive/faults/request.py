"""The object by which a master asks for a fault over SDO (0x5F00)."""

import math
from collections.abc import Callable

from canwall.faults import INDEX, KINDS, Direction, PlannedFault
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Dictionary

_KIND, _AMOUNT, _CAN_ID, _DIRECTION, _PROBABILITY, _DURATION, _DELAY, _COMMAND, _COUNT = range(
    1, 10
)
_FORMATS = {
    _KIND: "B",
    _AMOUNT: "l",
    _CAN_ID: "H",
    _DIRECTION: "B",
    _PROBABILITY: "H",
    _DURATION: "L",
    _DELAY: "L",
    _COMMAND: "B",
    _COUNT: "H",
}
"""Types of the sub-indices: they tell the record from a vendor's object of the same index."""

_KINDS = {kind.number: kind for kind in KINDS.values()}
_DIRECTIONS: tuple[Direction, ...] = ("sent", "received", "both")
_ANY_CAN_ID = 0xFFFF
_USUAL_AMOUNT = -(2**31)
_END_ALL, _BEGIN = 0, 1


class FaultRequest:
    """Serves 0x5F00: the sub-indices describe a fault, and the command begins it."""

    def __init__(
        self,
        dictionary: Dictionary,
        ask: Callable[[PlannedFault, int], None],
        end_all: Callable[[], None],
    ) -> None:
        """Serve the object, if the dictionary has it.

        Args:
            dictionary: of the drive.
            ask: called with a fault, its begin left open, and the number of SYNCs that it waits.
            end_all: called to end every fault, those that wait included.
        """
        self._ask = ask
        self._end_all = end_all
        self._entries = {}
        if not all(
            (INDEX, sub) in dictionary and dictionary[INDEX, sub].pdo_format == form
            for sub, form in _FORMATS.items()
        ):
            return
        self._entries = {sub: dictionary[INDEX, sub] for sub in _FORMATS}
        self._entries[_KIND].allow((0, *_KINDS)).high = max(_KINDS)
        self._entries[_CAN_ID].allow((*range(0x800), _ANY_CAN_ID))
        self._entries[_DIRECTION].allow(range(len(_DIRECTIONS)))
        self._entries[_PROBABILITY].allow(range(1001))
        self._entries[_COMMAND].check = self._check
        self._entries[_COMMAND].react = self._obey

    def show(self, count: int) -> None:
        """Set 0x5F00:09, the number of faults that are present or waiting."""
        if self._entries:
            self._entries[_COUNT].value = count

    def _check(self, command: int) -> None:
        if command not in (_END_ALL, _BEGIN):
            raise AccessError(AbortCode.INVALID_VALUE)
        if command == _BEGIN:
            self._described()

    def _obey(self, command: int) -> None:
        self._entries[_COMMAND].value = 0
        if command == _BEGIN:
            self._ask(self._described(), self._entries[_DELAY].value)
        else:
            self._end_all()

    def _described(self) -> PlannedFault:
        """Return the fault that the sub-indices describe.

        Raises:
            AccessError: DEVICE_STATE, they describe none.
        """
        value = {sub: entry.value for sub, entry in self._entries.items()}
        kind = _KINDS.get(value[_KIND])
        if kind is None:
            raise AccessError(AbortCode.DEVICE_STATE)
        amount = 0
        if kind.amount:
            amount = kind.amount.usual if value[_AMOUNT] == _USUAL_AMOUNT else value[_AMOUNT]
            if amount not in kind.amount:
                raise AccessError(AbortCode.DEVICE_STATE)
        keys, can_id = kind.own_keys(), value[_CAN_ID]
        return PlannedFault(
            kind=kind,
            periods=value[_DURATION] or (0.0 if kind.momentary else math.inf),
            can_id=can_id if "can_id" in keys and can_id != _ANY_CAN_ID else None,
            direction=_DIRECTIONS[value[_DIRECTION]] if "direction" in keys else kind.direction,
            probability=value[_PROBABILITY] / 1000.0 if "probability" in keys else 1.0,
            amount=amount,
        )
