"""SDO server (CiA 301, 7.2.4): expedited and segmented transfer."""

from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct

from canwall.simdrive.abort import AbortCode, AccessError
from canwall.simdrive.dictionary import Dictionary, Entry
from canwall.simdrive.frame import Send

_REQUEST = 0x600
_RESPONSE = 0x580

_INITIATE = Struct("<BHB4s")
_ABORT = Struct("<BHBL")
_FRAME_SIZE = 8
_SEGMENT_SIZE = 7
_EXPEDITED_SIZE = 4
_MAX_SIZE = 4096
"""Bytes that a string or domain may be given; the device's memory, so to say."""

# Client and server command specifiers, in bits 5 to 7 of the first byte.
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _CLIENT_ABORT = range(5)
_DOWNLOAD_RESPONSE = 0x60
_UPLOAD_RESPONSE = 0x40
_DOWNLOAD_SEGMENT_RESPONSE = 0x20
_UPLOAD_SEGMENT_RESPONSE = 0x00
_ABORT_RESPONSE = 0x80

_EXPEDITED = 0x02
_SIZE_INDICATED = 0x01
_TOGGLE = 0x10
_LAST_SEGMENT = 0x01


@dataclass(slots=True)
class _Upload:
    """Segments on their way to the client."""

    entry: Entry
    rest: bytes
    toggle: int = 0


@dataclass(slots=True)
class _Download:
    """Segments on their way from the client; ``size`` is None if it was not indicated."""

    entry: Entry
    size: int | None
    data: bytes = b""
    toggle: int = 0


class SdoServer:
    """Answers the default SDO; one transfer at a time, a new one replaces the old."""

    def __init__(self, dictionary: Dictionary, send: Send) -> None:
        """Args: dictionary: what is read and written; send: takes the responses."""
        self.can_id = _REQUEST + dictionary.node_id
        """CAN-ID of the requests."""
        self._response_id = _RESPONSE + dictionary.node_id
        self._dictionary = dictionary
        self._send = send
        self._transfer: _Upload | _Download | None = None
        self._services: dict[int, Callable[[bytes], bytes]] = {
            _DOWNLOAD: self._initiate_download,
            _DOWNLOAD_SEGMENT: self._download_segment,
            _UPLOAD: self._initiate_upload,
            _UPLOAD_SEGMENT: self._upload_segment,
        }

    def reset(self) -> None:
        """Forget the transfer under way."""
        self._transfer = None

    def receive(self, data: bytes) -> None:
        """Take a request and send the response to it. SDO frames have eight bytes."""
        if len(data) != _FRAME_SIZE:
            return
        command = data[0] >> 5
        if command == _CLIENT_ABORT:
            self._transfer = None
            return
        address = self._address(command, data)
        try:
            response = self._services.get(command, _unknown_command)(data)
        except AccessError as abort:
            self._transfer = None
            response = _ABORT.pack(_ABORT_RESPONSE, *address, abort.code)
        self._send((self._response_id, response))

    def _address(self, command: int, data: bytes) -> tuple[int, int]:
        """Return index and sub-index for an abort: segments do not carry them."""
        if command in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT):
            return self._transfer.entry.key if self._transfer else (0, 0)
        _, index, subindex, _ = _INITIATE.unpack(data)
        return index, subindex

    def _initiate_upload(self, data: bytes) -> bytes:
        self._transfer = None
        _, index, subindex, _ = _INITIATE.unpack(data)
        entry = self._dictionary.find(index, subindex)
        value = entry.upload()
        size = len(value)
        if 0 < size <= _EXPEDITED_SIZE:
            flags = _EXPEDITED | _SIZE_INDICATED | (_EXPEDITED_SIZE - size) << 2
            return _INITIATE.pack(_UPLOAD_RESPONSE | flags, index, subindex, value)
        self._transfer = _Upload(entry, value)
        head = _UPLOAD_RESPONSE | _SIZE_INDICATED
        return _INITIATE.pack(head, index, subindex, size.to_bytes(4, "little"))

    def _upload_segment(self, data: bytes) -> bytes:
        upload = self._transfer
        if not isinstance(upload, _Upload):
            raise AccessError(AbortCode.UNKNOWN_COMMAND)
        _check_toggle(data, upload.toggle)
        segment, upload.rest = upload.rest[:_SEGMENT_SIZE], upload.rest[_SEGMENT_SIZE:]
        head = _UPLOAD_SEGMENT_RESPONSE | upload.toggle | (_SEGMENT_SIZE - len(segment)) << 1
        upload.toggle ^= _TOGGLE
        if not upload.rest:
            head |= _LAST_SEGMENT
            self._transfer = None
        return bytes([head]) + segment.ljust(_SEGMENT_SIZE, b"\0")

    def _initiate_download(self, data: bytes) -> bytes:
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
        return _INITIATE.pack(_DOWNLOAD_RESPONSE, index, subindex, b"")

    def _download_segment(self, data: bytes) -> bytes:
        download = self._transfer
        if not isinstance(download, _Download):
            raise AccessError(AbortCode.UNKNOWN_COMMAND)
        head = data[0]
        _check_toggle(data, download.toggle)
        download.data += data[1 : 1 + _SEGMENT_SIZE - (head >> 1 & 7)]
        _check_memory(len(download.data))
        if head & _LAST_SEGMENT:
            if download.size is not None and len(download.data) != download.size:
                raise AccessError(AbortCode.LENGTH)
            self._transfer = None
            download.entry.download(download.data)
        response = _DOWNLOAD_SEGMENT_RESPONSE | download.toggle
        download.toggle ^= _TOGGLE
        return bytes([response]).ljust(_FRAME_SIZE, b"\0")


def _unknown_command(_: bytes) -> bytes:
    raise AccessError(AbortCode.UNKNOWN_COMMAND)


def _check_toggle(data: bytes, expected: int) -> None:
    if data[0] & _TOGGLE != expected:
        raise AccessError(AbortCode.TOGGLE_BIT)


def _check_memory(size: int) -> None:
    if size > _MAX_SIZE:
        raise AccessError(AbortCode.OUT_OF_MEMORY)
