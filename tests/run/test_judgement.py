"""Judgement of a run by what is felt: the estimate from the torque beside the force itself."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rig import settings_with

from canwall.analysis.felt import band_rms, felt_band
from canwall.config import Settings
from canwall.record import ROW
from canwall.record.columns import record_batch
from canwall.run.closed_loop import ClosedLoop, simulate_loop
from canwall.run.result import judged
from canwall.sweep.axes import settings_at


def strike(operator: str, stiffness: float) -> tuple[pa.Table, Settings, Any, float]:
    """Record, settings, units and felt force [N r.m.s.] of one strike with half_sample."""
    base = settings_with({"wall.law": "half_sample", "wall.stiffness_nm_per_rad": stiffness})
    axes = {"operator": operator, "speed": 1.0, "phase": 0.0, "servo": "ideal"}
    settings = settings_at(base, axes)
    assert settings.run.duration_s is not None
    cycles = round(settings.run.duration_s / settings.bus.cycle_s)
    loop, rows, signals = ClosedLoop(settings, cycles), np.zeros(cycles, ROW), np.empty((4, cycles))
    assert simulate_loop(loop.records(), rows, signals) == cycles
    pressing = signals[3, 350:640]
    felt = band_rms(felt_band(settings.bus.cycle_s), pressing, 200, len(pressing)) / 0.08
    table = pa.Table.from_batches([record_batch(rows, ["half_sample"])])
    return table, settings, loop.units, felt


@pytest.mark.parametrize(("operator", "share"), [("grip", 3.2 / 4.2), ("finger", 0.64 / 1.64)])
def test_a_run_that_buzzes_is_judged_by_its_torque(operator: str, share: float) -> None:
    table, settings, units, felt = strike(operator, 900.0 if operator == "grip" else 280.0)
    (judgement,) = judged(table, settings, units)["strikes"]
    assert felt > 0.1
    assert judgement["chatter"]
    # The hand feels its share of the inertia, more by its damping, and less by friction.
    assert 0.8 * share < felt / judgement["felt_ripple_n"] < 1.3 * share
    # A person's hand has no referent.
    person = settings.model_copy(update={"simulation": None})
    (judgement,) = judged(table, person, units)["strikes"]
    assert judgement["chatter"]
    assert judgement["referent_first_depth_rad"] is None
    # Its bounces at first are counted without those of a referent.
    assert judgement["chatter_by"] == ("counts" if operator == "grip" else "ripple")
    if operator == "finger":
        assert "estimated from the torque" in judgement["chatter_reason"]


@pytest.mark.parametrize("operator", ["none", "finger", "grip"])
def test_a_quiet_run_is_quiet_with_and_without_a_referent(operator: str) -> None:
    table, settings, units, felt = strike(operator, 10.0)
    assert felt < 0.01
    person = settings.model_copy(update={"simulation": None})
    # Without an operator the handle bounces, as its referent does.
    for known in (settings,) if operator == "none" else (settings, person):
        (judgement,) = judged(table, known, units)["strikes"]
        assert not judgement["chatter"], judgement["chatter_reason"]
        assert judgement["felt_ripple_n"] < 0.05
    (judgement,) = judged(table, settings, units)["strikes"]
    assert judgement["first_depth_rad"] < 1.8 * judgement["referent_first_depth_rad"]
    assert judgement["restitution"] is None or judgement["restitution"] < 1.0
