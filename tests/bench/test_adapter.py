"""What an adapter tells of itself, as `ip -details -statistics -json link` of iproute2 has it."""

import subprocess
from typing import Any

import pytest

from canwall.bench.adapter import AdapterReport, adapter_reports, socketcan_reports
from canwall.config import Bus

BUS = Bus(interface="socketcan", channel="can0")


def link(
    state: str = "ERROR-ACTIVE",
    tx: int = 0,
    rx: int = 0,
    bitrate: int = 1_000_000,
    txqlen: int = 100,
    **totals: int,
) -> dict[str, Any]:
    """The object of one interface, names and nesting as in iproute2's ip/iplink_can.c."""
    return {
        "ifname": "can0",
        "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
        "txqlen": txqlen,
        "link_type": "can",
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": state,
                "berr_counter": {"tx": tx, "rx": rx},
                "restart_ms": 0,
                "bittiming": {"bitrate": bitrate, "sample_point": "0.875"},
            },
            "info_xstats": {"restarts": 0, "bus_error": 0, "error_passive": 0, "bus_off": 0}
            | totals,
        },
    }


def told(shown: dict[str, Any]) -> dict[str, AdapterReport]:
    return {report.what: report for report in socketcan_reports(shown, BUS)}


def test_a_sound_adapter_has_nothing_to_do() -> None:
    reports = told(link())
    assert all(report.well and not report.do for report in reports.values())
    assert reports["bit rate"].found == "can0 has 1000 kbit/s"
    assert reports["error counters"].found == "ERROR-ACTIVE, transmit errors 0, receive errors 0"


@pytest.mark.parametrize(
    ("shown", "what", "well", "do"),
    [
        (link(bitrate=500_000), "bit rate", False, "type can bitrate 1000000"),
        (link("ERROR-PASSIVE", tx=128), "error counters", False, "60 Ω between CAN_H and CAN_L"),
        (link("BUS-OFF", tx=248), "error counters", False, "ip link set can0 down, and up"),
        (link("STOPPED"), "error counters", False, "ip link set can0 up"),
        (link(rx=96), "error counters", False, "termination"),
        (link(rx=3), "error counters", True, "termination"),
        (link(bus_off=2), "errors so far", True, "termination"),
        (link(txqlen=1), "transmit queue", True, "ip link set can0 txqueuelen 100"),
    ],
)
def test_what_is_wrong_says_what_to_do(
    shown: dict[str, Any], what: str, well: bool, do: str
) -> None:
    report = told(shown)[what]
    assert report.well is well
    assert do in report.do


def test_what_a_driver_does_not_tell_is_said() -> None:
    reports = told({"ifname": "can0", "linkinfo": {"info_kind": "can", "info_data": {}}})
    assert reports["bit rate"].found == "the driver of can0 does not tell"
    assert reports["error counters"].found == "the driver of can0 does not tell its state"
    (virtual,) = socketcan_reports({"linkinfo": {"info_kind": "vcan"}}, BUS)
    assert "virtual" in virtual.found


@pytest.mark.parametrize(
    ("interface", "words"),
    [("unixcan", "no wire"), ("pcan", "does not tell its error counters")],
)
def test_other_interfaces(interface: str, words: str) -> None:
    (report,) = adapter_reports(Bus(interface=interface, channel="x"))
    assert words in report.found
    assert report.well


def test_an_interface_that_is_not_there() -> None:
    (report,) = adapter_reports(Bus(interface="socketcan", channel="can-none"))
    assert "does not tell" in report.found


def test_an_interface_that_ip_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(command: list[str], **options: object) -> None:
        raise subprocess.CalledProcessError(1, command, "", 'Device "can-none" does not exist.\n')

    monkeypatch.setattr(subprocess, "run", fail)
    (report,) = adapter_reports(Bus(interface="socketcan", channel="can-none"))
    assert report.found.endswith('does not tell: Device "can-none" does not exist.')
    assert "bus.channel = 'can-none'" in report.do
