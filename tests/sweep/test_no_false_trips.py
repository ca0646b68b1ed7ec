"""No false trips: strikes on a faultless drive end without a trip, at slow and fast rates."""

import pytest
from rig import settings_with

from canwall.cycle import Trip
from canwall.sweep import make_plan
from canwall.sweep.plan import compute_piece


@pytest.mark.slow
@pytest.mark.parametrize("operator", ["none", "finger"])
@pytest.mark.parametrize("law", ["mean_force", "half_sample"])
def test_handle_that_friction_stops_is_no_stuck_encoder(law: str, operator: str) -> None:
    """At a hundred hertz it is at rest from one sample to the next, whatever it did before."""
    plan = make_plan(
        settings_with(),
        {
            "law": [law],
            "operator": [operator],
            "damping": "0",
            "rate": "100,125,150,200,400,1000",
            "stiffness": "0.5:50:16",
            "speed": "0.5,1,2,4",
        },
    )
    for piece in range(plan.pieces):
        assert Trip.STUCK not in compute_piece(plan, piece)["trip"]
