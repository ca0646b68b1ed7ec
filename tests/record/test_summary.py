"""Summary of a record made by hand, against what was put into it."""

import math
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rig import settings_with

from canwall.record import ROW
from canwall.record.columns import Phase, record_batch
from canwall.record.summary import summarise
from canwall.units import DriveUnits

PERIOD_S, COUNT, STEP_NM, RADIUS_M = 0.001, 1e-6, 1e-6, 0.08
UNITS = DriveUnits(2.0 * math.pi / COUNT, 1000.0 * STEP_NM)
LAWS = ["standard", "midpoint", "half_sample+deadbeat"]
IN, DEEP, REST, OUT, END = 20, 60, 100, 900, 1000
DEPTH, FIRST_DEPTH, AMPLITUDE, FREQUENCY_HZ = 0.01, 0.04, 0.002, 25.0


def pressed() -> np.ndarray:
    """Positions of a handle that comes at 1 rad/s, presses at rest, and leaves at 0.5 rad/s."""
    j = np.arange(END)
    fall = (IN - j - 0.5) * PERIOD_S
    leave = (j - OUT + 0.5) * 0.5 * PERIOD_S
    dip = np.interp(j, [IN, DEEP, REST], [fall[IN], -FIRST_DEPTH, -DEPTH])
    return np.select([j < IN, j < REST, j < OUT], [fall, dip, -DEPTH], leave)


def chattering(frequency_hz: float = FREQUENCY_HZ) -> np.ndarray:
    """A sine of the amplitude and frequency of chatter while the handle is at rest."""
    j = np.arange(END)
    sine = np.sin(2.0 * math.pi * frequency_hz * PERIOD_S * (j - REST))
    return np.where((j >= REST) & (j < OUT), sine, 0.0)


def summary_of(y: np.ndarray, force: np.ndarray, **columns: Any) -> dict[str, Any]:
    """Summary of a run whose referent comes to rest where the handle does."""
    rows = np.zeros(len(y), ROW)
    rows["j"] = np.arange(len(y))
    rows["phase"], rows["y"], rows["force_applied"] = Phase.RENDERING, y, force
    rows["stiffness"] = rows["stiffness_in_force"] = 100.0
    for name, values in columns.items():
        rows[name] = values
    settings = settings_with({"mechanics.handle_radius_m": RADIUS_M})
    assert settings.bus.cycle_s == PERIOD_S
    table = pa.Table.from_batches([record_batch(rows, LAWS)])
    return summarise(table, settings, UNITS, pressed(), np.zeros(len(y)))


def test_laws_are_those_that_were_used_in_that_order() -> None:
    y = pressed()
    law = np.where(np.arange(END) < DEEP, 2, 0)
    assert summary_of(y, np.zeros(END), law=law)["law"] == ["half_sample+deadbeat", "standard"]


def test_chatter_is_that_of_the_settled_part() -> None:
    y = pressed() + AMPLITUDE * chattering()
    (strike,) = summary_of(y, np.where(y < 0.0, 1.0, 0.0))["strikes"]
    assert strike["chatter_by"] == "amplitude"
    assert strike["chatter_amplitude_rad"] == pytest.approx(AMPLITUDE)
    assert strike["chatter_frequency_hz"] == pytest.approx(FREQUENCY_HZ, rel=0.01)
