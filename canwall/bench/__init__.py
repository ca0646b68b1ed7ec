"""What is found out about a bench before and beside a run."""

from canwall.bench.doctor import Finding, Findings, examine
from canwall.bench.latency import Latency, measure_latency

__all__ = ["Finding", "Findings", "Latency", "examine", "measure_latency"]
