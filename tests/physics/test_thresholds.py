"""Edge cases of comparisons: motion on the edge of sticking, and values that are not numbers."""

import math

from canwall.physics import advance, contact_end, make_plant


def test_rest_within_rounding_of_the_friction_threshold_ends() -> None:
    plant = make_plant(
        10.9064182984565, 0.0087085046152008, 0.00453528336843212, 0.11331287102665652
    )
    y = 24.984738950463772
    end = advance(plant[0], y, 0.0, 0.0, 0.0006300077454674222, 1.2363028175979935e-06)
    assert end[:2] == (y, 0.0)


def test_force_that_is_no_number_comes_through_at_rest() -> None:
    for plant in (make_plant(1.0), make_plant(1.0, wall_stiffness=3.0, coulomb=0.1)):
        y, v, _ = advance(plant[0], 0.1, 0.0, math.nan, 0.0, 1.0)
        assert math.isnan(y)
        assert math.isnan(v)


def test_contact_with_a_wall_without_spring() -> None:
    plant = make_plant(1.0, wall_damping=3.0)
    assert contact_end(plant[0], -0.1, -1.0, -2.0, 1.0) == (math.inf, 0.0)
    end, speed = contact_end(plant[0], -0.1, -1.0, 2.0, 1.0)
    # v = 2/3 − 5/3·e^(−3t), and its integral from −0.1 on is back at 0.
    assert math.isclose(speed, 2.0 / 3.0 - 5.0 / 3.0 * math.exp(-3.0 * end), rel_tol=1e-12)
    back = -0.1 + 2.0 / 3.0 * end - 5.0 / 9.0 * (1.0 - math.exp(-3.0 * end))
    assert math.isclose(back, 0.0, abs_tol=1e-12)
