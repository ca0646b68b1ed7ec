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
IN, DEEP, REST, OUT, END = 20, 60, 100, 900, 1000
DEPTH, FIRST_DEPTH, AMPLITUDE, FREQUENCY_HZ = 0.01, 0.04, 0.002, 25.0


def pressed() -> np.ndarray:
    """Positions of a handle that comes at 1 rad/s, presses at rest, and leaves at 0.5 rad/s."""
    j = np.arange(END)
    fall = (IN - j - 0.5) * PERIOD_S
    leave = (j - OUT + 0.5) * 0.5 * PERIOD_S
    dip = np.interp(j, [IN, DEEP, REST], [fall[IN], -FIRST_DEPTH, -DEPTH])
    return np.select([j < IN, j < REST, j < OUT - 1], [fall, dip, -DEPTH], leave)


def chattering(frequency_hz: float = FREQUENCY_HZ) -> np.ndarray:
    """A sine of the amplitude and frequency of chatter while the handle is at rest."""
    j = np.arange(END)
    sine = np.sin(2.0 * math.pi * frequency_hz * PERIOD_S * (j - REST))
    return np.where((j >= REST) & (j < OUT), sine, 0.0)


def summary_of(
    y: np.ndarray,
    force: np.ndarray,
    laws: tuple[str, ...] = ("standard",),
    thrown: bool = False,
    known: bool = True,
    referent: np.ndarray | None = None,
    referent_felt: np.ndarray | None = None,
    **columns: Any,
) -> dict[str, Any]:
    """Summary of a run whose referent, if known, comes to rest where the handle does."""
    rows = np.zeros(len(y), ROW)
    rows["j"] = np.arange(len(y))
    rows["phase"], rows["y"], rows["force_applied"] = Phase.RENDERING, y, force
    rows["stiffness"] = rows["stiffness_in_force"] = 100.0
    for name, values in columns.items():
        rows[name] = values
    settings = settings_with({"mechanics.handle_radius_m": RADIUS_M})
    assert settings.bus.cycle_s == PERIOD_S
    table = pa.Table.from_batches([record_batch(rows, laws)])
    if not known:
        return summarise(table, settings, UNITS, None, None, thrown)
    referent = pressed() if referent is None else referent
    referent_felt = np.zeros(len(y)) if referent_felt is None else referent_felt
    return summarise(table, settings, UNITS, referent, referent_felt, thrown)


def test_chatter_is_that_of_the_settled_part() -> None:
    y = pressed() + AMPLITUDE * chattering()
    (strike,) = summary_of(y, np.where(y < 0.0, 1.0, 0.0))["strikes"]
    assert strike["chatter_by"] == "amplitude"
    assert strike["chatter_amplitude_rad"] == pytest.approx(AMPLITUDE)
    assert strike["chatter_frequency_hz"] == pytest.approx(FREQUENCY_HZ, rel=0.01)


def test_chatter_of_a_contact_that_does_not_settle_is_that_of_its_makes_and_breaks() -> None:
    """The time between two bursts is no part of the oscillation."""
    y = pressed()
    for burst in (REST + 200, OUT - 300):
        y[burst : burst + 100 : 20] = 5.0 * COUNT
    (strike,) = summary_of(y, np.where(y < 0.0, 1.0, 0.0), known=False)["strikes"]
    assert (strike["chatter_by"], strike["contacts"]) == ("counts", 11)
    assert strike["chatter_frequency_hz"] == 25.0


def test_laws_are_those_that_were_in_force() -> None:
    """Laws that take turns or come by a request are not in the configuration's stages."""
    y, j = pressed(), np.arange(END)
    laws = ("unused", "damped", "standard")
    found = summary_of(y, np.zeros(END), laws, law=np.where(j < DEEP, 2, 1))
    assert found["law"] == ["standard", "damped"]


def test_a_wall_that_moves_is_no_motion_of_the_handle() -> None:
    handle, j = pressed(), np.arange(END)
    position = np.where(j < REST + 100, 0.0, 0.003)
    y = handle - position
    force = np.where(y < 0.0, 2.0, 0.0)
    found = summary_of(y, force, wall_position_rad=position)
    (strike,) = found["strikes"]
    last = np.flatnonzero(force)[-1]
    assert strike["energy_out_j"] == pytest.approx(2.0 * (handle[last + 1] - handle[IN]))
    assert found["energy_per_contact_j"] == [strike["energy_out_j"]]


@pytest.mark.parametrize(("more", "chatters"), [(1, False), (2, True)])
def test_bounces_of_a_wall_that_acts_ahead_are_compared_from_outside(
    more: int, chatters: bool
) -> None:
    """The referent is inside when the strike begins and when it ends, and has made contact too."""
    y, j, out = pressed(), np.arange(END), OUT - 100
    y[IN : IN + 3] = 5.0 * COUNT
    for k in range(more):
        y[j // 10 == DEEP // 10 + 2 * k] = 5.0 * COUNT
    y[out:] = 0.05
    (strike,) = summary_of(y, np.where((j >= IN) & (j < out), 1.0, 0.0))["strikes"]
    assert strike["start_s"] == IN * PERIOD_S
    assert (strike["chatter_by"] == "counts") is chatters
    if chatters:
        assert strike["chatter_reason"] == "5 makes and breaks within 200 ms, the referent 1"


def test_every_measure_of_a_press() -> None:
    y, j = pressed(), np.arange(END)
    columns = ("stiffness_in_force", "mass_est", "mass_spread", "delay_est")
    force = np.where(y < 0.0, 2.0, 0.0)
    force[OUT] = -0.5  # held for a cycle more, it takes back some energy
    found = summary_of(
        y, force, torque_cmd=-3.0 * (j == 5), **{n: 1.0 + j + k for k, n in enumerate(columns)}
    )
    (strike,) = found["strikes"]
    known_best = IN + (OUT + 1 - IN) * 9 // 10 - 1
    most = 2.0 * (y[OUT] - y[IN])  # the handle leaves farther out than it came in
    end = most - 0.5 * (y[OUT + 1] - y[OUT])
    expected = {
        "start_s": IN * PERIOD_S,
        "end_s": (OUT + 2) * PERIOD_S,
        "law": "standard",
        "stiffness": 100.0,
        "contacts": 1,
        "peak_penetration_rad": FIRST_DEPTH,
        "first_depth_rad": FIRST_DEPTH,
        "referent_first_depth_rad": FIRST_DEPTH,
        "restitution": 0.5,
        "peak_force_nm": 2.0,
        "energy_out_j": end,
        "energy_out_max_j": most,
        "chatter": False,
        "chatter_by": "",
        "chatter_amplitude_rad": 0.0,
        "chatter_frequency_hz": 0.0,
        "felt_ripple_n": 0.0,
        "stiffness_in_force": 1.0 + known_best,
        "stiffness_in_force_least": 1.0 + IN,
        "mass_est_kg_m2": 2.0 + known_best,
        "mass_spread": 3.0 + known_best,
        "delay_est_cycles": 4.0 + known_best,
    }
    assert {key: strike[key] for key in expected} == pytest.approx(expected, abs=1e-9)
    assert set(strike) - set(expected) == {"chatter_reason"}
    assert found["energy_out_max_j"] == pytest.approx(most)
    assert found["energy_per_contact_j"] == pytest.approx([end])
    assert (found["contacts"], found["cycles"], found["peak_torque"]) == (1, END, 3.0)
    assert (found["chatter"], found["chatter_reason"]) == (False, "")


def test_energy_is_counted_from_the_beginning_of_a_strike() -> None:
    """Two strikes; the second is the first one with half the force."""
    y = np.concatenate([pressed(), pressed()])
    y[END : END + IN] = 0.05  # apart by more than 200 ms: the first leaves at 0.05 rad
    y = np.insert(y, END, np.full(200, 0.05))
    half = np.arange(len(y)) >= END
    force = np.where(y < 0.0, np.where(half, 1.0, 2.0), 0.0)
    found = summary_of(y, force, known=False)
    way = y[OUT] - y[IN]
    energy = [strike["energy_out_j"] for strike in found["strikes"]]
    assert energy == pytest.approx([2.0 * way, way])
    assert found["energy_per_contact_j"] == pytest.approx(energy)
    assert found["energy_out_max_j"] == pytest.approx(3.0 * way)


@pytest.mark.parametrize("known", [True, False])
def test_ripple_of_a_sine_is_its_amplitude_over_the_root_of_two(known: bool) -> None:
    amplitude_nm, frequency_hz = 0.04, 100.0
    y = pressed()
    force = np.where(y < 0.0, 1.0, 0.0) + amplitude_nm * chattering(frequency_hz)
    found = summary_of(y, force, known=known)
    (strike,) = found["strikes"]
    gain = 1.0 / math.sqrt(1.0 + (20.0 / frequency_hz) ** 4)
    felt = gain * amplitude_nm / math.sqrt(2.0) / RADIUS_M
    assert strike["felt_ripple_n"] == pytest.approx(felt, rel=1e-3)
    assert (found["chatter"], strike["chatter_by"]) == (True, "ripple")
    assert found["chatter_reason"] == strike["chatter_reason"]
    assert "estimated from the torque" in strike["chatter_reason"]
    assert strike["chatter_frequency_hz"] == pytest.approx(frequency_hz, rel=0.01)
    assert (strike["chatter_amplitude_rad"] == 0.0) is known  # of the settled part alone


def test_ripple_of_the_referent_itself_is_no_chatter() -> None:
    y, ripple = pressed(), 0.04 * chattering(100.0)
    found = summary_of(y, np.where(y < 0.0, 1.0, 0.0) + ripple, referent_felt=0.9 * ripple)
    assert found["strikes"][0]["felt_ripple_n"] > 0.1
    assert not found["chatter"]


@pytest.mark.parametrize("force_nm", [0.0, 2.0])
def test_bounces_of_a_wall_that_gives_no_energy_are_compared_relatively(force_nm: float) -> None:
    def bouncing(times: int) -> np.ndarray:
        y, j = pressed(), np.arange(END)
        out = (j >= DEEP) & (j < DEEP + 10 * times) & (j // 5 % 2 == 0)
        return np.where(out, 0.01, y)

    y = bouncing(10)
    force = np.where((y < 0.0) & (np.arange(END) >= REST + 100), force_nm, 0.0)
    (strike,) = summary_of(y, force, referent=bouncing(8))["strikes"]
    assert strike["chatter"] is (force_nm > 0.0)
    if force_nm:
        assert strike["chatter_reason"] == "21 makes and breaks within 200 ms, the referent 17"


@pytest.mark.parametrize(("length_s", "judged"), [(0.199, False), (0.2, True)])
def test_ripple_without_a_referent_needs_a_long_contact(length_s: float, judged: bool) -> None:
    y = np.full(END, 0.01)
    y[IN : IN + round(length_s / PERIOD_S) - 1] = -DEPTH  # and the first cycle after it
    (strike,) = summary_of(y, np.where(y < 0.0, 1.0, 0.0), known=False)["strikes"]
    assert (strike["felt_ripple_n"] is not None) is judged


def test_a_handle_is_thrown_by_the_last_strike() -> None:
    y = np.insert(np.concatenate([pressed(), pressed()[IN - 10 :]]), END, np.full(200, 0.05))
    force = np.where(y < 0.0, 1.0, 0.0)
    first, last = summary_of(y, force, thrown=True, known=False)["strikes"]
    assert (first["chatter_by"], last["chatter_by"]) == ("", "limits")
    assert last["chatter_amplitude_rad"] == pytest.approx(0.5 * np.ptp(pressed()[IN : OUT + 1]))
