"""Contacts in rows made by hand."""

import numpy as np
import pytest

from canwall.panel.contacts import Contact, ContactMeter, Scale
from canwall.record import ROW, Phase


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_wall_that_moves_is_no_motion_of_the_handle(side: float) -> None:
    handle = np.array([0.5, -0.2, -1.0, -1.0, -0.4, 0.5, 1.0])
    moved = np.array([0.0, 0.0, 0.0, 0.3, 0.3, 0.3, 0.3])
    rows = np.zeros(len(handle), ROW)
    rows["j"], rows["phase"], rows["y"] = np.arange(len(rows)), Phase.RENDERING, handle - moved
    rows["wall_position_rad"] = side * moved
    rows["force_applied"][1:5] = 2.0
    meter = ContactMeter(Scale(1e-3, 1e-6, orientation=side))
    # The rows come in two parts, one of which ends in contact.
    (contact,) = [s.ended for part in (rows[:3], rows[3:]) for s in meter.take(part) if s.ended]
    assert isinstance(contact, Contact)
    assert contact.energy_j == pytest.approx(2.0 * (0.5 + 0.2))
    assert not contact.passive
    assert (contact.depth_rad, contact.peak_force_nm) == (1.3, 2.0)


def test_wall_that_fades_in_around_the_handle_is_no_contact() -> None:
    y = np.array([-1.0, -1.0, -2.0, -0.5, 0.5, 0.5, -1.0, -1.0, 0.5, 0.5])
    rows = np.zeros(len(y), ROW)
    rows["j"], rows["y"] = np.arange(len(rows)), y
    rows["force_applied"][2:], rows["phase"][2:] = np.maximum(-y[2:], 0.0), Phase.RENDERING
    meter = ContactMeter(Scale(1e-3, 1e-6))
    (contact,) = [s.ended for part in (rows[:3], rows[3:]) for s in meter.take(part) if s.ended]
    assert (contact.n, contact.depth_rad) == (1, 1.0)


def test_a_strike_is_known_by_the_cycle_in_which_it_began() -> None:
    y = np.ones(700)
    y[100:150] = y[200:250] = y[500:510] = -1.0
    rows = np.zeros(len(y), ROW)
    rows["j"], rows["phase"], rows["y"] = np.arange(len(rows)), Phase.RENDERING, y
    rows["t_s"] = 1e-3 * rows["j"]
    meter = ContactMeter(Scale(1e-3, 1e-6))
    ended = []
    for part in np.split(rows, 14):
        for _ in meter.take(part):
            pass
        ended.append(meter.strike_ended())
    assert [began for began in ended if began is not None] == [100]
