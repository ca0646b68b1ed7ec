"""The probe that shows who is at the handle before a contact."""

import numpy as np
import pytest
from numpy.typing import NDArray

from canwall.walls import MAX_DELAY, WALL
from canwall.walls.probe import (
    PROBE,
    is_probe_in_flight,
    other_torque_acts,
    probe_torque,
    reset_probe,
    send_probe,
    set_probe,
)

PERIOD, COUNT, LIGHTEST = 1e-3, 4.8e-5, 1e-4


def made(slower: int = 1) -> NDArray[np.void]:
    probe = np.zeros(1, PROBE)
    set_probe(probe[0], LIGHTEST, PERIOD, COUNT, slower)
    reset_probe(probe[0])
    return probe


def test_probe_is_shortly_before_a_contact_only() -> None:
    probe, wall = made(), np.zeros(1, WALL)

    def probed(y: float, v: float) -> float:
        wall["y"], wall["v"] = y, v
        comes = v <= -1.5 * COUNT / PERIOD
        return float(probe_torque(probe[0], wall[0], PERIOD * v, comes, LIGHTEST, True))

    assert probed(0.05, -0.5) == 0.0  # 100 ms away
    assert probed(0.01, 0.5) == 0.0  # on its way out
    assert probed(0.01, -0.05) == 0.0  # so slow that friction is not behind
    torques = [probed(0.02 - 0.0005 * j, -0.5) for j in range(40)]
    amplitude = 4.0 * COUNT * LIGHTEST / (2.0 * PERIOD) ** 2
    np.testing.assert_allclose(np.abs(torques), amplitude)
    # Four samples to and four fro: the lightest handle swings by four counts about its path.
    assert np.sign(torques[:14]).tolist() == [1, 1] + 4 * [-1] + 4 * [1] + 4 * [-1]
    v = np.cumsum(torques[:32]) * PERIOD / LIGHTEST
    y = np.cumsum(v) * PERIOD
    drift = np.polynomial.Polynomial.fit(np.arange(32), y, 1)(np.arange(32))
    assert np.ptp(y - drift) == pytest.approx(4.0 * COUNT, rel=0.35)


def test_probe_of_a_stranger_grows_with_its_speed() -> None:
    """It moves the lightest handle by a third of its way, with 0.04 N·m at the most."""
    for counts, known, stronger in (
        (2.0, False, 1.0),
        (12.0, False, 4.0),
        (12.0, True, 1.0),
        (90.0, False, 0.04 / 0.0048),
    ):
        probe, wall = made(), np.zeros(1, WALL)
        wall["y"], wall["v"] = 0.0005, -counts * COUNT / PERIOD
        going = -counts * COUNT, True, LIGHTEST, known
        torques = [probe_torque(probe[0], wall[0], *going) for _ in range(8)]
        np.testing.assert_allclose(np.abs(torques), stronger * 0.0048)


@pytest.mark.parametrize(("heavier", "stronger"), [(0.5, 1.0), (3.0, 3.0), (36.0, 0.04 / 0.0048)])
def test_probe_is_as_strong_as_the_mass_that_is_found_wants(
    heavier: float, stronger: float
) -> None:
    """It moves nobody by more, and pushes with 0.04 N·m at the most; it stays about the path."""
    probe, wall = made(), np.zeros(1, WALL)
    wall["y"], wall["v"] = 0.01, -0.5
    torques = np.empty(40)
    for j in range(len(torques)):
        found = LIGHTEST if j < 6 else heavier * LIGHTEST
        torques[j] = probe_torque(probe[0], wall[0], -0.5 * PERIOD, True, found, True)
    np.testing.assert_allclose(np.abs(torques[:8]), 0.0048)
    np.testing.assert_allclose(np.abs(torques[8:]), stronger * 0.0048)
    v = np.cumsum(torques) * PERIOD
    assert np.ptp(v[8:]) == pytest.approx(4.0 * PERIOD * stronger * 0.0048)
    assert np.max(v[8:]) == pytest.approx(-np.min(v[8:]))


def test_probe_for_a_slower_observer_lasts_longer_and_moves_the_handle_by_more() -> None:
    usual, slow = made(), made(2)
    assert slow["half"][0] == 2 * usual["half"][0]
    # Twice the way in twice the time: half the torque.
    assert slow["torque"][0] == pytest.approx(0.5 * usual["torque"][0])


def test_probe_behind_a_shaft_does_not_follow_its_swing() -> None:
    """A velocity that comes and goes with the shaft ends no probe; new ones would push again."""
    torques = {}
    for slower in (1, 2):
        probe, wall = made(slower), np.zeros(1, WALL)
        wall["y"] = 0.01
        torques[slower] = np.zeros(60)
        for j in range(60):
            wall["v"] = -0.5 if j % 4 < 2 else 0.3
            going = float(wall["v"][0]) * PERIOD, j % 4 < 2, LIGHTEST, True
            torques[slower][j] = probe_torque(probe[0], wall[0], *going)
        wall["y"] = -1e-4
        assert probe_torque(probe[0], wall[0], -0.5 * PERIOD, True, LIGHTEST, True) == 0.0
    assert np.sign(torques[1][:8]).tolist() == [1, 1, 0, 0] * 2
    assert np.sign(torques[2][:20]).tolist() == 4 * [1] + 8 * [-1] + 8 * [1]
    assert np.all(torques[2] != 0.0)


def test_torques_of_probes_are_told_from_the_wall_s() -> None:
    probe, wall = made(), np.zeros(1, WALL)
    wall["y"], wall["v"] = 0.01, -0.5
    in_flight = np.zeros(len(probe["in_flight"][0]))
    for sent in (0.0, 0.2, None, None, 0.0, 0.0, 0.0):
        force = sent
        if sent is None:
            force = probe_torque(probe[0], wall[0], -0.5 * PERIOD, True, LIGHTEST, True)
        assert force is not None
        send_probe(probe[0], force)
        in_flight[1:] = in_flight[:-1].copy()
        in_flight[0] = force
        assert not probe["acts"][0]
        expected = in_flight * (np.abs(in_flight) < 0.1)
        np.testing.assert_array_equal(probe["in_flight"][0], expected)
        assert is_probe_in_flight(probe[0]) == np.any(expected)
        for delay in (0, 1, 2):
            acts = np.any(in_flight[delay : MAX_DELAY + 1] >= 0.1)
            assert other_torque_acts(probe[0], in_flight, delay) == acts
