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


def test_deadbeat_compensation_belongs_to_the_law_and_not_to_those_that_alternate_with_it() -> None:
    settings = settings_with().model_copy(update={"schedule": ()})
    turns = {"law": "half_sample", "deadbeat": True, "alternate": ("standard", "half_sample")}
    wall = settings.wall.model_copy(update=turns)
    laws = run_laws(settings.model_copy(update={"wall": wall}))
    assert [law.name for law in laws] == ["half_sample+deadbeat", "standard", "half_sample"]
    named = {"deadbeat": False, "alternate": ("pole_placement+deadbeat",)}
    laws = run_laws(settings.model_copy(update={"wall": wall.model_copy(update=named)}))
    assert [law.name for law in laws] == ["half_sample", "pole_placement+deadbeat"]
