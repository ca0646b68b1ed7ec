"""The laws of a run."""

import pytest
from rig import settings_with

from canwall.cycle import run_laws
from canwall.walls import Law


def test_laws_of_a_run_are_compiled_before_the_bus_is_touched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compiled: list[str] = []
    monkeypatch.setattr(Law, "compile", lambda law: compiled.append(law.name))
    laws = run_laws(settings_with({"wall.law": "standard", "run.more_laws": ["midpoint"]}))
    assert compiled == [law.name for law in laws]
    assert laws[0].name == "standard"
    assert laws[-1].name == "midpoint"
