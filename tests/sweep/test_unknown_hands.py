"""Walls with a cap in hands that the laws do not know, and in known ones.

The former are shares of the table in docs/results.md.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from canwall import config
from canwall.config.hand import Hand
from canwall.run.closed_loop import simulate
from canwall.sweep import make_plan
from canwall.sweep.axes import settings_at

pytestmark = pytest.mark.slow

_ASKED = np.geomspace(30.0, 5000.0, 12).round(1)


def _strikes(
    operator: str, friction: float, delay_error: float, model: str = "drive", **keys: float
) -> NDArray[np.void]:
    """Return the measures of 108 strikes on the servo of 1600 Hz; keys: with __ for the dot."""
    given = {key.replace("__", "."): value for key, value in keys.items()}
    settings = config.load(config.shipped("config/sim.toml"), {"wall.cap": 0.5} | given)
    axes = {
        "law": "mean_force",
        "model": model,
        "servo": "1600Hz",
        "operator": operator,
        "friction": friction,
        "delay_error": delay_error,
        "speed": [0.3, 0.8, 2.0],
        "phase": [0.0, 0.35, 0.7],
        "press": 1.2,
        "stiffness": _ASKED.tolist(),
    }
    plan = make_plan(settings.model_copy(update={"sweep": {}}), axes)
    (point,) = plan.points
    walls = np.stack([_ASKED, np.zeros(len(_ASKED))], axis=1)
    return np.concatenate([plan.prepare(point, strike).on_all(walls) for strike in plan.strikes])


def _strike(keys: dict[str, float], axes: dict[str, Any]) -> np.void:
    """Return the measures of one strike; keys: of the configuration, axes: a value each."""
    settings = config.load(config.shipped("config/sim.toml"), keys)
    plan = make_plan(settings.model_copy(update={"sweep": {}}), axes)
    return plan.prepare(plan.points[0], plan.strikes[0]).on(axes["stiffness"], 0.0)


@pytest.mark.parametrize("delay_error", [0.0, 0.15])
@pytest.mark.parametrize("operator", ["fingertip", "finger", "grip"])
def test_cap_keeps_every_wall_quiet_in_a_light_hand(operator: str, delay_error: float) -> None:
    for friction in (0.0, 0.02):
        assert _strikes(operator, friction, delay_error)["chatters"].sum() == 0


def test_blow_on_a_stiff_wall_is_not_taken_for_a_push() -> None:
    """A finger that comes fast, on walls without a cap: it would bounce on seven of these nine."""
    axes = {"law": "mean_force", "model": "drive", "servo": "1600Hz", "operator": "finger"}
    axes |= {"friction": 0.0, "delay_error": -0.3, "speed": 2.0, "press": 1.2}
    settings = config.load(config.shipped("config/sim.toml"), {"wall.cap": 0.0})
    phases, walls = [0.0, 0.35, 0.7], [0.856, 0.908, 0.962]
    given = axes | {"phase": phases, "stiffness_normalised": walls}
    plan = make_plan(settings.model_copy(update={"sweep": {}}), given)
    (point,) = plan.points
    found = [
        plan.prepare(point, strike).on(stiffness * 2.28e-4 / 1e-6, 0.0)
        for strike in plan.strikes
        for stiffness in walls
    ]
    assert sum(each["chatters"] for each in found) == 0


@pytest.mark.parametrize("delay_error", [0.0, 0.15])
def test_slow_arm_on_a_light_rotor_is_not_thrown(delay_error: float) -> None:
    """Its torque changes more slowly than a hand may push, but not than one that came so slowly.

    With a fingertip's mass in its model the wall would throw the arm out 1.5 times as fast.
    """
    axes = {"law": "mean_force", "model": "drive", "servo": "800Hz", "operator": "arm"}
    axes |= {"friction": 0.0, "delay_error": delay_error, "press": 1.2}
    axes |= {"speed": 0.241, "phase": 0.136, "stiffness": 40.8}
    assert _strike({"simulation.inertia_kg_m2": 2.5e-5}, axes)["restitution"] < 1.0


@pytest.mark.parametrize("delay_error", [-0.3, 0.0, 0.15])
@pytest.mark.parametrize("operator", ["fingertip", "finger", "grip", "hand", "arm"])
def test_known_hand_is_no_worse_than_an_unknown_one(operator: str, delay_error: float) -> None:
    found = [_strikes(operator, f, delay_error, "matched") for f in (0.0, 0.02)]
    assert np.concatenate(found)["chatters"].sum() <= (2 if operator == "arm" else 0)


def test_known_hand_s_wall_is_as_stiff_as_encoder_and_delay_bear() -> None:
    """2.2 N a count at 80 mm, and 0.83·(1.85/D)⁵·m/T² at D = 2, 0.35 of the servo and 0.1."""
    strike = {"law": "mean_force", "model": "matched", "servo": "1600Hz", "operator": "arm"}
    strike |= {"friction": 0.0, "speed": 0.5, "phase": 0.0, "press": 1.2, "stiffness": 5000.0}
    for axes, stiffest in (
        ({"counts": 10_000}, 2.2 * 0.08 * 10_000 / (2.0 * np.pi)),
        ({"delay": 2.0}, 0.83 * (1.85 / 2.45) ** 5 * 3.62e-3 / 1e-6),
    ):
        found = _strike({"wall.cap": 1.0}, strike | axes)
        assert found["stiffness_in_force"] == pytest.approx(stiffest, rel=2e-3)


def test_known_hand_under_a_plain_filter_is_worse_than_an_unknown_one() -> None:
    """The random walk of the source text is for an ideal servo."""
    plain = {"estimator__force_walk_nm_per_sqrt_s": 0.2}
    assert _strikes("grip", 0.0, 0.0, "matched", **plain)["chatters"].mean() > 0.5


@pytest.mark.parametrize(("operator", "most"), [("fingertip", 31), ("finger", 14), ("grip", 25)])
def test_margin_halves_what_a_delay_costs_that_is_told_too_short(operator: str, most: int) -> None:
    """Without a margin it is 62, 28 and 39 of 108."""
    assert _strikes(operator, 0.0, -0.3)["chatters"].sum() <= most


@pytest.mark.parametrize("delay_error", [-0.3, 0.0, 0.15])
def test_a_heavy_hand_does_not_hunt_friction(delay_error: float) -> None:
    """A filter that is slow against the wall has it slip to and fro, at 2 to 4 Hz."""
    assert _strikes("hand", 0.02, delay_error)["chatters_amplitude"].sum() == 0


@pytest.mark.parametrize(("stiffness", "speed", "phase"), [(450.0, 0.6, 0.35), (600.0, 0.3, 0.7)])
def test_torque_on_a_heavy_hand_does_not_creep_until_it_slips(
    stiffness: float, speed: float, phase: float
) -> None:
    """Else the handle sticks for 150 ms, slips by four to six counts, and so on."""
    point: dict[str, Any] = {"operator": "hand", "law": "mean_force", "model": "drive"}
    point |= {"servo": "800Hz", "friction": 0.02, "delay_error": -0.3, "press": 1.2}
    wall = {"wall.stiffness_nm_per_rad": stiffness, "wall.cap": 0.8}
    settings = config.load(config.shipped("config/sim.toml"), wall)
    settings = settings_at(settings, point | {"speed": speed, "phase": phase})
    pressed = simulate(settings.model_copy(update={"schedule": ()}), 1200).rows[400:]
    assert np.ptp(pressed["torque_cmd"]) < 0.005
    assert np.ptp(pressed["y"]) == 0.0


@pytest.mark.parametrize(
    ("operator", "speed", "phase"),
    [
        ("none", 0.5, 0.0),
        ("finger", 0.5, 0.0),
        ("finger", 0.4, 0.2),
        ("grip", 0.5, 0.0),
        ("grip", 0.3, 0.6),
        ("grip", 0.4, 0.2),
    ],
)
def test_hand_that_pushes_to_and_fro_is_no_heavier(
    operator: str, speed: float, phase: float
) -> None:
    """At the upper end of tremor, 10 Hz, by ± 20 mN·m about a steady press.

    It is no swing of the wall, neither as a whole nor in part.
    """
    point: dict[str, Any] = {"operator": operator, "law": "mean_force", "model": "drive"}
    point |= {"servo": "1600Hz", "friction": 0.0, "speed": speed, "phase": phase, "press": 1.2}
    settings = settings_at(config.load(config.shipped("config/sim.toml")), point)
    assert settings.simulation is not None
    hand = settings.simulation.hand
    side = 1.0 if hand.press_rad > hand.rest_rad else -1.0
    mean = 0.0 if hand.stiffness_nm_per_rad else 0.15

    def press(torque: float, duration_s: float) -> dict[str, Any]:
        return {"move": "press", "torque_nm": side * torque, "duration_s": duration_s}

    moves = [
        press(mean, 0.3) | {"position_rad": hand.press_rad},
        {"move": "rest", "duration_s": 0.3},
        *(press(mean + more, 0.05) for more in [0.02, -0.02] * 10),
    ]
    pushing = Hand.model_validate(hand.model_dump() | {"script": moves})
    simulation = settings.simulation.model_copy(update={"hand": pushing})
    rows = simulate(
        settings.model_copy(update={"simulation": simulation, "schedule": ()}), 1700
    ).rows
    moving = rows[900:1600]
    assert np.ptp(moving["torque_cmd"]) > 0.03
    mass = simulation.inertia_kg_m2 + pushing.inertia_kg_m2
    assert moving["mass_est"].max() < 1.4 * mass
