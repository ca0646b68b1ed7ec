"""`[simulation]`: keys that depend on each other, and what an ideal drive is."""

import pytest
from pydantic import ValidationError

from canwall.config import Hand, Simulation
from canwall.simdrive import make_servo

REAL = {
    "coulomb_nm": 0.02,
    "stiction_nm": 0.05,
    "current_bandwidth_hz": 1600.0,
    "torque_constant_error": 0.1,
    "drive_cycle_s": 0.00025,
    "shaft_hz": 400.0,
}


def test_ideal_is_one_thing_by_key_and_by_method() -> None:
    by_key = Simulation.model_validate(REAL | {"ideal": True})
    assert by_key == Simulation.model_validate(REAL).with_ideal_servo()
    (servo,) = make_servo(by_key, 131072.0)
    for name in ("lag_rate", "torque_step", "drive_cycle"):
        assert servo[name] == 0.0
    assert not servo["elastic"]
    assert servo["torque_gain"] == 1.0
    assert servo["handle"]["cogging"] == 0.0
    assert servo["handle"]["stiction"] == servo["handle"]["coulomb"] == 0.02
    assert Simulation.model_validate(by_key.model_dump()) == by_key


def test_stiction_goes_with_coulomb_where_it_is_not_given() -> None:
    assert Simulation(coulomb_nm=0.02).breakaway_nm == pytest.approx(0.03)
    assert Simulation(coulomb_nm=0.02, ideal=True).breakaway_nm == 0.02
    with pytest.raises(ValidationError, match=r"stiction_nm: has to be at least coulomb_nm, 0.02"):
        Simulation(coulomb_nm=0.02, stiction_nm=0.01)


def test_a_shaft_has_two_ends() -> None:
    with pytest.raises(ValidationError, match="rotor_inertia_kg_m2: has to be less than inertia"):
        Simulation(shaft_hz=400.0, rotor_inertia_kg_m2=2e-4)
    with pytest.raises(ValidationError, match="needs a rigid shaft, shaft_hz = 0"):
        Simulation(shaft_hz=400.0, hand=Hand(grip=False))
