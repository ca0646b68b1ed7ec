"""SDO server (CiA 301, 7.2.4): expedited, segmented and block transfer."""

from collections.abc import Callable
from dataclasses import dataclass, field
from struct import Struct
from typing import TypeAlias

from canwall.bus.can_ids import SDO_REQUEST, SDO_RESPONSE
from canwall.simdrive.communication.abort import AbortCode, AccessError
from canwall.simdrive.communication.dictionary import Dictionary, Entry, Key
from canwall.simdrive.communication.frame import NS_PER_MS, Clock, Send
from canwall.simdrive.communication.sdo_block import BLOCK_SIZE, BlockDownload, BlockUpload

_INITIATE = Struct("<BHB4s")
_ABORT = Struct("<BHBL")
_FRAME_SIZE = 8
_SEGMENT_SIZE = 7
_EXPEDITED_SIZE = 4
_MAX_SIZE = 1 << 16
"""Largest size of a string or domain [bytes], given by the memory of the device."""
_TIME_OUT_NS = 1000 * NS_PER_MS
"""Time that a transfer waits for the client's next frame."""

# Client and server command specifiers, in bits 5 to 7 of the first byte.
(
    _DOWNLOAD_SEGMENT,
    _DOWNLOAD,
    _UPLOAD,
    _UPLOAD_SEGMENT,
    _CLIENT_ABORT,
    _BLOCK_UPLOAD,
    _BLOCK_DOWNLOAD,
) = range(7)
_DOWNLOAD_RESPONSE = 0x60
_UPLOAD_RESPONSE = 0x40
_DOWNLOAD_SEGMENT_RESPONSE = 0x20
_UPLOAD_SEGMENT_RESPONSE = 0x00
_ABORT_RESPONSE = 0x80
_CLIENT_ABORT_HEAD = 0x80
"""A block's segment may begin with any other number."""
_BLOCK_DOWNLOAD_RESPONSE = 0xA0
_BLOCK_UPLOAD_RESPONSE = 0xC0

# Client subcommands of the block transfer, in bits 0 and 1 (download: bit 0).
_BLOCK_INITIATE, _BLOCK_END, _BLOCK_ACKNOWLEDGE, _BLOCK_START = range(4)
_BLOCK_SIZE_INDICATED = 0x02
_CRC = 0x04

_EXPEDITED = 0x02
_SIZE_INDICATED = 0x01
_TOGGLE = 0x10
_LAST_SEGMENT = 0x01


@dataclass(slots=True)
class _Upload:
    """Segments on their way to the client."""

    entry: Entry
    value: bytes
    sent: int = 0
    toggle: int = 0


@dataclass(slots=True)
class _Download:
    """Segments on their way from the client; ``size`` is None if it was not indicated."""

    entry: Entry
    size: int | None
    data: bytearray = field(default_factory=bytearray)
    toggle: int = 0


_Transfer: TypeAlias = _Upload | _Download | BlockUpload | BlockDownload


class SdoServer:
    """Answers the default SDO; one transfer at a time, a new one replaces the old."""

    def __init__(self, dictionary: Dictionary, clock: Clock, send: Send) -> None:
        """Serve the default SDO.

        Args:
            dictionary: the objects to read and write.
            clock: protocol time.
            send: takes the responses.
        """
        self.can_id = SDO_REQUEST + dictionary.node_id
        """CAN-ID of the requests."""
        self._response_id = SDO_RESPONSE + dictionary.node_id
        self._dictionary = dictionary
        self._clock = clock
        self._send = send
        self._transfer: _Transfer | None = None
        self._deadline_ns = 0
        self._services: dict[int, Callable[[bytes], list[bytes]]] = {
            _DOWNLOAD: self._initiate_download,
            _DOWNLOAD_SEGMENT: self._download_segment,
            _UPLOAD: self._initiate_upload,
            _UPLOAD_SEGMENT: self._upload_segment,
            _BLOCK_DOWNLOAD: self._block_download,
            _BLOCK_UPLOAD: self._block_upload,
        }

    def reset(self) -> None:
        """Drop the transfer in progress."""
        self._transfer = None

    def receive(self, data: bytes) -> None:
        """Take a request and send the responses to it. SDO frames have eight bytes."""
        if len(data) != _FRAME_SIZE:
            return
        command = data[0] >> 5
        transfer = self._transfer
        in_block = isinstance(transfer, BlockDownload) and transfer.in_block
        if data[0] == _CLIENT_ABORT_HEAD or (command == _CLIENT_ABORT and not in_block):
            self._transfer = None
            return
        key = self._key(command, data, in_block)
        self._deadline_ns = self._clock.now_ns + _TIME_OUT_NS
        service = self._services.get(command, _unknown_command)
        if isinstance(transfer, BlockDownload) and in_block:
            service = transfer.segment
        try:
            responses = service(data)
        except AccessError as abort:
            self._abort(key, abort.code)
            return
        for response in responses:
            self._send((self._response_id, response))

    def tick(self) -> None:
        """Abort a transfer whose client has been silent for too long."""
        if self._transfer is not None and self._clock.now_ns >= self._deadline_ns:
            self._abort(self._transfer.entry.key, AbortCode.TIME_OUT)

    def _abort(self, key: Key, code: AbortCode) -> None:
        self._transfer = None
        self._send((self._response_id, _ABORT.pack(_ABORT_RESPONSE, *key, code)))

    def _key(self, command: int, data: bytes, in_block: bool) -> Key:
        """Return index and sub-index for an abort; only initiating requests carry their own."""
        initiates = command in (_DOWNLOAD, _UPLOAD) or (
            command in (_BLOCK_DOWNLOAD, _BLOCK_UPLOAD) and _subcommand(data) == _BLOCK_INITIATE
        )
        if not in_block and initiates:
            _, index, subindex, _ = _INITIATE.unpack(data)
            return index, subindex
        return self._transfer.entry.key if self._transfer else (0, 0)

    def _initiate_upload(self, data: bytes) -> list[bytes]:
        self._transfer = None
        _, index, subindex, _ = _INITIATE.unpack(data)
        entry = self._dictionary.find(index, subindex)
        value = entry.upload()
        size = len(value)
        if 0 < size <= _EXPEDITED_SIZE:
            flags = _EXPEDITED | _SIZE_INDICATED | (_EXPEDITED_SIZE - size) << 2
            return [_INITIATE.pack(_UPLOAD_RESPONSE | flags, index, subindex, value)]
        self._transfer = _Upload(entry, value)
        head = _UPLOAD_RESPONSE | _SIZE_INDICATED
        return [_INITIATE.pack(head, index, subindex, size.to_bytes(4, "little"))]

    def _upload_segment(self, data: bytes) -> list[bytes]:
        upload = self._transfer
        if not isinstance(upload, _Upload):
            raise AccessError(AbortCode.UNKNOWN_COMMAND)
        _check_toggle(data, upload.toggle)
        segment = upload.value[upload.sent : upload.sent + _SEGMENT_SIZE]
        upload.sent += _SEGMENT_SIZE
        head = _UPLOAD_SEGMENT_RESPONSE | upload.toggle | (_SEGMENT_SIZE - len(segment)) << 1
        upload.toggle ^= _TOGGLE
        if upload.sent >= len(upload.value):
            head |= _LAST_SEGMENT
            self._transfer = None
        return [bytes([head]) + segment.ljust(_SEGMENT_SIZE, b"\0")]

    def _initiate_download(self, data: bytes) -> list[bytes]:
        self._transfer = None
        head, index, subindex, payload = _INITIATE.unpack(data)
        entry = self._dictionary.find(index, subindex)
        if head & _EXPEDITED:
            size = _EXPEDITED_SIZE
            if head & _SIZE_INDICATED:
                size -= head >> 2 & 3
            elif entry.size is not None:
                size = min(size, entry.size)
            entry.download(payload[:size])
        else:
            announced = int.from_bytes(payload, "little") if head & _SIZE_INDICATED else None
            entry.check_download(announced)
            _check_memory(announced or 0)
            self._transfer = _Download(entry, announced)
        return [_INITIATE.pack(_DOWNLOAD_RESPONSE, index, subindex, b"")]

    def _download_segment(self, data: bytes) -> list[bytes]:
        download = self._transfer
        if not isinstance(download, _Download):
            raise AccessError(AbortCode.UNKNOWN_COMMAND)
        head = data[0]
        _check_toggle(data, download.toggle)
        download.data += data[1 : 1 + _SEGMENT_SIZE - (head >> 1 & 7)]
        received = len(download.data)
        _check_memory(received)
        if download.size is not None and received > download.size:
            raise AccessError(AbortCode.TOO_LONG)
        if head & _LAST_SEGMENT:
            if download.size is not None and received < download.size:
                raise AccessError(AbortCode.TOO_SHORT)
            self._transfer = None
            download.entry.download(bytes(download.data))
        response = _DOWNLOAD_SEGMENT_RESPONSE | download.toggle
        download.toggle ^= _TOGGLE
        return [bytes([response]).ljust(_FRAME_SIZE, b"\0")]

    def _block_download(self, data: bytes) -> list[bytes]:
        download = self._transfer
        if _subcommand(data) == _BLOCK_END:
            if not isinstance(download, BlockDownload):
                raise AccessError(AbortCode.UNKNOWN_COMMAND)
            self._transfer = None
            return download.end(data)
        self._transfer = None
        head, index, subindex, payload = _INITIATE.unpack(data)
        entry = self._dictionary.find(index, subindex)
        size = int.from_bytes(payload, "little") if head & _BLOCK_SIZE_INDICATED else None
        entry.check_download(size)
        _check_memory(size or 0)
        self._transfer = BlockDownload(entry, size, bool(head & _CRC), _MAX_SIZE)
        response = _BLOCK_DOWNLOAD_RESPONSE | _CRC
        return [_INITIATE.pack(response, index, subindex, bytes([BLOCK_SIZE]))]

    def _block_upload(self, data: bytes) -> list[bytes]:
        subcommand = _subcommand(data)
        if subcommand == _BLOCK_INITIATE:
            return self._initiate_block_upload(data)
        upload = self._transfer
        if not isinstance(upload, BlockUpload):
            raise AccessError(AbortCode.UNKNOWN_COMMAND)
        if subcommand == _BLOCK_START:
            return upload.block()
        if subcommand == _BLOCK_ACKNOWLEDGE:
            return upload.acknowledge(data)
        self._transfer = None
        return []

    def _initiate_block_upload(self, data: bytes) -> list[bytes]:
        self._transfer = None
        _, index, subindex, (block_size, threshold, *_) = _INITIATE.unpack(data)
        entry = self._dictionary.find(index, subindex)
        value = entry.upload()
        upload = BlockUpload(entry, value, block_size)
        if 0 < len(value) <= threshold:  # the client prefers a segmented transfer
            return self._initiate_upload(data)
        self._transfer = upload
        head = _BLOCK_UPLOAD_RESPONSE | _CRC | _BLOCK_SIZE_INDICATED
        return [_INITIATE.pack(head, index, subindex, len(value).to_bytes(4, "little"))]


def _subcommand(data: bytes) -> int:
    return data[0] & (1 if data[0] >> 5 == _BLOCK_DOWNLOAD else 3)


def _unknown_command(_: bytes) -> list[bytes]:
    raise AccessError(AbortCode.UNKNOWN_COMMAND)


def _check_toggle(data: bytes, expected: int) -> None:
    if data[0] & _TOGGLE != expected:
        raise AccessError(AbortCode.TOGGLE_BIT)


def _check_memory(size: int) -> None:
    if size > _MAX_SIZE:
        raise AccessError(AbortCode.OUT_OF_MEMORY)
