"""Several drives on one bus and one SYNC: each as if it were alone, and what ends one ends all."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig import settings_with

from canwall.config import ConfigError, Settings
from canwall.record import TIMING_COLUMNS, read_signals, start_recorders
from canwall.run import RunResult, read_run, run, run_together

DURATION_S = 0.6


def settings_of(node_id: int, overrides: dict[str, Any] | None = None) -> Settings:
    return settings_with(
        {"drive.node_id": node_id, "run.duration_s": DURATION_S} | (overrides or {})
    )


def columns(result: RunResult) -> dict[str, Any]:
    """The record up to the end of the walls: leaving takes as long as the slowest drive."""
    table = read_signals(result.folder.signals).slice(0, round(DURATION_S / 0.001))
    names = [name for name in table.column_names if name not in TIMING_COLUMNS]
    return {name: table[name].to_pylist() for name in names}


def run_all(many: list[Settings], output: Path) -> list[RunResult]:
    with start_recorders(len(many)) as recorders:
        return run_together(many, recorders, output)


@pytest.mark.slow
def test_each_is_as_if_it_were_alone(tmp_path: Path) -> None:
    many = [
        settings_of(5, {"wall.law": "half_sample"}),
        settings_of(6, {"wall.law": "mean_force", "wall.stiffness_nm_per_rad": 80.0}),
        settings_of(17, {"wall.law": "standard", "simulation.inertia_kg_m2": 3e-4}),
    ]
    together = run_all(many, tmp_path / "together")
    assert [result.folder.path.name for result in together] == ["node5", "node6", "node17"]
    for settings, result in zip(many, together, strict=True):
        assert result.outcome.trips == []
        alone = run(settings, tmp_path / f"alone {settings.drive.node_id}")
        assert columns(result) == columns(alone)
        assert result.summary["strikes"] == alone.summary["strikes"]
    assert {p.name for p in (tmp_path / "together").iterdir()} == {
        "bus.log",
        "node5",
        "node6",
        "node17",
    }
    log = (tmp_path / "together" / "bus.log").read_text()
    for rpdo in ("205#", "206#", "211#"):
        assert log.count(rpdo) == together[0].outcome.cycles


@pytest.mark.slow
def test_trip_of_one_takes_the_torque_from_all(tmp_path: Path) -> None:
    many = [
        settings_of(5, {"wall.law": "half_sample"}),
        settings_of(6, {"limits.speed_rad_s": 0.5}),
    ]
    together = run_all(many, tmp_path / "run")
    (trip,) = together[0].outcome.trips
    assert trip.startswith("node 6: cycle ")
    assert "beyond limits.speed_rad_s" in trip
    cycle = together[0].outcome.trip_cycle
    assert cycle is not None
    for result in together:
        table = read_signals(result.folder.signals)
        after = table["j"].to_numpy() > cycle
        assert not np.any(table["torque_cmd_per_mille"].to_numpy()[after])
        assert table["statusword"].to_pylist()[-1] & 0x6F == 0x40
        kept = (result.folder.path / "trip.csv").read_text().splitlines()
        assert len(kept) == 1 + 200
        assert kept[-1].split(",")[0] == str(cycle)


@pytest.mark.slow
def test_remarks_name_the_drive(tmp_path: Path) -> None:
    many = [settings_of(5), settings_of(6, {"drive.rated_torque_nm": 0.3})]
    first, second = run_all(many, tmp_path / "run")
    assert first.remarks == []
    assert any("drive.rated_torque_nm = 0.3" in remark for remark in second.remarks)
    assert all(remark.startswith("node 6: ") for remark in second.remarks)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (settings_of(5), "drive.node_id: [5, 5]: every drive needs one of its own"),
        (settings_of(6, {"bus.cycle_s": 0.002}), "bus.cycle_s differs between the configurations"),
        (
            settings_of(6, {"run.duration_s": 1.0}),
            "run.duration_s differs between the configurations",
        ),
    ],
)
def test_what_cannot_run_together(tmp_path: Path, second: Settings, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        run_all([settings_of(5), second], tmp_path / "run")
    assert str(error.value).startswith(message)
    assert not (tmp_path / "run").exists()


def test_refused_folder_leaves_no_other(tmp_path: Path) -> None:
    taken = tmp_path / "node6" / "config.toml"
    taken.parent.mkdir()
    taken.write_text("of another run")
    with pytest.raises(ConfigError, match=r"config\.toml"):
        run_all([settings_of(5), settings_of(6)], tmp_path)
    assert not (tmp_path / "node5" / "config.toml").exists()
    assert taken.read_text() == "of another run"


@pytest.mark.slow
def test_error_frames_of_a_run_that_was_cut_off_are_in_the_log_beside(tmp_path: Path) -> None:
    noisy = {"kind": "corrupted", "amount": 0, "at_s": 0.3, "duration_syncs": 5, "can_id": 0x185}
    many = [settings_of(5, {"simulation.fault": [noisy]}), settings_of(6)]
    for result in run_all(many, tmp_path / "run"):
        result.folder.summary.unlink()
        known = result.summary["error_frames"]
        assert known >= 5
        assert read_run(result.folder).summary["error_frames"] == known
