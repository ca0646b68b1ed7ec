"""A CAN frame as identifier and data, and the error frames that a controller makes of events."""

from typing import TypeAlias

Frame: TypeAlias = tuple[int, bytes]
"""A CAN data frame: 11-bit identifier and 0 to 8 bytes."""

ERROR_FRAME = 0x20000000
"""Bit of an identifier that makes a frame an error frame, as in SocketCAN (linux/can/error.h)."""

BUS_OFF: Frame = (ERROR_FRAME | 0x40, bytes(8))
"""A controller has left the bus."""

CRC_ERROR: Frame = (ERROR_FRAME | 0x88, bytes.fromhex("0000000800000000"))
"""Protocol violation on the bus: in the CRC sequence."""
