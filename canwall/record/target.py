"""Address to which the rows of a run are streamed."""

import socket
from urllib.parse import urlsplit

from canwall.errors import InputError

Target = tuple[str, int]
"""Host, as a number, and UDP port."""

_LOOPBACK = "127.0.0.1"


def parse_target(text: str) -> Target:
    """Return the target of udp://HOST:PORT; without HOST, this machine. Raises InputError."""
    shape = f"--stream {text}: has to be udp://HOST:PORT, as udp://{_LOOPBACK}:9870"
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or _LOOPBACK, parts.port
    except ValueError:
        raise InputError(shape) from None
    if parts.scheme != "udp" or not port or parts.path.strip("/") or parts.query:
        raise InputError(shape)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise InputError(f"--stream {text}: {host}: {error}") from None
    address: tuple[str, int] = found[0][4][:2]  # type: ignore[assignment]
    return address
