"""Work on a bench before the first wall: scan, draft of a configuration, doctor, latency."""

from canwall.bench.doctor import diagnose, examine
from canwall.bench.draft import KEYS_OF_A_KIND, DriveFacts, draft, read_drive
from canwall.bench.findings import Finding, Findings
from canwall.bench.latency import Latency, measure_latency
from canwall.bench.scan import BusNode, scan_nodes

__all__ = [
    "KEYS_OF_A_KIND",
    "BusNode",
    "DriveFacts",
    "Finding",
    "Findings",
    "Latency",
    "diagnose",
    "draft",
    "examine",
    "measure_latency",
    "read_drive",
    "scan_nodes",
]
