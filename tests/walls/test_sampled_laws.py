"""The laws that work on the sample alone, against their formulas (docs/laws.md)."""

import math
from collections.abc import Callable
from itertools import product

import pytest
from law_bench import force_at_sample, wall_of

from canwall.workbench import Ball

K, B = 200.0, 3.0

Formula = Callable[[float, float], float]
"""Force inside, at the surface and outside, of a sample (y, ẏ)."""


def inside(force: Formula) -> Formula:
    return lambda y, v: force(y, v) if y < 0.0 else 0.0


def dead_zone(v: float, threshold: float) -> float:
    return math.copysign(max(abs(v) - threshold, 0.0), v)


def released(y: float, v: float, softening: float, release: float) -> float:
    if v <= 0.0:
        return -K * y
    return 0.0 if -release < y else -softening * K * y


LAWS: list[tuple[str, dict[str, float], Formula]] = [
    ("standard", {}, inside(lambda y, v: -K * y)),
    ("damped", {}, inside(lambda y, v: -K * y - B * v)),
    ("hysteresis", {}, inside(lambda y, v: released(y, v, 0.8, 0.0))),
    (
        "hysteresis",
        {"softening": 0.5, "release": 0.02},
        inside(lambda y, v: released(y, v, 0.5, 0.02)),
    ),
    ("exponential", {}, inside(lambda y, v: K * 0.02 * (math.exp(-y / 0.02) - 1.0))),
    ("exponential", {"length": 0.3}, inside(lambda y, v: K * 0.3 * (math.exp(-y / 0.3) - 1.0))),
    ("thresholded_damper", {}, inside(lambda y, v: -K * y - B * dead_zone(v, 0.1))),
    (
        "thresholded_damper",
        {"threshold": 1.0},
        inside(lambda y, v: -K * y - B * dead_zone(v, 1.0)),
    ),
    ("unidirectional_damper", {}, inside(lambda y, v: -K * y - (B * v if v < 0.0 else 0.0))),
    ("offset_damper", {}, inside(lambda y, v: -K * y - (B * v if y < -0.002 else 0.0))),
    (
        "offset_damper",
        {"offset": 0.015},
        lambda y, v: (-K * y if y < 0.0 else 0.0) - (B * v if y < 0.015 else 0.0),
    ),
]

POSITIONS = (-0.3, -0.0201, -0.0199, -0.01, -0.001, 0.0, 0.01, 0.1)
VELOCITIES = (-5.0, -0.5, -0.05, 0.0, 0.05, 0.5, 5.0)


@pytest.mark.parametrize(("law", "options", "formula"), LAWS)
def test_formula(law: str, options: dict[str, float], formula: Formula) -> None:
    wall = wall_of(Ball(stiffness=K, damping=B, gravity=-3.0), law, **options)
    for y, v in product(POSITIONS, VELOCITIES):
        assert force_at_sample(wall, law, y, v) == pytest.approx(formula(y, v), rel=1e-13), (y, v)


def test_stiffness_and_damping_can_change_at_any_sample() -> None:
    wall = wall_of(Ball(stiffness=K, damping=B), "damped")
    assert force_at_sample(wall, "damped", -0.1, 1.0) == pytest.approx(0.1 * K - B)
    wall["stiffness"], wall["damping"] = 3 * K, 0.5 * B
    assert force_at_sample(wall, "damped", -0.1, 1.0) == pytest.approx(0.3 * K - 0.5 * B)


@pytest.mark.parametrize("length", [0.0, -0.02, math.nan])
def test_exponential_spring_without_a_length_is_no_number(length: float) -> None:
    """It ends the run; a force of zero would be a wall that is not there."""
    wall = wall_of(Ball(stiffness=K), "exponential", length=length)
    assert math.isnan(force_at_sample(wall, "exponential", -0.01, -1.0))


def test_exponential_spring_ends_in_a_finite_force() -> None:
    """Beyond e⁵⁰ the exponential is clipped, so that no double overflows."""
    wall = wall_of(Ball(stiffness=K), "exponential")
    deepest = force_at_sample(wall, "exponential", -1e300, -1.0)
    assert deepest == force_at_sample(wall, "exponential", -1.01, -1.0) > 1e20
    assert math.isfinite(deepest)
