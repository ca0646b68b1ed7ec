"""Delay from sample to torque, found in the motion on a wall."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Record, command
from numpy.typing import NDArray
from rig import settings_with
from scipy.integrate import solve_ivp

from canwall.run.closed_loop import simulate
from canwall.run.torque_delay import delay_in_record

COUNT = 2.0 * np.pi / 131072
PERIOD = 1e-3


def motion(torque: NDArray[np.float64], delay: float, mass: float) -> NDArray[np.float64]:
    """Positions at the SYNCs of a damped mass on a spring, by SciPy, in whole counts."""
    viscous, spring = 0.02, 3.0
    x, positions = np.zeros(2), []
    for j in range(len(torque)):
        positions.append(x[0])
        # The torque changes once within the period, at the fraction of the delay.
        changes = (j + delay % 1.0) * PERIOD
        for begin, end in itertools.pairwise(sorted({j * PERIOD, changes, (j + 1) * PERIOD})):
            k = int(np.floor((begin + end) / (2.0 * PERIOD) - delay))
            force = torque[k] if k >= 0 else 0.0

            def flow(t: float, x: NDArray[np.float64], u: float = force) -> list[float]:
                return [x[1], (u - viscous * x[1] - spring * x[0]) / mass]

            x = solve_ivp(flow, (begin, end), x, rtol=1e-8, atol=1e-10).y[:, -1]
    return np.rint(np.array(positions) / COUNT) * COUNT


@pytest.mark.parametrize("mass", [1e-4, 2e-3])
@pytest.mark.parametrize("delay", [0.3, 1.0, 1.35, 2.0, 2.8])
def test_delay_of_known_torques(delay: float, mass: float) -> None:
    """However light or heavy: of that nothing is known."""
    random = np.random.default_rng(0)
    torque = 0.2 * np.repeat(random.choice([-1.0, 0.0, 1.0], 100), 4)
    found = delay_in_record(motion(torque, delay, mass), torque)
    assert found is not None
    assert found[0] == pytest.approx(delay, abs=0.05)
    assert found[1] < 0.1


def test_positions_that_are_missing_are_left_out() -> None:
    torque = 0.2 * np.repeat(np.random.default_rng(0).choice([-1.0, 0.0, 1.0], 100), 4)
    position = motion(torque, 1.35, 1e-4)
    position[::13] = np.nan
    found = delay_in_record(position, torque)
    assert found is not None
    assert found[0] == pytest.approx(1.35, abs=0.05)


def test_what_tells_nothing() -> None:
    """No motion, motion without torque, torque without motion, motion that is something else."""
    random = np.random.default_rng(0)
    still, moving = np.zeros(1000), np.cumsum(random.normal(size=1000)) * 1e-3
    torque = random.normal(size=1000)
    for position, commanded in ((still, still), (moving, still), (still, torque), (moving, torque)):
        assert delay_in_record(position, commanded) is None


@pytest.mark.parametrize("seed", range(4))
def test_position_of_ticks_is_no_damping(seed: int) -> None:
    """A free mass, of a drive that takes torques over and latches its position every 0.4 ms."""
    torque = 0.1 * np.repeat(np.random.default_rng(seed).normal(size=700), 3)
    last = (np.arange(100 * len(torque)) - 13) // 40 * 40 + 13
    force = np.where(last < 100, 0.0, torque[last // 100 - 1])
    position = np.cumsum(np.cumsum(force)) * (PERIOD / 100) ** 2 / 2e-4
    position = position[np.maximum(last[::100], 0)]
    found = delay_in_record(np.rint(position / COUNT) * COUNT, torque)
    assert found is not None
    assert found[0] == pytest.approx(1.4, abs=0.15)


#: The ideal drive of the closed forms, and one that lags.
DRIVES: dict[str, dict[str, Any]] = {
    "ideal": {
        "simulation.ideal": True,
        "drive.current_bandwidth_hz": 0.0,
        "drive.drive_cycle_s": 0.0,
        "operator.adapt": False,
    },
    "servo": {
        "simulation.ideal": False,
        "simulation.current_bandwidth_hz": 1600.0,
        "simulation.drive_cycle_s": 0.00025,
        "simulation.stiction_nm": 0.015,
        "drive.current_bandwidth_hz": 1600.0,
        "drive.drive_cycle_s": 0.00025,
    },
}


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize(("law", "stiffness"), [("standard", 20.0), ("mean_force", 50.0)])
def test_torque_that_is_a_cycle_late_for_good(drive: str, law: str, stiffness: float) -> None:
    reckoned = {"ideal": 1.0, "servo": 1.35}[drive]
    for late in (0.0, 1.0):
        wall = {"wall.law": law, "wall.stiffness_nm_per_rad": stiffness}
        settings = settings_with({**DRIVES[drive], **wall, "simulation.torque_delay_cycles": late})
        rows = simulate(settings.model_copy(update={"schedule": ()}), 4200).rows
        found = delay_in_record(rows["position_rad"], rows["torque_cmd"])
        if late:
            assert found is not None
            assert found[0] == pytest.approx(reckoned + 1.0, abs=0.05)
            assert found[0] - found[1] > reckoned + 0.5
        else:  # a quiet wall says little, but no lie
            assert found is None or found[0] - found[1] < reckoned + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("at", [None, 20, 1500])
def test_rpdos_that_are_late_for_good_are_told(tmp_path: Path, at: int | None) -> None:
    """Each takes effect one SYNC later than the laws reckon with."""
    late = {"kind": "late", "can_id": 0x205, "direction": "received", "at_sync": at}
    faults = {"simulation.fault": [] if at is None else [late]}
    settings = settings_with({**DRIVES["ideal"], **faults, "wall.law": "half_sample"})
    file = tmp_path / "c.toml"
    file.write_text(settings.model_copy(update={"schedule": ()}).to_toml())
    done = command("run", file, "--output", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    told = [line for line in done.stderr.splitlines() if "cycles after their position" in line]
    found = Record(tmp_path / "run").summary["motion_delay_cycles"]
    if at is None:
        assert not told
    else:
        (line,) = told
        assert line.startswith(f"canwall: torques take effect {found[0]:.2f} ± ")
        assert found[0] == pytest.approx(2.0, abs=0.1)
