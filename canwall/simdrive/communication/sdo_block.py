"""SDO block transfer (CiA 301, 7.2.4.2.10 to 7.2.4.2.14): state of one transfer."""

from binascii import crc_hqx
from struct import Struct

from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Entry

BLOCK_SIZE = 127
"""Segments of a block, as many as the protocol allows."""

_SEGMENT_SIZE = 7
_LAST_SEGMENT = 0x80
_SEQUENCE_NUMBER = 0x7F

_DOWNLOAD_BLOCK_RESPONSE = 0xA2
_DOWNLOAD_END_RESPONSE = 0xA1
_UPLOAD_END = 0xC1

_ACKNOWLEDGE = Struct("<BBB5x")
_END = Struct("<BH5x")


class BlockDownload:
    """Blocks on their way from the client."""

    def __init__(self, entry: Entry, size: int | None, with_crc: bool, max_size: int) -> None:
        """Await the first segment.

        Args:
            entry: what is written in the end.
            size: bytes announced, None if unknown.
            with_crc: whether the client sends a checksum.
            max_size: bytes for which there is memory.
        """
        self.entry = entry
        self.in_block = True
        """True if the next frame is a segment."""
        self._size = size
        self._with_crc = with_crc
        self._max_size = max_size
        self._data = bytearray()
        self._acknowledged = 0

    def segment(self, data: bytes) -> list[bytes]:
        """Take a segment; return the response that the last one of a block gets.

        Segments after a missing one are discarded; the client sends them again.

        Raises:
            AccessError: INVALID_SEQUENCE_NUMBER, OUT_OF_MEMORY.
        """
        sequence_number = data[0] & _SEQUENCE_NUMBER
        if not sequence_number:
            raise AccessError(AbortCode.INVALID_SEQUENCE_NUMBER)
        last = data[0] & _LAST_SEGMENT
        if sequence_number == self._acknowledged + 1:
            self._acknowledged = sequence_number
            self._data += data[1:]
            if len(self._data) >= self._max_size + _SEGMENT_SIZE:
                raise AccessError(AbortCode.OUT_OF_MEMORY)
            self.in_block = not last
        if not last and sequence_number < BLOCK_SIZE:
            return []
        acknowledged, self._acknowledged = self._acknowledged, 0
        return [_ACKNOWLEDGE.pack(_DOWNLOAD_BLOCK_RESPONSE, acknowledged, BLOCK_SIZE)]

    def end(self, data: bytes) -> list[bytes]:
        """Write what was received.

        Raises:
            AccessError: CRC, TOO_LONG, TOO_SHORT, OUT_OF_MEMORY, or what the entry refuses.
        """
        head, crc = _END.unpack(data)
        del self._data[len(self._data) - (head >> 2 & 7) :]
        if len(self._data) > self._max_size:
            raise AccessError(AbortCode.OUT_OF_MEMORY)
        if self._size is not None and len(self._data) != self._size:
            longer = len(self._data) > self._size
            raise AccessError(AbortCode.TOO_LONG if longer else AbortCode.TOO_SHORT)
        if self._with_crc and crc_hqx(self._data, 0) != crc:
            raise AccessError(AbortCode.CRC)
        self.entry.download(bytes(self._data))
        return [bytes([_DOWNLOAD_END_RESPONSE]).ljust(8, b"\0")]


class BlockUpload:
    """Blocks on their way to the client."""

    def __init__(self, entry: Entry, value: bytes, block_size: int) -> None:
        """Await the start.

        Args:
            entry: what is read.
            value: of it.
            block_size: segments that the client takes in a block.

        Raises:
            AccessError: INVALID_BLOCK_SIZE.
        """
        self.entry = entry
        self._value = value
        self._block_size = _checked(block_size)
        self._begin = 0
        self._in_flight = 0

    def block(self) -> list[bytes]:
        """Return the segments of the next block, from the first that is not acknowledged on."""
        end = min(self._begin + self._block_size * _SEGMENT_SIZE, len(self._value))
        pieces = [
            self._value[at : min(at + _SEGMENT_SIZE, end)]
            for at in range(self._begin, end, _SEGMENT_SIZE)
        ] or [b""]
        self._in_flight = len(pieces)
        segments = [bytes([n]) + piece.ljust(7, b"\0") for n, piece in enumerate(pieces, start=1)]
        if end == len(self._value):
            segments[-1] = bytes([_LAST_SEGMENT | segments[-1][0]]) + segments[-1][1:]
        return segments

    def acknowledge(self, data: bytes) -> list[bytes]:
        """Take the client's response to a block; return the next one, or the end.

        Raises:
            AccessError: INVALID_SEQUENCE_NUMBER, INVALID_BLOCK_SIZE.
        """
        _, acknowledged, block_size = _ACKNOWLEDGE.unpack(data)
        if acknowledged > self._in_flight:
            raise AccessError(AbortCode.INVALID_SEQUENCE_NUMBER)
        self._begin += acknowledged * _SEGMENT_SIZE
        if acknowledged and self._begin >= len(self._value):
            unused = self._begin - len(self._value)
            self._in_flight = 0
            return [_END.pack(_UPLOAD_END | unused << 2, crc_hqx(self._value, 0))]
        self._block_size = _checked(block_size)
        return self.block()


def _checked(block_size: int) -> int:
    if not 1 <= block_size <= BLOCK_SIZE:
        raise AccessError(AbortCode.INVALID_BLOCK_SIZE)
    return block_size
