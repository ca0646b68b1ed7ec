"""Examination of a bench: the doctor, the bus budget, and the latency of the cycle."""

from canwall.bench.doctor import Finding, Findings, examine
from canwall.bench.latency import Latency, measure_latency

__all__ = ["Finding", "Findings", "Latency", "examine", "measure_latency"]
