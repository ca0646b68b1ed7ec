"""Judgement of a run by what is felt: the estimate from the torque beside the force itself."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rig import settings_with

from canwall import config
from canwall.analysis.felt import band_rms, felt_band
from canwall.cli.run import _strike_table, _tell
from canwall.config import Settings
from canwall.cycle import Exchange
from canwall.record import ROW, Phase, read_signals
from canwall.record.columns import record_batch
from canwall.record.pictures import draw_run, verdict
from canwall.run import run
from canwall.run.closed_loop import SIGNALS, ClosedLoop, simulate, simulate_loop
from canwall.run.result import _remarks_on_sync, judged
from canwall.sweep.axes import settings_at
from canwall.sweep.strike import PreparedStrike


def strike(operator: str, stiffness: float) -> tuple[pa.Table, Settings, Any, float]:
    """Record, settings, units and felt force [N r.m.s.] of one strike with half_sample."""
    base = settings_with({"wall.law": "half_sample", "wall.stiffness_nm_per_rad": stiffness})
    axes = {"operator": operator, "speed": 1.0, "phase": 0.0, "servo": "ideal"}
    settings = settings_at(base, axes)
    assert settings.run.duration_s is not None
    cycles = round(settings.run.duration_s / settings.bus.cycle_s)
    loop, rows = ClosedLoop(settings, cycles), np.zeros(cycles, ROW)
    signals = np.empty((SIGNALS, cycles))
    assert simulate_loop(loop.records(), rows, signals) == cycles
    pressing = signals[3, 350:640]
    felt = band_rms(felt_band(settings.bus.cycle_s), pressing, 200, len(pressing)) / 0.08
    table = pa.Table.from_batches([record_batch(rows, ["half_sample"])])
    return table, settings, loop.units, felt


@pytest.mark.parametrize(("operator", "share"), [("grip", 3.2 / 4.2), ("finger", 1.28 / 2.28)])
def test_a_run_that_buzzes_is_judged_by_its_torque(operator: str, share: float) -> None:
    table, settings, units, felt = strike(operator, 900.0 if operator == "grip" else 430.0)
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
    assert judgement["chatter_by"] == "counts"


def test_a_person_s_run_is_judged_by_the_estimate_alone() -> None:
    table, settings, units, _ = strike("fingertip", 180.0)
    (judgement,) = judged(table, settings.model_copy(update={"simulation": None}), units)["strikes"]
    assert judgement["chatter_by"] == "ripple"
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


@pytest.fixture(scope="module")
def unknown() -> tuple[pa.Table, dict[str, Any]]:
    """Record and judgement of a grip's strike on a wall that has to find it out."""
    base = config.load(
        config.shipped("config/sim.toml"),
        {"wall.stiffness_nm_per_rad": 2000.0, "wall.cap": 0.5, "wall.damping_ratio": 0.5},
    )
    settings = settings_at(base, {"operator": "grip", "model": "drive", "speed": 1.0, "phase": 0.0})
    assert settings.run.duration_s is not None
    found = simulate(settings, round(settings.run.duration_s / settings.bus.cycle_s))
    table = pa.Table.from_batches([record_batch(found.rows, ["mean_force"])])
    return table, judged(table, settings, found.units)


def test_measurement_of_the_delay_is_no_contact(tmp_path: Path) -> None:
    settings = settings_with({"estimator.measure_delay": True, "run.duration_s": 2.0})
    assert settings.simulation is not None
    hand = settings.simulation.hand.model_copy(update={"strikes": 1, "first_strike_s": 1.1})
    simulation = settings.simulation.model_copy(update={"hand": hand})
    settings = settings.model_copy(update={"simulation": simulation})
    result = run(settings, tmp_path / "run")
    (strike,) = result.summary["strikes"]
    assert 1.1 < strike["start_s"] < 1.2
    assert result.summary["contacts"] == strike["contacts"]
    signals = read_signals(result.folder.signals)
    measures = signals["phase"].to_numpy() == Phase.MEASURING
    assert np.ptp(signals["torque_cmd"].to_numpy()[measures]) > 0.01
    before = signals["t_s"].to_numpy() < 1.1
    assert not signals["force_applied"].to_numpy()[before].any()
    assert not signals["torque_applied"].to_numpy()[before & ~measures].any()


def test_scale_that_is_not_the_simulated_drives_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And a run in which nothing has pressed says so."""
    told = {"drive.counts_per_rev": 120000.0, "run.duration_s": 0.1}
    result = run(settings_with(told), tmp_path / "run")
    (remark,) = (text for text in result.remarks if "counts_per_rev" in text)
    assert "drive.counts_per_rev = 120000, but the simulated drive has 131072" in remark
    assert _tell([result], as_json=False) == 0
    assert "No strike: nothing has pressed." in capsys.readouterr().out


def test_lost_rows_do_not_shift_times_and_referent() -> None:
    table, settings, units, _ = strike("grip", 900.0)
    summary = judged(table, settings, units)
    lossy = pa.concat_tables([table.slice(0, 10), table.slice(40)])  # before the contact
    assert judged(lossy, settings, units) == summary


def test_summary_has_what_is_in_force(unknown: tuple[pa.Table, dict[str, Any]]) -> None:
    table, summary = unknown
    # The damping follows the mass in force, and yet it is one wall.
    (judgement,) = summary["strikes"]
    assert len(np.unique(table["damping"].to_numpy())) > 10
    assert (summary["cap"], summary["damping_ratio"]) == (0.5, 0.5)
    assert judgement["stiffness"] == 2000.0
    mass = judgement["mass_est_kg_m2"]
    assert mass == pytest.approx(4.2e-4, rel=0.35)
    assert 0.0 < judgement["mass_spread"] < 0.5
    assert judgement["stiffness_in_force"] == pytest.approx(0.5 * mass / 1e-6, rel=0.05)
    # A SYNC, the drive's cycle and its current loop, as told; then as found.
    delay = table["delay_est"].to_numpy()
    assert delay[0] == pytest.approx(1.0 + (0.25e-3 + 1.0 / (2.0 * np.pi * 1600.0)) / 1e-3)
    assert judgement["delay_est_cycles"] == pytest.approx(delay[0], abs=0.15)
    assert judgement["delay_est_cycles"] != delay[0]
    assert judgement["stiffness_in_force_least"] <= judgement["stiffness_in_force"]


def test_table_of_strikes_fits_a_terminal(unknown: tuple[pa.Table, dict[str, Any]]) -> None:
    (judgement,) = unknown[1]["strikes"]
    strikes = [judgement | {"law": "half_sample", "chatter": True, "chatter_frequency_hz": 262.1}]
    console = Console(width=80, color_system=None, markup=False)
    with console.capture() as capture:
        console.print(_strike_table(strikes))
    shown = capture.get()
    assert "…" not in shown
    assert "yes, 262 Hz" in shown
    asked, in_force, mass = shown.splitlines()[-1].split()[2:5]
    assert (asked, in_force) == ("2000", f"{judgement['stiffness_in_force']:.3g}")
    assert float(mass) == pytest.approx(1e3 * judgement["mass_est_kg_m2"], rel=5e-3)


def test_picture_has_mass_and_stiffness_in_force(
    unknown: tuple[pa.Table, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, summary = unknown
    drawn: list[Figure] = []
    monkeypatch.setattr(
        FigureCanvasAgg, "print_png", lambda self, *args, **options: drawn.append(self.figure)
    )
    draw_run(tmp_path / "run.png", table, summary["strikes"])
    axes = {one.get_ylabel(): one for one in drawn[0].get_axes()}
    asked, in_force = (line.get_ydata() for line in axes["K\n[N·m/rad]"].lines)
    assert np.array_equal(np.asarray(asked), table["stiffness"].to_numpy())
    assert np.array_equal(np.asarray(in_force), table["stiffness_in_force"].to_numpy())
    (mass,) = axes["mass [g·m²]"].lines
    assert np.array_equal(np.asarray(mass.get_ydata()), 1e3 * table["mass_est"].to_numpy())


@pytest.mark.parametrize(
    ("stiffness", "limits", "thrown", "kicks"),
    [
        (1000.0, {"limits.speed_rad_s": 5.0}, True, "kick"),
        # The referent gives way as far.
        (5.0, {"limits.position_rad": [-0.01, 1.0]}, False, ""),
    ],
)
def test_a_wall_that_throws_the_handle_chatters_as_in_a_sweep(
    stiffness: float, limits: dict[str, Any], thrown: bool, kicks: str
) -> None:
    base = settings_with({"wall.law": "standard", "wall.stiffness_nm_per_rad": stiffness, **limits})
    axes = {"operator": "fingertip", "speed": 1.0, "phase": 0.0, "servo": "ideal"}
    settings = settings_at(base, axes)
    assert settings.run.duration_s is not None
    found = simulate(settings, round(settings.run.duration_s / settings.bus.cycle_s))
    assert found.trip
    table = pa.Table.from_batches([record_batch(found.rows, ["standard"])])
    (judgement,) = judged(table, settings, found.units, settings.limits)["strikes"]
    measures = PreparedStrike(settings).on(stiffness, settings.wall.damping_nm_s_per_rad)
    assert judgement["chatter"] == measures["chatters"] == thrown
    assert judgement["chatter_by"] == ("limits" if thrown else "")
    assert judgement["chatter_amplitude_rad"] == measures["amplitude"]
    # Ended by something else: what is left is what the wall did.
    (judgement,) = judged(table, settings, found.units)["strikes"]
    assert judgement["chatter_by"] == kicks


@pytest.mark.slow
def test_an_encoder_that_jumps_beyond_the_limits_is_no_handle_that_was_thrown(
    tmp_path: Path,
) -> None:
    jump = {"kind": "encoder_jump", "at_s": 0.5, "amount": 100_000}
    quiet = {"wall.law": "half_sample", "run.duration_s": 1.0, "simulation.fault": [jump]}
    found = run(settings_with(quiet), tmp_path / "run")
    (trip,) = found.outcome.trips
    assert "outside limits.position_rad, by a jump of " in trip
    assert not found.summary["chatter"]


def test_wall_that_fades_in_around_the_handle_is_not_struck(tmp_path: Path) -> None:
    # The hand rests in the wall, withdraws before it is whole, and strikes from the other side.
    settings = settings_with({"wall.side": "above", "run.duration_s": 1.05})
    (judgement,) = run(settings, tmp_path / "left").summary["strikes"]
    assert judgement["start_s"] > 0.7
    # A hand that stays meets the wall when it is whole.
    settings = settings_with({"wall.position_rad": 0.15, "run.duration_s": 0.8})
    simulation = settings.simulation
    assert simulation is not None
    hand = simulation.hand.model_copy(update={"first_strike_s": 3.0})
    simulation = simulation.model_copy(update={"hand": hand})
    settings = settings.model_copy(update={"simulation": simulation})
    (judgement,) = run(settings, tmp_path / "stayed").summary["strikes"]
    assert judgement["start_s"] == pytest.approx(settings.run.ramp_in_s, abs=0.02)
    # Friction of 0.01 N·m holds either somewhere within 0.2 mrad of its rest at 50 N·m/rad.
    assert judgement["first_depth_rad"] == pytest.approx(
        judgement["referent_first_depth_rad"], abs=0.4e-3
    )
    assert not judgement["chatter"]


def test_chatter_without_a_frequency_is_said_without() -> None:
    table, settings, units, _ = strike("finger", 430.0)
    (judgement,) = judged(table, settings, units)["strikes"]
    judgement |= {"chatter": True, "chatter_frequency_hz": 0.0}
    console = Console(width=80, color_system=None, markup=False)
    with console.capture() as capture:
        console.print(_strike_table([judgement]))
    assert "Hz" not in capture.get()
    assert verdict(judgement) == "chatter"


@pytest.mark.parametrize(("found_s", "remarks"), [(None, 0), (0.00125, 1)])
def test_sync_of_another_period_is_told(found_s: float | None, remarks: int) -> None:
    exchange = cast(Exchange, SimpleNamespace(other_period_s=found_s))
    told = _remarks_on_sync(exchange, 0.001)
    assert len(told) == remarks
    assert all("every 1.25 ms, but bus.cycle_s is 1 ms" in text for text in told)
