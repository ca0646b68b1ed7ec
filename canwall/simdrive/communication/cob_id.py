"""COB-ID entries (CiA 301, 7.5.2.5, 7.5.2.17, 7.5.2.35): which identifiers may stand in one."""

from collections.abc import Container

from canwall.simdrive.communication.abort import AbortCode, AccessError

CAN_ID = 0x7FF
NOT_VALID = 1 << 31
BIT_30 = 1 << 30
EXTENDED = 0x3FFFF800
"""Bit 29 (29-bit identifier) and the identifier bits that only such a frame has."""

# CiA 301, table 41: NMT, the default SDOs, NMT error control and what is reserved.
_RESTRICTED = (
    range(0x000, 0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)


def check_can_id(cob_id: int, taken: Container[int] = ()) -> None:
    """Refuse 29-bit identifiers and, in a valid COB-ID, restricted ones.

    Args:
        cob_id: to be written.
        taken: CAN-IDs of other services of this device, which are restricted as well.

    Raises:
        AccessError: INVALID_VALUE.
    """
    can_id = cob_id & CAN_ID
    restricted = not cob_id & NOT_VALID and any(can_id in ids for ids in (*_RESTRICTED, taken))
    if cob_id & EXTENDED or restricted:
        raise AccessError(AbortCode.INVALID_VALUE)


def check_unchanged_while_valid(present: int, written: int) -> None:
    """Refuse a new identifier (bits 0 to 29) for a COB-ID that is valid and stays valid.

    Raises:
        AccessError: DEVICE_STATE.
    """
    stays_valid = not (present | written) & NOT_VALID
    if stays_valid and (present ^ written) & (EXTENDED | CAN_ID):
        raise AccessError(AbortCode.DEVICE_STATE)
