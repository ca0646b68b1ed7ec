"""Walls that change while they are rendered: bumpless, in turn, their law asked now and then."""

import numpy as np
import pytest
from numpy.typing import NDArray
from rig import Loop, RigFactory, settings_with
from test_step import Wall

from canwall.cycle import WallStage
from canwall.cycle.state import fade_in, fade_over, set_limits, set_wall, start_at
from canwall.record import Phase

PRESSING = 500


def held(wall: Wall, depth: int, cycles: int) -> NDArray[np.int64]:
    """Torques with the handle held still at a depth in mrad."""
    return np.array([wall.at(-depth) for _ in range(cycles)])


def softer(wall: Wall, **update: object) -> None:
    set_wall(wall.cycle, wall.settings.wall.model_copy(update=update), wall.laws)


# Bumpless


def test_wall_gives_way_linearly_to_the_next() -> None:
    wall = Wall()
    assert set(held(wall, 10, 5)) == {500}
    fade_over(wall.cycle, 9)
    softer(wall, stiffness_nm_per_rad=20.0)
    torques = held(wall, 10, 12)
    assert torques.tolist() == [*(500 - 30 * k for k in range(1, 10)), 200, 200, 200]


def test_wall_that_is_moved_onto_the_handle_comes_up_from_nothing() -> None:
    wall = Wall()
    start_at(wall.cycle, 5)
    for _ in range(3):
        assert wall.at(5) == 0
    fade_over(wall.cycle, 4)
    softer(wall, position_rad=0.015)
    assert [wall.at(5) for _ in range(6)] == [100, 200, 300, 400, 500, 500]


def test_nothing_fades_where_there_is_no_force() -> None:
    wall = Wall()
    start_at(wall.cycle, 5)
    wall.at(5)
    fade_over(wall.cycle, 1000)
    softer(wall, stiffness_nm_per_rad=20.0)
    wall.at(5)
    assert wall.cycle["fade_left"][0] == 0
    assert wall.at(-10) == 200


def test_wall_comes_up_around_a_handle_that_is_inside() -> None:
    wall = Wall()
    start_at(wall.cycle, -10)
    fade_in(wall.cycle, 4)
    assert held(wall, 10, 6).tolist() == [100, 200, 300, 400, 500, 500]


def test_fade_does_not_pull_when_the_handle_leaves() -> None:
    wall = Wall()
    held(wall, 10, 3)
    fade_over(wall.cycle, 50)
    softer(wall, stiffness_nm_per_rad=200.0, position_rad=-0.008)
    torques = [wall.at(counts) for counts in (-8, -6, -4, -2, 0, 1, 2)]
    assert min(torques) == 0
    assert torques[-2:] == [0, 0]


@pytest.mark.parametrize(
    "update",
    [
        {"stiffness_nm_per_rad": 20.0},
        {"law": "half_sample", "stiffness_nm_per_rad": 80.0},
        {"position_rad": -0.01},
    ],
)
def test_change_in_a_contact_is_bumpless_on_the_bus(
    make_rig: RigFactory, update: dict[str, object]
) -> None:
    # A soft, damped wall, so that the contact is at rest when it changes.
    calm = {
        "wall.law": "mean_force",
        "wall.stiffness_nm_per_rad": 30.0,
        "simulation.ideal": True,
    }
    rig = make_rig(settings_with(calm))
    loop = Loop(rig)
    wall = rig.settings.wall.model_copy(update=update)
    loop.run(PRESSING + 150, changes=[WallStage(PRESSING, wall, rig.settings.limits)])
    rows = loop.rows()
    torque = rows["torque_cmd_per_mille"]
    before = np.abs(np.diff(torque[PRESSING - 50 : PRESSING])).max()
    around = np.abs(np.diff(torque[PRESSING - 2 : PRESSING + 60])).max()
    assert around <= max(3 * before, 25)
    assert rows["stiffness"][PRESSING] == wall.stiffness_nm_per_rad


def test_changes_wait_for_the_one_before(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"wall.law": "mean_force", "run.blend_s": 0.05}))
    loop = Loop(rig)
    wall, limits = rig.settings.wall, rig.settings.limits
    loop.run(
        PRESSING + 200,
        changes=[
            WallStage(PRESSING, wall.model_copy(update={"stiffness_nm_per_rad": 60.0}), limits),
            WallStage(
                PRESSING + 10, wall.model_copy(update={"stiffness_nm_per_rad": 70.0}), limits
            ),
        ],
    )
    stiffness = loop.rows()["stiffness"]
    assert np.flatnonzero(np.diff(stiffness)).tolist() == [PRESSING - 1, PRESSING + 49]


def test_limits_change_at_their_cycle() -> None:
    wall = Wall()
    assert set(held(wall, 13, 3)) == {650}
    limits = wall.settings.limits.model_copy(update={"torque_nm": 0.4})
    set_limits(wall.cycle, limits)
    assert set(held(wall, 13, 3)) == {400}


def test_torque_rate_is_held_to_its_limit() -> None:
    wall = Wall({"limits.torque_rate_nm_per_s": 100.0})  # 0.1 N·m a cycle
    assert held(wall, 10, 7).tolist() == [100, 200, 300, 400, 500, 500, 500]
    assert [wall.at(0) for _ in range(6)] == [400, 300, 200, 100, 0, 0]


# The law asked every n-th cycle, recorded in every one


def test_law_is_asked_every_nth_cycle() -> None:
    wall = Wall({"wall.divider": 4})
    torques = [wall.at(-counts) for counts in range(1, 13)]
    assert torques == [50] * 4 + [250] * 4 + [450] * 4
    assert wall.row["y"][0] == pytest.approx(-0.012)


def test_velocity_of_a_divided_law_is_over_its_own_period() -> None:
    overrides = {"wall.law": "damped", "wall.damping_nm_s_per_rad": 0.2, "wall.divider": 2}
    wall = Wall(overrides)
    start_at(wall.cycle, 0)
    # 3 counts a cycle: 3 rad/s, whatever the law's period.
    torques = [wall.at(-3 * k) for k in range(1, 8)]
    assert torques[2] == 50 * 9 + 200 * 3


def test_divided_law_plans_for_its_own_period() -> None:
    wall = Wall({"wall.law": "half_sample", "wall.divider": 10})
    assert wall.cycle["rendered"]["wall"]["period"][0, 0] == pytest.approx(0.010)
    softer(wall, law="half_sample", divider=1)
    assert wall.cycle["rendered"]["wall"]["period"][0, 0] == pytest.approx(0.001)


@pytest.mark.slow
def test_divided_wall_is_worse_than_the_full_one(make_rig: RigFactory) -> None:
    """The chapter's experiment: the law at a fraction of the rate, data at the full one."""
    reach = {}
    for divider in (1, 5):
        rig = make_rig(settings_with({"wall.law": "half_sample", "wall.divider": divider}))
        loop = Loop(rig)
        loop.run(900)
        rows = loop.rows()
        rows = rows[rows["phase"] == Phase.RENDERING]
        changes = rows["j"][1:][np.diff(rows["force"]) != 0.0]
        assert len(set((changes % divider).tolist())) == 1
        reach[divider] = np.ptp(rows["y"][(rows["j"] >= 600) & (rows["j"] < 780)])
    assert reach[1] < reach[5]


# Laws in turn


def test_laws_alternate_from_strike_to_strike(make_rig: RigFactory) -> None:
    settings = settings_with()
    turns = {"law": "standard", "alternate": ("half_sample", "midpoint")}
    wall = settings.wall.model_copy(update=turns)
    loop = Loop(make_rig(settings.model_copy(update={"wall": wall, "schedule": ()})))
    loop.run(4200)
    rows = loop.rows()
    rows = rows[rows["phase"] == Phase.RENDERING]
    names = [law.name for law in loop.laws]
    laws = [names[law] for law in rows["law"]]
    starts = [0, *(np.flatnonzero(np.diff(rows["law"])) + 1).tolist()]
    assert [laws[start] for start in starts] == [
        "standard",
        "half_sample",
        "midpoint",
        "standard",
        "half_sample",
    ]
    # Never while the handle is at the wall.
    assert all((rows["y"][start - 100 : start] > 0.0).all() for start in starts[1:])
