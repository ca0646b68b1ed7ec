"""`[simulation]`: keys that depend on each other, and what an ideal drive is."""

from pathlib import Path

import pytest
from pydantic import ValidationError
from rig import SIM_CONFIG, settings_with

from canwall import config
from canwall.config import Hand, Mechanics, Settings, Simulation
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


def test_model_of_an_ideal_servo_has_no_shaft() -> None:
    shaft = {"mechanics.shaft_hz": 400.0, "mechanics.rotor_inertia_kg_m2": 1e-5}
    by_key = settings_with(shaft | {"simulation.ideal": True})
    by_method = settings_with(shaft | {"simulation.ideal": False}).with_ideal_servo()
    assert by_key.mechanics == by_method.mechanics
    assert by_key.mechanics.shaft_hz == 0.0


@pytest.mark.parametrize(
    ("drive", "simulation", "expected"),
    [
        ({}, {}, (131072, 0.637)),
        ({"counts_per_rev": 4096.0, "rated_torque_nm": 1.27}, {}, (4096, 1.27)),
        ({"counts_per_rev": 4096.0}, {"counts_per_rev": 1000}, (1000, 0.637)),
        ({"counts_per_rev": 2047.5}, {}, (131072, 0.637)),
    ],
)
def test_scales_of_the_master_are_those_of_the_simulated_drive(
    drive: dict[str, float], simulation: dict[str, float], expected: tuple[int, float]
) -> None:
    raw = settings_with().model_dump(mode="json", exclude_none=True)
    for key in ("counts_per_rev", "rated_torque_nm"):
        del raw["simulation"][key]
    raw["drive"] |= drive
    raw["simulation"] |= simulation
    found = Settings.model_validate(raw).simulation
    assert found is not None
    assert (found.counts_per_rev, found.rated_torque_nm) == expected


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
    for rotor, said in ((None, "it is missing"), (2e-4, "not 0.0002")):
        with pytest.raises(ValidationError, match=f"rotor_inertia_kg_m2: with shaft_hz .* {said}"):
            Mechanics(inertia_kg_m2=1e-4, shaft_hz=400.0, rotor_inertia_kg_m2=rotor)


def minimal(more: str = "") -> Settings:
    eds = SIM_CONFIG.parent.parent / "eds/canwall-drive.eds"
    text = f"""
        bus.cycle_s = 0.002
        drive = {{node_id = 5, eds = "{eds}"}}
        mechanics.inertia_kg_m2 = 1e-4
        limits.torque_nm = 1.9
        [simulation]
        {more}
    """
    return config.parse(text, Path("minimal.toml"))


@pytest.mark.parametrize(
    ("more", "first_s"),
    [
        ("", 1.9),
        ("real_time = true", 3.9),
        ("ideal = true", 0.2),
        ("hand.first_strike_s = 0.3", 0.3),
    ],
)
def test_first_strike_comes_after_the_measurement_of_the_delay(more: str, first_s: float) -> None:
    simulation = minimal(more).simulation
    assert simulation is not None
    assert simulation.hand.first_strike_s == pytest.approx(first_s)
