"""The command, over the embedded bus: what it finds, writes and refuses, and how it ends."""

import json
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from commands import call, command, config_file
from rig import eds_with, settings_with

from canwall import config
from canwall.config import ConfigError, Settings
from canwall.identify import UntellingDataError, identify
from canwall.identify.excitation import Bounds, HandExcitation
from canwall.identify.session import Identification, stiction, with_simulated_hand_still
from canwall.record import ROW

#: Changes of config/sim.toml: nobody at the handle, a real current loop, a model that is off.
FREE = {
    "inertia_kg_m2 = 6.4e-5": "inertia_kg_m2 = 0.0",
    "damping_nm_s_per_rad = 0.0256": "damping_nm_s_per_rad = 0.0",
    "stiffness_nm_per_rad = 3.2": "stiffness_nm_per_rad = 0.0",
    "strikes = 4\n": "strikes = 0\n",
    "current_bandwidth_hz = 1600.0 # of the": "current_bandwidth_hz = 800.0 # of the",
    "inertia_kg_m2 = 1.0e-4     # operator": "inertia_kg_m2 = 1.2e-4 # operator",
}
#: The hand of config/sim.toml, which rests.
HELD = {"strikes = 4\n": "strikes = 0\n"}


def free_handle() -> Settings:
    settings = settings_with({})
    assert settings.simulation is not None
    nobody = {"inertia_kg_m2": 0.0, "damping_nm_s_per_rad": 0.0, "stiffness_nm_per_rad": 0.0}
    hand = settings.simulation.hand.model_copy(update=nobody | {"strikes": 0})
    simulation = settings.simulation.model_copy(update={"hand": hand})
    return settings.model_copy(update={"simulation": simulation})


@pytest.mark.slow
def test_command_finds_the_servo(tmp_path: Path) -> None:
    """With the true inertia told, which is 1.2 times that in commanded torque."""
    path = config_file(tmp_path / "servo.toml", FREE)
    done = command("identify", path, "--inertia", "1.2e-4", "--output", tmp_path / "record")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "record/identify.json").read_text())
    truth = {
        "inertia": 1e-4,
        "viscous": 5e-4,
        "coulomb": 0.01,
        "stiction": 0.015,
        "delay": 1.25,  # of the bus and the drive's own cycle
        "lag": 1.0 / (2.0 * 3.14159265 * 800.0),
    }
    for name, true in truth.items():
        low, high = found[name]["interval"]
        assert low <= true <= high, name
        assert high - low < (0.3 if name == "stiction" else 0.15) * true, name
    assert "the torque is 1.20 times the commanded one" in done.stdout
    assert "the current loop is slow" in done.stdout
    fragment = tomllib.loads((tmp_path / "record/identify.toml").read_text())
    assert fragment["mechanics"]["inertia_kg_m2"] == pytest.approx(1e-4, rel=0.01)
    assert fragment["drive"]["current_bandwidth_hz"] == pytest.approx(800.0, rel=0.05)
    assert 1.25 <= fragment["estimator"]["delay_cycles"] < 1.27
    assert (tmp_path / "record/identify.png").stat().st_size > 10_000
    assert (tmp_path / "record/signals.parquet").exists()


@pytest.mark.slow
def test_command_finds_the_operator(tmp_path: Path) -> None:
    path = config_file(tmp_path / "servo.toml", HELD)
    done = command("identify", path, "--hand", "--output", tmp_path / "record")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "record/identify.json").read_text())
    for name, true in {"inertia": 6.4e-5, "damping": 0.0256, "stiffness": 3.2}.items():
        low, high = found[name]["interval"]
        assert low <= true <= high, name
        assert high - low < 0.2 * true, name


@pytest.mark.slow
def test_drive_that_is_not_restored_is_a_failure(tmp_path: Path) -> None:
    odd = {("1800sub3", "DefaultValue"): "20\nHighLimit=10"}
    eds = eds_with(tmp_path / "odd.eds", odd)
    restored = {'"../eds/canwall-drive.eds"': f'"{eds}"\nrestore = true'}
    path = config_file(tmp_path / "servo.toml", HELD | restored)
    done = command("identify", path, "--hand", "--output", tmp_path / "record")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("canwall: node 5: not restored: writing 0x14 to 0x1800:03")
    assert (tmp_path / "record/identify.json").exists()


def test_report_that_is_there_is_kept(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Nothing is enabled: there would be a record."""
    (tmp_path / "identify.toml").write_text("mine")
    assert call("identify", "--output", tmp_path) == 2
    said = f"canwall: {tmp_path}: holds identify.toml already; choose another --output\n"
    assert capsys.readouterr().err == said
    assert [path.name for path in tmp_path.iterdir()] == ["identify.toml"]
    assert (tmp_path / "identify.toml").read_text() == "mine"


@pytest.mark.slow
def test_hand_at_the_handle_is_told(tmp_path: Path) -> None:
    settings = config.load(config_file(tmp_path / "servo.toml", HELD))
    with pytest.raises(UntellingDataError, match="let it go"):
        identify(settings, tmp_path / "record")


@pytest.mark.slow
def test_drive_that_derates_its_torque_is_told(tmp_path: Path) -> None:
    derated = {"kind": "torque", "at_s": 15.0, "amount": 500}
    settings = config.with_overrides(free_handle(), {"simulation.fault": [derated]})
    with pytest.raises(UntellingDataError, match="derate its torque"):
        identify(settings, tmp_path / "record")


@pytest.mark.slow
def test_simulated_hand_lets_go_or_holds_still(tmp_path: Path) -> None:
    """The one of config/sim.toml strikes."""
    for words, does in (
        (["identify"], "lets the handle go"),
        (["identify", "--hand"], "holds the"),
    ):
        done = command(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"the simulated hand {does}" in done.stderr


@pytest.mark.slow
def test_operator_that_cannot_be_is_refused(tmp_path: Path) -> None:
    """A hand that strikes instead of holding still."""
    with pytest.raises(UntellingDataError, match="operator's inertia, which cannot be negative"):
        identify(settings_with({}), tmp_path / "record", with_hand=True)


def test_inertia_of_the_free_handle_is_not_that_of_a_hand() -> None:
    done = command("identify", "--hand", "--inertia", "1e-4")
    assert done.returncode == 2
    assert "leave it out with --hand" in done.stderr


@pytest.mark.slow
def test_stopped_on_the_way(tmp_path: Path) -> None:
    """Asked in every cycle: the drive is disabled, the record complete, and nothing concluded."""
    asked = 0

    def stopped() -> bool:
        nonlocal asked
        asked += 1
        return asked > 2000

    found = identify(free_handle(), tmp_path / "record", stopped=stopped)
    outcome = found.result.outcome
    assert (outcome.interrupted, outcome.disabled, outcome.trips) == (True, True, [])
    assert found.servo is None
    assert found.result.summary["interrupted"]


@pytest.mark.parametrize("ramps", [3, 4, 5])
def test_stiction_is_what_is_left_of_both_ways_without_cogging(
    monkeypatch: pytest.MonkeyPatch, ramps: int
) -> None:
    """20 mN·m, a constant torque of 3 mN·m and cogging, in more ramps forwards than backwards."""
    place = np.linspace(0.0, 1.0, ramps)
    way = np.where(np.arange(ramps) == 1, -1.0, 1.0)
    cogging = np.array([0.0, 1.0]), np.array([-0.005, 0.005])
    torque = 0.02 * way + 0.003 + np.interp(place, *cogging)
    found = place, torque, np.full(ramps, 1e-3)
    monkeypatch.setattr("canwall.identify.session.break_away", lambda *_: found)
    servo = SimpleNamespace(
        inertia=SimpleNamespace(value=1e-4), delay=SimpleNamespace(value=1.0), cogging=cogging
    )
    none = SimpleNamespace(position=None, torque=None, period=1e-3, step=1e-5)
    holds = stiction(cast(Any, none), cast(Any, servo))
    if ramps < 4:
        assert holds is None
        return
    assert holds is not None
    assert holds.value == pytest.approx(0.02)
    scatter = 2.0 * np.std(0.003 * way, ddof=1) / np.sqrt(ramps)
    assert holds.half == pytest.approx(np.hypot(scatter, 1e-3))


@pytest.mark.parametrize(
    ("synchronous", "torques"),
    [(True, [1.0, 1.0, 1.0, 1.0, 2.0, 3.0]), (False, [1, 2, 2, 2, 2, 3])],
)
def test_master_that_stands_still_has_no_fast_handle(
    synchronous: bool, torques: list[float]
) -> None:
    """Three SYNCs are left out, in which the torque in force stays and the handle goes on."""
    row = np.zeros(1, ROW)
    row["received"] = True
    cycle: Any = {"skipped_sync": np.zeros(1, int), "nm_per_mille": np.full(1, 1e-3)}
    cycle |= {"test_per_mille": np.zeros(1, int), "rad_per_count": np.full(1, 1e-3)}
    settings = SimpleNamespace(bus=SimpleNamespace(cycle_s=1e-3))
    setup = SimpleNamespace(synchronous=synchronous)
    asked: list[tuple[float, int]] = []
    excitation = SimpleNamespace(next=lambda *given: asked.append(given))
    axis: Any = SimpleNamespace(row=row, cycle=cycle, settings=settings, setup=setup)
    identification = Identification(axis, cast(Any, excitation))
    for position, torque in ((0.0, 1.0), (0.01, 2.0), (0.05, 3.0)):
        identification.excite()
        cycle["skipped_sync"] += 3 if position == 0.05 else 0
        row["position_rad"], row["counts"], row["torque_cmd"] = position, 1e3 * position, torque
        identification.note()
    identification.excite()
    assert asked[2:] == [(0.01, 1), (0.05, 4)]
    measured = identification.measured()
    np.testing.assert_array_equal(measured.position, [0.0, 0.01, *[np.nan] * 3, 0.05])
    assert measured.torque.tolist() == torques


def test_handle_next_to_a_limit_is_refused() -> None:
    """Where the handle is shows once the drive is enabled: too late for bad input."""
    with pytest.raises(UntellingDataError, match="too near to a limit"):
        Bounds.of(settings_with({}), 2.9, 1.9)


def test_handle_that_does_not_move_is_told_what_to_do() -> None:
    axis: Any = SimpleNamespace(cycle={"skipped_sync": np.zeros(1, int)})
    with pytest.raises(UntellingDataError, match=r"single count: .*limits\.torque_nm"):
        Identification(axis, cast(Any, None)).measured()


def test_hand_excitation_is_small_and_ends() -> None:
    settings = settings_with({})
    excitation = HandExcitation(settings, 1.9)
    torques = []
    while (torque := excitation.next(0.0)) is not None:
        torques.append(torque)
    assert len(torques) == round(HandExcitation.duration_s / settings.bus.cycle_s)
    assert max(map(abs, torques)) <= settings.estimator.measure_torque_nm


def test_nobody_holds_no_handle() -> None:
    keys = ("inertia_kg_m2", "damping_nm_s_per_rad", "stiffness_nm_per_rad")
    nobody = {"simulation.hand": dict.fromkeys(keys, 0.0) | {"grip": True}}
    with pytest.raises(ConfigError, match=r"\[simulation\.hand\] is nobody"):
        with_simulated_hand_still(settings_with(nobody), holding=True)


@pytest.mark.parametrize(
    ("changes", "with_hand", "message"),
    [
        ({"bus.cycle_s": 0.1}, False, r"bus\.cycle_s: has to be at most 0\.05"),
        ({"bus.cycle_s": 0.4}, True, r"bus\.cycle_s: has to be at most 0\.05"),
        ({"drive.torque_pdo": "immediate"}, True, r"estimator\.delay_cycles: needed for --hand"),
    ],
)
def test_configuration_that_identifies_nothing_is_refused(
    tmp_path: Path, changes: dict[str, Any], with_hand: bool, message: str
) -> None:
    """Before anything is enabled or written."""
    with pytest.raises(ConfigError, match=message):
        identify(settings_with(changes), tmp_path / "record", with_hand)
    assert not (tmp_path / "record").exists()
