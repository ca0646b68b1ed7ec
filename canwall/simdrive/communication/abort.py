"""SDO abort codes (CiA 301, 7.2.4.3.17, table 22), as the drive uses them."""

from enum import IntEnum


class AbortCode(IntEnum):
    """Reasons for the end of an SDO transfer; every refused write has its own."""

    TOGGLE_BIT = 0x05030000
    TIME_OUT = 0x05040000
    UNKNOWN_COMMAND = 0x05040001
    INVALID_BLOCK_SIZE = 0x05040002
    INVALID_SEQUENCE_NUMBER = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE_PARAMETER = 0x06040043
    HARDWARE = 0x06060000
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    NOT_STORED = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class AccessError(Exception):
    """An access to the object dictionary that is refused with an SDO abort code."""

    def __init__(self, code: AbortCode) -> None:
        """Refuse with the code that goes into the abort frame."""
        super().__init__(f"0x{code:08X} ({code.name})")
        self.code = code
