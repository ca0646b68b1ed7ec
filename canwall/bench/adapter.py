"""State of an adapter: bit rate, error counters and queue, where the interface tells them."""

import json
import subprocess
from dataclasses import dataclass
from typing import Any

from canwall.config import Bus as BusSettings

#: Interfaces without a wire, on which nothing can be wrong.
_WITHOUT_WIRE = ("virtual", "unixcan")
_TIMEOUT_S = 5.0
#: Counter of transmit or receive errors from which on a controller warns (ISO 11898-1).
_WARNING = 96
#: Frames that a cycle of the wall may have to queue at once, with SDO beside it.
_LEAST_QUEUE = 10

_CABLE = (
    "look to the bit rate of all nodes, to cable and plugs, and to the termination: 60 Ω between "
    "CAN_H and CAN_L with the supply off"
)


@dataclass(frozen=True)
class AdapterReport:
    """One thing about an adapter.

    Attributes:
        what: What was checked.
        found: What was found.
        do: What to do about it; empty if nothing.
        well: False if no run may be tried.
    """

    what: str
    found: str
    do: str = ""
    well: bool = True


def adapter_reports(bus: BusSettings) -> list[AdapterReport]:
    """Return what the interface of `[bus]` tells of itself."""
    if bus.interface in _WITHOUT_WIRE:
        return [
            AdapterReport("adapter", f"{bus.interface} has no wire, bit rate or error counters")
        ]
    if bus.interface != "socketcan":
        return [
            AdapterReport(
                "adapter",
                f"{bus.interface} was opened at {bus.bitrate / 1000:g} kbit/s; python-can does not "
                f"tell its error counters",
                "the vendor's tool has them",
            )
        ]
    command = ["ip", "-details", "-statistics", "-json", "link", "show", "dev", bus.channel]
    try:
        shown = subprocess.run(
            command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=True
        )
        (link,) = json.loads(shown.stdout)
    except subprocess.CalledProcessError as error:
        why = error.stderr.strip() or f"exit code {error.returncode}"
        do = f"look to bus.channel = {bus.channel!r}; `ip link` lists what there is"
        return [AdapterReport("adapter", f"`{' '.join(command)}` does not tell: {why}", do)]
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        return [
            AdapterReport(
                "adapter",
                f"`{' '.join(command)}` does not tell: {type(error).__name__}",
                "install iproute2",
            )
        ]
    return socketcan_reports(link, bus)


def socketcan_reports(link: dict[str, Any], bus: BusSettings) -> list[AdapterReport]:
    """Return what `ip -details -statistics -json` tells of a SocketCAN interface.

    Args:
        link: Its object of the interface.
        bus: `[bus]`.
    """
    channel, info = bus.channel, link.get("linkinfo", {})
    if info.get("info_kind") == "vcan":
        return [AdapterReport("adapter", f"{channel} is virtual: no bit rate or error counters")]
    data, totals = info.get("info_data", {}), info.get("info_xstats", {})
    reports = [_bit_rate(data.get("bittiming", {}).get("bitrate"), bus)]
    state, counters = data.get("state"), data.get("berr_counter")
    if state is None:
        reports.append(
            AdapterReport("error counters", f"the driver of {channel} does not tell its state")
        )
    else:
        reports.append(_state(str(state), counters, channel))
    counted = {name: totals[name] for name in ("bus_error", "error_passive", "bus_off", "restarts")
               if totals.get(name)}  # fmt: skip
    if counted:
        listed = ", ".join(f"{name} {count}" for name, count in counted.items())
        reports.append(
            AdapterReport("errors so far", f"{listed}, since {channel} was brought up", _CABLE)
        )
    queue = link.get("txqlen")
    if isinstance(queue, int) and queue < _LEAST_QUEUE:
        reports.append(
            AdapterReport(
                "transmit queue",
                f"txqueuelen {queue}: frames may be refused",
                f"as root: ip link set {channel} txqueuelen 100",
            )
        )
    return reports


def _bit_rate(bitrate: int | None, bus: BusSettings) -> AdapterReport:
    if bitrate is None:
        return AdapterReport("bit rate", f"the driver of {bus.channel} does not tell")
    found = f"{bus.channel} has {bitrate / 1000:g} kbit/s"
    if bitrate == bus.bitrate:
        return AdapterReport("bit rate", found)
    return AdapterReport(
        "bit rate",
        f"{found}, bus.bitrate = {bus.bitrate}",
        f"correct bus.bitrate, or as root: ip link set {bus.channel} down; "
        f"ip link set {bus.channel} type can bitrate {bus.bitrate}; ip link set {bus.channel} up",
        well=False,
    )


def _state(state: str, counters: dict[str, int] | None, channel: str) -> AdapterReport:
    found = state
    most = 0
    if counters is not None:
        found += f", transmit errors {counters['tx']}, receive errors {counters['rx']}"
        most = max(counters.values())
    if state in ("STOPPED", "SLEEPING"):
        return AdapterReport(
            "error counters", found, f"as root: ip link set {channel} up", well=False
        )
    if state == "BUS-OFF":
        do = f"{_CABLE}; then as root: ip link set {channel} down, and up"
        return AdapterReport("error counters", found, do, well=False)
    if state != "ERROR-ACTIVE" or most >= _WARNING:
        return AdapterReport("error counters", found, _CABLE, well=False)
    return AdapterReport("error counters", found, _CABLE if most else "")
