"""Opening of a bus, with errors that name the keys of `[bus]`."""

import can

from canwall.bus.errors import reason
from canwall.errors import ConfigError, did_you_mean


def open_bus(interface: str, channel: str, bitrate: int) -> can.BusABC:
    """Open a python-can bus.

    Args:
        interface: As in `[bus]`, any that python-can knows.
        channel: Channel of the interface.
        bitrate: In bit/s.

    Raises:
        ConfigError: If the bus does not exist.
    """
    try:
        return can.Bus(interface=interface, channel=channel, bitrate=bitrate)
    except (can.CanError, OSError, ValueError, ImportError, TypeError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            why = reason(error.errno, channel)
        else:
            why = str(error).splitlines()[0] if str(error) else type(error).__name__
        if interface not in can.VALID_INTERFACES:
            why += did_you_mean(interface, can.VALID_INTERFACES)
        raise ConfigError(
            f"bus.interface = {interface!r}, bus.channel = {channel!r}: {why}"
        ) from None
