"""What is found out about a bench before and beside a run."""

from canwall.bench.doctor import Finding, Findings, examine

__all__ = ["Finding", "Findings", "examine"]
