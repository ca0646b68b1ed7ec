"""Errors of a bus in one line: what, where, what to do."""

import errno
import os

import can

#: By errno; the system's own words are for all else.
_WORDS = {
    errno.ENETDOWN: "{channel} is down; as root: ip link set {channel} up",
    errno.ENODEV: "there is no interface {channel}; `ip link` shows which there are",
    errno.ENXIO: "the interface {channel} has disappeared; plug the adapter in, and start again",
    errno.ENOBUFS: "the transmit queue of {channel} stays full: does anybody acknowledge, at this "
    "bit rate? Is there too much on the bus, or the interface's txqueuelen below what is sent in a "
    "cycle? (ip link set {channel} txqueuelen 100)",
    errno.EAGAIN: "the transmit buffer of {channel} stays full: nobody reads, or nobody "
    "acknowledges; end what stands still on the bus",
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN; use another bus.interface, or "
    "scripts/vcan-guest",
}


def reason(number: int, channel: str) -> str:
    """Describe an errno; channel is that of `[bus]`."""
    words = _WORDS.get(number)
    return os.strerror(number) if words is None else words.format(channel=channel)


def bus_error(number: int, bus: can.BusABC) -> can.CanOperationError:
    """Return the exception to raise for an errno of a bus."""
    channel = getattr(bus, "channel", None)
    text = reason(number, channel if isinstance(channel, str) else bus.channel_info)
    return can.CanOperationError(text, None if number in _WORDS else number)


def explained(error: can.CanOperationError, bus: can.BusABC) -> can.CanOperationError:
    """Rephrase an error of python-can where its errno is known."""
    number = error.error_code
    return error if number is None or number not in _WORDS else bus_error(number, bus)
