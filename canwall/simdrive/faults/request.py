"""The record by which a master asks for a fault over SDO (0x5F00)."""

import math
from collections.abc import Callable

from canwall.config import AMOUNTS, NUMBERS, ON_FRAMES, Direction
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Dictionary
from canwall.simdrive.faults.plan import PlannedFault

INDEX = 0x5F00
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
"""What the record is told by, in whosever dictionary its index is in use."""

_KINDS = {number: kind for kind, number in NUMBERS.items()}
_DIRECTIONS: tuple[Direction, ...] = ("sent", "received", "both")
_ANY_CAN_ID = 0xFFFF
_USUAL_AMOUNT = -(2**31)
_END_ALL, _BEGIN = 0, 1


class FaultRequest:
    """Serves 0x5F00: a fault is described in its sub-indices and begun by the command."""

    def __init__(
        self,
        dictionary: Dictionary,
        ask: Callable[[PlannedFault, int], None],
        end_all: Callable[[], None],
    ) -> None:
        """Serve the object, if the dictionary has it.

        Args:
            dictionary: has the entries.
            ask: called with a fault whose begin is left open, and the SYNCs that it waits for.
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
        self._entries[_KIND].allow((0, *_KINDS))
        self._entries[_CAN_ID].allow((*range(0x800), _ANY_CAN_ID))
        self._entries[_DIRECTION].allow(range(len(_DIRECTIONS)))
        self._entries[_PROBABILITY].allow(range(1001))
        self._entries[_COMMAND].check = self._check
        self._entries[_COMMAND].react = self._obey

    def show(self, count: int) -> None:
        """Let 0x5F00:09 show how many faults are present or waiting."""
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
        """Return the fault as the sub-indices have it.

        Raises:
            AccessError: DEVICE_STATE, they do not describe one.
        """
        value = {sub: entry.value for sub, entry in self._entries.items()}
        kind = _KINDS.get(value[_KIND])
        if kind is None:
            raise AccessError(AbortCode.DEVICE_STATE)
        amount = 0
        if kind in AMOUNTS:
            limits = AMOUNTS[kind]
            amount = limits.usual if value[_AMOUNT] == _USUAL_AMOUNT else value[_AMOUNT]
            if not limits.lowest <= amount <= limits.highest:
                raise AccessError(AbortCode.DEVICE_STATE)
        on_frames = kind in ON_FRAMES
        with_id = on_frames or kind == "babbling"
        can_id = value[_CAN_ID]
        return PlannedFault(
            kind=kind,
            periods=value[_DURATION] or (0.0 if kind == "reboot" else math.inf),
            can_id=can_id if with_id and can_id != _ANY_CAN_ID else None,
            direction=_DIRECTIONS[value[_DIRECTION]] if on_frames else "sent",
            probability=value[_PROBABILITY] / 1000.0 if on_frames else 1.0,
            amount=amount,
        )
