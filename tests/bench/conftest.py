"""Fixture of the doctor's tests."""

import pytest

import canwall.bench.scan
import canwall.bench.trial


@pytest.fixture
def _hasty_doctor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the doctor's waits, and take the pauses of a busy machine for no finding."""
    monkeypatch.setattr(canwall.bench.scan, "_LISTEN_S", 0.1)
    monkeypatch.setattr(canwall.bench.trial, "_ALIVE_S", 0.2)
    monkeypatch.setattr(canwall.bench.trial, "_MOST_MISSED", 1.0)
    monkeypatch.setattr(canwall.bench.trial, "_MOST_LATE", 1.0)
