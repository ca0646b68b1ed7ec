"""Laws by name, their options, when they are compiled, and that they do not allocate."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from law_bench import COMPENSATED, wall_of
from numba.core.runtime import _nrt_python, rtsys

from canwall.compiled import Record, compiled_for_c
from canwall.walls import (
    DEADBEAT,
    LAWS,
    WALL,
    Law,
    UnknownLawError,
    find_law,
    interface,
    wall_force,
)
from canwall.workbench import Ball
from canwall.workbench.ball import bounce


def test_every_law_of_the_theory_is_there() -> None:
    assert list(LAWS) == [
        "standard",
        "damped",
        "hysteresis",
        "exponential",
        "thresholded_damper",
        "unidirectional_damper",
        "offset_damper",
        "energy_bounding",
        "virtual_coupling",
        "half_sample",
        "half_sample+deadbeat",
        "pole_placement",
        "pole_placement+deadbeat",
        "midpoint",
        "two_step",
        "mean_force",
        "push_only",
        "rigid",
    ]
    for name, law in LAWS.items():
        assert find_law(name) is law
        assert law.name == name


@pytest.mark.parametrize(
    "law", [*(name for name in LAWS if not name.endswith(DEADBEAT)), "mine.py:mine"]
)
def test_deadbeat_is_an_option_of_some_laws(law: str) -> None:
    if law + DEADBEAT in COMPENSATED:
        assert find_law(law, deadbeat=True) is LAWS[law + DEADBEAT]
        return
    with pytest.raises(UnknownLawError) as caught:
        find_law(law, deadbeat=True)
    assert str(caught.value) == (
        f"law {law} has no deadbeat compensation; half_sample, pole_placement have"
    )


def test_compensation_that_is_in_the_name_is_not_added_again() -> None:
    assert find_law("half_sample" + DEADBEAT, deadbeat=True) is LAWS["half_sample" + DEADBEAT]


@pytest.mark.parametrize("name", ["Standard", "half-sample", "", "deadbeat"])
@pytest.mark.parametrize("deadbeat", [False, True])
def test_unknown_law(name: str, deadbeat: bool) -> None:
    meant = "did you mean (standard|half_sample)"
    with pytest.raises(UnknownLawError, match=rf"unknown law '.*'; (known are standard|{meant})"):
        find_law(name, deadbeat)


@pytest.mark.parametrize(("name", "meant"), [("Standard", "standard"), ("rigd", "rigid")])
def test_misspelt_law(name: str, meant: str) -> None:
    with pytest.raises(UnknownLawError, match=f"unknown law '{name}'; did you mean {meant}"):
        find_law(name)


def test_options_have_defaults_and_names() -> None:
    hysteresis = LAWS["hysteresis"]
    assert hysteresis.option_values({}) == [0.8, 0.0]
    assert hysteresis.option_values({"release": 0.01}) == [0.8, 0.01]
    assert LAWS["standard"].option_values({}) == []
    with pytest.raises(UnknownLawError, match="no option 'slope'; it has softening, release"):
        hysteresis.option_values({"slope": 1.0})
    with pytest.raises(UnknownLawError, match="law standard has no option 'slope'; it has none"):
        LAWS["standard"].option_values({"slope": 1.0})


def test_a_law_is_compiled_once_when_it_is_first_used(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = []

    def counting(*args: Any, **kwargs: Any) -> Any:
        compiled.append(args)
        return compiled_for_c(*args, **kwargs)

    monkeypatch.setattr(interface, "compiled_for_c", counting)

    def constant(wall: Record) -> float:
        return 2.5

    assert interface.law(constant).option_values({}) == []
    law = Law("constant", constant, {}, cached=False)
    assert compiled == []
    with ThreadPoolExecutor(8) as threads:
        addresses = set(threads.map(lambda _: law.address, range(8)))
    assert len(compiled) == 1
    assert len(addresses) == 1
    assert wall_force(addresses.pop(), np.zeros(1, WALL)[0]) == 2.5


@pytest.fixture
def _counted_allocations() -> Iterator[None]:
    was_on = _nrt_python.memsys_stats_enabled()
    _nrt_python.memsys_enable_stats()
    yield
    if not was_on:
        _nrt_python.memsys_disable_stats()


def allocations(law: Law) -> int:
    """Number of allocations by numba's runtime while a ball bounces on a law."""
    ball = Ball(9.0, damping=0.1, viscous=0.01, spring=0.1, tension="budget", passivity=0.5)
    wall = wall_of(ball, "standard")
    wall["option_values"][0, : len(law.options)] = law.option_values({})
    trajectory = np.zeros((3, 1000))
    bounce(wall, law.address, 1.0, 0.0, trajectory)  # compiled by now
    before = rtsys.get_allocation_stats()
    bounce(wall, law.address, 1.0, 0.0, trajectory)
    after = rtsys.get_allocation_stats()
    assert np.any(trajectory[2] > 0.0)
    return int(after.alloc - before.alloc + after.mi_alloc - before.mi_alloc)


@pytest.mark.usefixtures("_counted_allocations")
@pytest.mark.parametrize("law", LAWS)
def test_no_law_allocates_in_the_cycle(law: str) -> None:
    # An array that enters compiled code costs one reference per call.
    assert allocations(LAWS[law]) <= 4


@pytest.mark.usefixtures("_counted_allocations")
def test_a_law_that_allocates_is_detected(tmp_path: Path) -> None:
    (tmp_path / "wasteful.py").write_text(
        "import numpy as np\n"
        "def wasteful(wall):\n"
        "    history = np.zeros(int(2.0 + wall.stiffness))\n"
        "    history[0] = -wall.y\n"
        "    return history.max()\n"
    )
    assert allocations(find_law(f"{tmp_path}/wasteful.py:wasteful")) > 900
