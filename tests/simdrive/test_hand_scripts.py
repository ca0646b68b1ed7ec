"""Scripts of moves, strikes of a seed, and a hand that can lose the handle."""

from pathlib import Path

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from canwall import config
from canwall.config import Hand, Move, RandomStrikes, Simulation
from canwall.simdrive.mechanics.hand import hand_force, hand_path, random_moves
from canwall.simdrive.mechanics.motion import ServoMotion

PERIOD = 1e-3
SIM = config.shipped("config/sim.toml")

SCRIPT = (
    Move(move="rest", duration_s=0.05),
    Move(move="approach", duration_s=0.1, position_rad=0.0),
    Move(move="press", duration_s=0.05, torque_nm=-0.2),
    Move(move="tap", duration_s=0.1, position_rad=-0.04),
    Move(move="release", duration_s=0.1),
)


def test_moves_follow_one_another() -> None:
    path = hand_path(Hand(rest_rad=0.1, script=SCRIPT), PERIOD, 600)
    constant, _ = hand_force(
        Hand(rest_rad=0.1, script=SCRIPT, stiffness_nm_per_rad=0.0, damping_nm_s_per_rad=0.0),
        PERIOD,
        600,
    )
    for j, position, torque in (
        (0, 0.1, 0.0),
        (50, 0.1, 0.0),
        (100, 0.05, 0.0),  # half way in half the time
        (150, 0.0, 0.0),
        (175, 0.0, -0.1),
        (200, 0.0, -0.2),
        (250, -0.04, -0.2),
        (300, 0.0, -0.2),
        (350, 0.05, -0.1),
        (400, 0.1, 0.0),
        (599, 0.1, 0.0),
    ):
        assert path[j] == pytest.approx(position, abs=1e-12)
        assert constant[j] == pytest.approx(torque, abs=1e-12)
    # Smooth: with the least jerk, no faster than 15/8 of the mean speed.
    assert np.abs(np.diff(path)).max() <= 1.875 * 0.1 / 0.1 * PERIOD


def test_a_strike_written_as_moves_is_that_strike() -> None:
    strike = Hand(strikes=1, press_torque_nm=-0.1)
    moves = (
        Move(move="rest", duration_s=strike.first_strike_s),
        Move(move="press", duration_s=0.1, torque_nm=-0.1, position_rad=-0.1),
        Move(move="rest", duration_s=0.5),
        Move(move="release", duration_s=0.1),
    )
    written = strike.model_copy(update={"script": moves})
    for ours, theirs in zip(
        hand_force(written, PERIOD, 1200), hand_force(strike, PERIOD, 1200), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-9)


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(0, 2**32), st.integers(1, 20))
def test_random_strikes_are_those_of_their_seed(seed: int, number: int) -> None:
    strikes = RandomStrikes(seed=seed, strikes=number, press_torque_nm=(-0.2, -0.1))
    moves = random_moves(strikes, 0.1)
    assert moves == random_moves(strikes, 0.1)
    assert moves != random_moves(strikes.model_copy(update={"seed": seed + 1}), 0.1)
    assert len(moves) == 4 * number
    for pause, press, stay, release in zip(*[iter(moves)] * 4, strict=True):
        assert strikes.pause_s[0] <= pause.duration_s <= strikes.pause_s[1]
        assert strikes.approach_s[0] <= press.duration_s <= strikes.approach_s[1]
        assert strikes.press_s[0] <= stay.duration_s <= strikes.press_s[1]
        assert strikes.withdraw_s[0] <= release.duration_s <= strikes.withdraw_s[1]
        assert strikes.press_rad[0] <= press.position_rad <= strikes.press_rad[1]
        assert -0.2 <= press.torque_nm <= -0.1
        assert release.position_rad == 0.1


def test_more_strikes_do_not_change_the_first_ones() -> None:
    few, many = RandomStrikes(seed=4, strikes=3), RandomStrikes(seed=4, strikes=30)
    assert random_moves(many, 0.0)[:12] == random_moves(few, 0.0)


def written(path: Path, **hand: object) -> config.Settings:
    settings = config.load(SIM)
    raw = settings.model_dump(mode="json", exclude_none=True)
    raw["simulation"]["hand"] |= hand
    path.write_text(tomli_w.dumps(raw), encoding="utf-8")
    return config.load(path)


def test_scripts_are_read_and_written(tmp_path: Path) -> None:
    moves = [{"move": "tap", "duration_s": 1, "position_rad": -0.1}]
    for hand in (
        {"script": moves},
        {"random": {"seed": 3, "pause_s": [0.1, 0.2]}},
        {"grip": False},
    ):
        settings = written(tmp_path / "a.toml", **hand)
        (tmp_path / "b.toml").write_text(settings.to_toml(), encoding="utf-8")
        assert config.load(tmp_path / "b.toml") == settings


@pytest.mark.parametrize(
    ("hand", "complaint"),
    [
        (
            {"script": [{"move": "jump", "duration_s": 1.0}]},
            "simulation.hand.script.0.move: has to be 'rest', 'approach', 'press', 'tap' or",
        ),
        (
            {"script": [{"move": "tap", "duration_s": 1.0}]},
            "simulation.hand.script.0: tap needs position_rad; add it",
        ),
        (
            {"script": [{"move": "rest", "duration_s": 1.0, "torque_nm": 1.0}]},
            "simulation.hand.script.0: rest has no torque_nm; remove it",
        ),
        (
            {"script": [{"move": "rest", "duration": 1.0}]},
            "simulation.hand.script.0.duration: unknown key; did you mean duration_s?",
        ),
        (
            {"random": {"pause_s": [0.3, 0.2]}},
            "simulation.hand.random: pause_s: the lower bound has to come first",
        ),
        (
            {"random": {"seed": 1}, "script": [{"move": "rest", "duration_s": 1.0}]},
            "simulation.hand: script and random are given; keep one of them",
        ),
        (
            {"grip": False, "press_rad": 0.1},
            "simulation.hand: grip = false: press_rad has to differ from rest_rad, "
            "to give the hand a side",
        ),
        (
            {"grip": False, "inertia_kg_m2": 0.0},
            "simulation.hand: grip = false: inertia_kg_m2 has to be greater than 0",
        ),
        (
            {"random": {"sed": 1}},
            "simulation.hand.random.sed: unknown key; did you mean seed?",
        ),
        (
            {"script": [{"move": "rest", "duration_s": 1.0, "torqe_nm": 1.0}]},
            "simulation.hand.script.0.torqe_nm: unknown key; did you mean torque_nm?",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    hand: dict[str, object], complaint: str, tmp_path: Path
) -> None:
    with pytest.raises(config.ConfigError) as caught:
        written(tmp_path / "wrong.toml", **hand)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_hand_that_only_presses_loses_a_handle_that_is_thrown_off() -> None:
    hand = Hand(strikes=0, rest_rad=0.0, press_rad=-0.1, grip=False)
    motion = ServoMotion(Simulation(hand=hand), PERIOD, 131072.0)
    for _ in range(20):
        motion.advance(-0.3, PERIOD)
    assert not motion.touching
    # The hand stayed behind, about where it rests; the handle is on its own.
    assert motion.position_rad < -0.1
    for _ in range(200):
        motion.advance(0.2, PERIOD)
    assert motion.touching
