"""The closed loop in memory and through the bus: the same bits, whoever carries them."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rig import Loop, RigFactory, settings_with

from canwall.config import ConfigError, Settings
from canwall.record import ROW, TIMING_COLUMNS, Phase
from canwall.run.closed_loop import ENABLING_CYCLES, simulate
from canwall.walls import DEADBEAT, LAWS

CYCLES = 4_000
#: Columns that only a run on the bus has: words of the state machine, and timing.
BESIDES = {"statusword", "controlword", "phase", *TIMING_COLUMNS}


def strikes(overrides: dict[str, Any]) -> Settings:
    """The hand of config/sim.toml strikes a wall that stays as it is."""
    settings = settings_with(overrides)
    assert settings.simulation is not None
    hand = settings.simulation.hand.model_copy(update={"strikes": 4})
    simulation = settings.simulation.model_copy(update={"hand": hand})
    return settings.model_copy(update={"simulation": simulation, "schedule": ()})


def through_the_bus(make_rig: RigFactory, settings: Settings, cycles: int) -> NDArray[np.void]:
    loop = Loop(make_rig(settings))
    rows = []

    def collect(j: int) -> bool:
        if j % 1000 == 0:
            rows.append(loop.rows())
            loop.rig.frames.clear()
        return False

    loop.run(cycles, collect)
    rows.append(loop.rows())
    found = np.concatenate(rows)
    return found[found["phase"] != Phase.LEAVING]


def assert_same(bus: NDArray[np.void], memory: NDArray[np.void]) -> None:
    assert len(bus) == len(memory)
    # The very first cycle on a bus does not know yet where the handle is.
    for name in [name for name in ROW.names or () if name not in BESIDES]:
        differs = np.flatnonzero(bus[name][1:] != memory[name][1:])
        assert not len(differs), f"{name} from cycle {differs[0] + 1} on"


@pytest.mark.parametrize("law", ["energy_bounding", "virtual_coupling"])
def test_hand_that_is_identified_adds_no_damping_to_the_device(law: str) -> None:
    viscous = 0.01
    keys = {f"{section}.viscous_nm_s_per_rad": viscous for section in ("mechanics", "simulation")}
    keys |= {"wall.law": law, "wall.stiffness_nm_per_rad": 200.0}
    settings = strikes(keys | {"operator.adapt": True, "mechanics.inertia_kg_m2": 1e-4})
    rows = simulate(settings, 1_500).rows
    assert rows["mass_est"].max() > 1.5e-4
    deep = rows[rows["y"] < -0.01]
    # The stiffest passive coupling, and some more for what a wall's own damper adds.
    assert np.all(deep["force"] < 1.2 * 0.8 * viscous / settings.bus.cycle_s * -deep["y"])


def test_stiffness_in_force_follows_the_mass_when_the_law_is_evaluated() -> None:
    """Between two evaluations no torque changes that a rise could be paid with."""
    keys = {"wall.divider": 4, "wall.cap": 0.8, "wall.stiffness_nm_per_rad": 2000.0}
    keys |= {"operator.adapt": True, "mechanics.inertia_kg_m2": 1e-4}
    rows = simulate(strikes(keys), 1_500).rows[200:]  # faded in
    changes = rows["j"][1:][np.diff(rows["stiffness_in_force"]) != 0.0]
    assert len(changes) > 5
    assert len(set((changes % 4).tolist())) == 1


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_every_law_comes_to_the_same_bits(make_rig: RigFactory, law: str) -> None:
    name, deadbeat = law.removesuffix(DEADBEAT), law.endswith(DEADBEAT)
    settings = strikes(
        {
            "wall.law": name,
            "wall.deadbeat": deadbeat,
            "wall.damping_nm_s_per_rad": 0.01,
            "limits.speed_rad_s": 1000.0,
        }
    )
    memory = simulate(settings, CYCLES)
    bus = through_the_bus(make_rig, settings, CYCLES)
    assert np.flatnonzero(bus["phase"] == Phase.RENDERING)[0] == ENABLING_CYCLES
    assert len(np.unique(bus["torque_cmd_per_mille"])) > 20
    assert_same(bus, memory.rows)


VARIANTS: list[dict[str, Any]] = [
    {"wall.side": "above", "wall.position_rad": 0.2},
    {"wall.divider": 5, "wall.stiffness_nm_per_rad": 5.0},
    {"bus.cycle_s": 0.00025},
    {"simulation.torque_delay_cycles": 0.35},
    {"simulation.torque_delay_cycles": 1.0},
    {"simulation.torque_delay_cycles": 1.6},
    {"drive.torque_pdo": "immediate", "estimator.delay_cycles": 0.0},
    {"drive.torque_pdo": "immediate", "simulation.torque_delay_cycles": 0.4},
    {"simulation.cogging_nm": 0.0, "simulation.torque_step_nm": 0.0},
    {"limits.torque_rate_nm_per_s": 50.0},
    {"wall.position_rad": 0.12, "run.ramp_in_s": 0.1},
    {"estimator.delay_cycles": 1.3},
    {"simulation.current_bandwidth_hz": 1600.0},
    {
        "simulation.current_bandwidth_hz": 1600.0,
        "simulation.drive_cycle_s": 0.00025,
        "simulation.clock_ppm": 50.0,
        "simulation.torque_constant_error": 0.05,
        "simulation.torque_delay_cycles": 0.4,
    },
    {"simulation.drive_cycle_s": 0.0015, "simulation.clock_ppm": -300.0},
    {"simulation.shaft_hz": 300.0, "simulation.drive_cycle_s": 0.00025},
]


@pytest.mark.slow
@pytest.mark.parametrize("overrides", VARIANTS, ids=lambda overrides: ", ".join(overrides))
def test_every_setting_comes_to_the_same_bits(
    make_rig: RigFactory, overrides: dict[str, Any]
) -> None:
    delay = {"estimator.delay_cycles": 1.0, "limits.speed_rad_s": 1000.0, "wall.law": "mean_force"}
    settings = strikes(delay | overrides)
    memory = simulate(settings, 2000)
    assert_same(through_the_bus(make_rig, settings, 2000), memory.rows)


@pytest.mark.slow
def test_hand_that_loses_the_handle_comes_to_the_same_bits(make_rig: RigFactory) -> None:
    settings = strikes({"wall.law": "half_sample", "limits.speed_rad_s": 1000.0})
    assert settings.simulation is not None
    hand = settings.simulation.hand.model_copy(update={"grip": False})
    simulation = settings.simulation.model_copy(update={"hand": hand})
    settings = settings.model_copy(update={"simulation": simulation})
    memory = simulate(settings, 2000)
    assert_same(through_the_bus(make_rig, settings, 2000), memory.rows)


def test_trip_ends_both_in_the_same_cycle(make_rig: RigFactory) -> None:
    settings = strikes({"wall.law": "standard", "limits.speed_rad_s": 4.0})
    memory = simulate(settings, 2000)
    bus = through_the_bus(make_rig, settings, 2000)
    assert memory.trip.name == "SPEED"
    assert len(memory.rows) < 2000
    assert_same(bus, memory.rows)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({}, "only a run can change its wall"),
        (
            {"simulation.torque_delay_cycles": 2.5},
            "the delay is 3.5 cycles in all; the laws compensate for 3 at most",
        ),
    ],
)
def test_what_cannot_be_simulated(overrides: dict[str, Any], message: str) -> None:
    settings = settings_with(overrides)
    if overrides:
        settings = settings.model_copy(update={"schedule": ()})
    with pytest.raises(ConfigError, match=message):
        simulate(settings, 100)
