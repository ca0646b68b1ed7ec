"""The data frame that is sent in every cycle, cheap to copy."""

from typing import Any

import can


class DataFrame(can.Message):
    """A data frame with an 11-bit identifier, sent again and again with other data.

    python-can's virtual bus copies each frame deeply for everyone on it; copy.deepcopy takes as
    long for that as all the rest of a cycle.
    """

    def __init__(self, can_id: int, data: bytes) -> None:
        super().__init__(arbitration_id=can_id, is_extended_id=False, data=data)

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        copy = DataFrame(self.arbitration_id, bytes(self.data))
        copy.timestamp = self.timestamp
        return copy
