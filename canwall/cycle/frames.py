"""Frames that are sent in every cycle."""

from typing import Any

import can


class CyclicFrame(can.Message):
    """A frame that is sent in every cycle, with other data.

    python-can's virtual bus copies each frame deeply, which by the general way of copy.deepcopy
    takes as long as all the rest of a cycle.
    """

    def __init__(self, can_id: int, length: int) -> None:
        super().__init__(arbitration_id=can_id, is_extended_id=False, data=bytes(length))

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        return can.Message(
            timestamp=self.timestamp,
            arbitration_id=self.arbitration_id,
            is_extended_id=False,
            data=bytes(self.data),
        )
