"""Settings: what a file may say, what is made of it, and the one line for what it may not."""

import copy
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from canwall.config import (
    ConfigError,
    Guard,
    Operator,
    Settings,
    Wall,
    load,
    shipped,
    with_overrides,
)
from canwall.errors import InputError

BOUNDED = settings(derandomize=True, deadline=None, max_examples=200)

MINIMAL: dict[str, Any] = {
    "drive": {"node_id": 5, "eds": "drive.eds"},
    "mechanics": {"inertia_kg_m2": 1e-4},
    "limits": {"torque_nm": 1.9},
}

Load = Callable[..., Settings]


def with_values(values: dict[str, object]) -> dict[str, Any]:
    """The minimal configuration with these dotted keys set; None takes one away."""
    raw = copy.deepcopy(MINIMAL)
    for dotted, value in values.items():
        *sections, key = dotted.split(".")
        table = raw
        for section in sections:
            table = table.setdefault(section, {})
        if value is None:
            del table[key]
        else:
            table[key] = value
    return raw


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "bench.toml"


@pytest.fixture
def loaded(file: Path) -> Load:
    def write_and_load(
        values: dict[str, object] | None = None, overrides: dict[str, object] | None = None
    ) -> Settings:
        file.write_text(tomli_w.dumps(with_values(values or {})), encoding="utf-8")
        return load(file, overrides)

    return write_and_load


def refused(file: Path, overrides: dict[str, object] | None = None) -> str:
    """Return the error message for a file without the file name, which begins its only line."""
    with pytest.raises(ConfigError) as caught:
        load(file, overrides)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{file}: ")
    assert isinstance(caught.value, InputError)
    return message.removeprefix(f"{file}: ")


def test_the_least_that_is_enough(loaded: Load) -> None:
    found = loaded()
    assert found.bus.cycle_s == 0.001
    assert found.drive.node_id == 5
    assert found.simulation is None
    assert found.stages == [(0.0, Wall(), found.limits, Guard(), Operator())]


@pytest.mark.parametrize(
    ("wall", "law", "ratio", "cap"),
    [
        ({}, "mean_force", 0.5, 0.8),
        ({"wall.damping_nm_s_per_rad": 0.0}, "mean_force", 0.0, 0.8),
        ({"wall.damping_nm_s_per_rad": 0.1}, "mean_force", 0.0, 0.8),
        ({"wall.damping_nm_s_per_rad": 0.0, "wall.damping_ratio": 0.7}, "mean_force", 0.7, 0.8),
        ({"wall.law": "standard", "wall.cap": 0}, "standard", 0.5, 0.0),
    ],
)
def test_a_wall_is_damped_and_capped_unless_it_is_said_otherwise(
    loaded: Load, wall: dict[str, object], law: str, ratio: float, cap: float
) -> None:
    found = loaded(wall).wall
    assert (found.law, found.damping_ratio, found.cap) == (law, ratio, cap)


@pytest.mark.parametrize(
    ("overrides", "ratio"),
    [
        ({"wall.damping_nm_s_per_rad": 0.0}, 0.0),
        ({"wall.damping_nm_s_per_rad": 0.1}, 0.0),
        ({"wall.damping_nm_s_per_rad": 0.0, "wall.damping_ratio": 0.7}, 0.7),
    ],
)
def test_a_damping_in_place_of_the_file_s_replaces_its_ratio(
    overrides: dict[str, object], ratio: float
) -> None:
    sim = shipped("config/sim.toml")
    assert load(sim).wall.damping_ratio == 0.5
    assert load(sim, overrides).wall.damping_ratio == ratio
    assert with_overrides(load(sim), overrides).wall.damping_ratio == ratio


def test_defaults_of_a_wall_are_those_of_the_shipped_configuration() -> None:
    shown = load(shipped("config/sim.toml"))
    assert (Wall(), Guard(), Operator()) == (shown.wall, shown.guard, shown.operator)


REFUSED: list[tuple[dict[str, object], str]] = [
    # impossible values
    ({"bus.cycle_s": 0}, "bus.cycle_s: has to be greater than 0, not 0"),
    ({"bus.cycle_s": -0.001}, "bus.cycle_s: has to be greater than 0, not -0.001"),
    ({"bus.cycle_s": 1.5}, "bus.cycle_s: has to be less than or equal to 1, not 1.5"),
    ({"bus.cycle_s": math.nan}, "bus.cycle_s: has to be a finite number, not nan"),
    ({"bus.cycle_s": math.inf}, "bus.cycle_s: has to be a finite number, not inf"),
    ({"bus.cycle_s": 10**400}, "bus.cycle_s: an integer of more than 64 bits; give a smaller one"),
    ({"bus.bitrate": 0}, "bus.bitrate: has to be greater than 0, not 0"),
    ({"bus.pace": "fast"}, "bus.pace: has to be 'auto', 'real_time' or 'simulated', not 'fast'"),
    ({"drive.node_id": 200}, "drive.node_id: has to be less than or equal to 127, not 200"),
    ({"drive.node_id": 0}, "drive.node_id: has to be greater than or equal to 1, not 0"),
    ({"drive.rated_torque_nm": 0}, "drive.rated_torque_nm: has to be greater than 0"),
    ({"drive.wait_s": -math.inf}, "drive.wait_s: has to be a finite number, not -inf"),
    ({"mechanics.inertia_kg_m2": 0}, "mechanics.inertia_kg_m2: has to be greater than 0"),
    ({"mechanics.coulomb_nm": -1}, "mechanics.coulomb_nm: has to be greater than or equal to 0"),
    ({"wall.side": "left"}, "wall.side: has to be 'below' or 'above', not 'left'"),
    ({"wall.stiffness_nm_per_rad": -1}, "wall.stiffness_nm_per_rad: has to be greater than or"),
    ({"wall.position_rad": math.nan}, "wall.position_rad: has to be a finite number, not nan"),
    ({"limits.torque_nm": 0.0}, "limits.torque_nm: has to be greater than 0, not 0.0"),
    ({"limits.hold_cycles": 101}, "limits.hold_cycles: has to be less than or equal to 100"),
    ({"limits.position_rad": [1.0]}, "limits.position_rad.1: is missing; add it"),
    ({"limits.position_rad": [1.0, 2.0, 3.0]}, "limits.position_rad: has to be a pair"),
    ({"limits.position_rad": [1.0, -1.0]}, "limits.position_rad: the lower limit has to come"),
    ({"limits.position_rad": [1.0, 1.0]}, "limits.position_rad: the lower limit has to come"),
    ({"limits.position_rad": [0, math.inf]}, "limits.position_rad.1: has to be a finite number"),
    ({"run.duration_s": 0}, "run.duration_s: has to be greater than 0, not 0"),
    ({"run.bus_log": "log.txt"}, "run.bus_log: has to be 'bus.log', 'bus.asc'"),
    ({"simulation.hand.strikes": -1}, "simulation.hand.strikes: has to be greater than or"),
    # wrong types
    ({"bus.cycle_s": "1 ms"}, "bus.cycle_s: has to be a valid number, not '1 ms'"),
    ({"bus.cycle_s": True}, "bus.cycle_s: has to be a valid number, not True"),
    ({"bus.cycle_s": [0.001]}, "bus.cycle_s: has to be a valid number, not an array"),
    ({"bus.bitrate": 1e6}, "bus.bitrate: has to be a valid integer, not 1000000.0"),
    ({"bus.channel": 0}, "bus.channel: has to be a valid string, not 0"),
    ({"drive.node_id": "5"}, "drive.node_id: has to be a valid integer, not '5'"),
    ({"drive.node_id": 5.0}, "drive.node_id: has to be a valid integer, not 5.0"),
    ({"drive.eds": 3}, "drive.eds: has to be a path in quotes, not 3"),
    ({"wall.law": 1}, "wall.law: has to be a valid string, not 1"),
    ({"limits.position_rad": "wide"}, "limits.position_rad: has to be an array, not 'wide'"),
    ({"limits.position_rad": [0, "x"]}, "limits.position_rad.1: has to be a valid number"),
    ({"wall": 3}, "wall: has to be a table, not 3"),
    ({"mechanics": 3}, "mechanics: has to be a table, not 3"),
    ({"schedule": 3}, "schedule: has to be an array, not 3"),
    ({"schedule": {"at_s": 1.0}}, "schedule: has to be an array, not a table; write [[schedule]]"),
    (
        {"simulation.fault": {"at_s": 1.0}},
        "simulation.fault: has to be an array, not a table; write [[simulation.fault]]",
    ),
    ({"wall": [1]}, "wall: has to be a table, not an array"),
    ({"schedule": [3]}, "schedule.0: has to be a table, not 3"),
    # what is missing
    ({"drive": None}, "drive: is missing; add it"),
    ({"mechanics": None}, "mechanics: is missing; add it"),
    ({"limits": None}, "limits: is missing; add it"),
    ({"drive.node_id": None}, "drive.node_id: is missing; add it"),
    ({"drive.eds": None}, "drive.eds: is missing; add it"),
    (
        {"drive.node_id": None, "drive.eds": None, "limits.torque_nm": None},
        "drive.node_id, drive.eds: are missing; add them",
    ),
    ({"schedule": [{"law": "damped"}]}, "schedule.0.at_s: is missing; add it"),
    # what is unknown
    ({"walll.law": "x"}, "walll: unknown key; did you mean wall?"),
    ({"bus.cycle": 0.001}, "bus.cycle: unknown key; did you mean cycle_s?"),
    (
        {"drive.node_id": None, "drive.node_ids": 5},
        "drive.node_ids: unknown key; did you mean node_id?",
    ),
    (
        {"wall.stifness_nm_per_rad": 5},
        "wall.stifness_nm_per_rad: unknown key; did you mean stiffness_nm_per_rad?",
    ),
    ({"limits.zzz": 1}, "limits.zzz: unknown key; known here: torque_nm, torque_rate_nm_per_s"),
    ({"simulation.hand.strike": 4}, "simulation.hand.strike: unknown key; did you mean strikes?"),
    ({"schedule": [{"at_s": 1, "lwa": "x"}]}, "schedule.0.lwa: unknown key; did you mean law?"),
    (
        {"schedule": [{"at_s": 1, "stiffness_nm_per_rad": -1}]},
        "schedule.0.stiffness_nm_per_rad: has to be greater than or equal to 0, not -1",
    ),
    (
        {"schedule": [{"at_s": 1, "tension": "some"}]},
        "schedule.0.tension: has to be 'allow', 'clamp' or 'budget', not 'some'",
    ),
    ({"schedule": [{"at_s": 1, "side": "above"}]}, "schedule.0.side: unknown key"),
    (
        {"schedule": [{"at_s": 1, "limits": {"torque_nm": 0}}]},
        "schedule.0.limits.torque_nm: has to be greater than 0, not 0",
    ),
    # what does not go together
    ({"schedule": [{"at_s": 2}, {"at_s": 1}]}, "schedule: the entries have to be in the order"),
    (
        {"schedule": [{"at_s": 2, "limits": {"hold_cycles": 3}}]},
        "schedule.0.limits.hold_cycles: unknown key; known here: torque_nm, torque_rate_nm_per_s",
    ),
    (
        {"schedule": [{"at_s": 2, "law": "damped"}], "wall.alternate": ["midpoint"]},
        "schedule: changes the law, and so does wall.alternate; keep one",
    ),
    ({"wall.alternate": "midpoint"}, "wall.alternate: has to be an array, not 'midpoint'"),
    ({"wall.divider": 0}, "wall.divider: has to be greater than or equal to 1, not 0"),
    ({"estimator.delay_cycles": 4}, "estimator.delay_cycles: has to be less than or equal to 3"),
    (
        {
            "mechanics.shaft_hz": 300,
            "mechanics.rotor_inertia_kg_m2": 1e-5,
            "wall.cap": 0.8,
            "schedule": [{"at_s": 1, "divider": 2}],
        },
        "wall.divider: has to be 1 with mechanics.shaft_hz and wall.cap",
    ),
    (
        {
            "mechanics.shaft_hz": 300,
            "mechanics.rotor_inertia_kg_m2": 1e-5,
            "wall.divider": 2,
            "schedule": [{"at_s": 1, "cap": 0.8}],
        },
        "wall.divider: has to be 1 with mechanics.shaft_hz and wall.cap",
    ),
    (
        {
            "mechanics.shaft_hz": 300,
            "mechanics.rotor_inertia_kg_m2": 1e-5,
            "operator.adapt": True,
            "operator.lightest_kg_m2": 1e-5,
        },
        "operator.lightest_kg_m2 = 1e-05: has to be more than the rotor's part",
    ),
    ({"bus.sync": "none"}, "bus.sync: has to be 'produce' or 'external', not 'none'"),
    ({"limits.energy_j": 0}, "limits.energy_j: has to be greater than 0, not 0"),
    (
        {"wall.position_rad": 4},
        "wall.position_rad = 4 lies outside limits.position_rad = [-3, 3]",
    ),
    (
        {"schedule": [{"at_s": 1}, {"at_s": 2, "position_rad": -9}]},
        "schedule.1.position_rad = -9 lies outside limits.position_rad = [-3, 3]",
    ),
    ({"simulation.hand.interval_s": 0.5}, "simulation.hand: a strike lasts 0.7 s"),
    (
        {"wall.damping_ratio": 0.5, "wall.damping_nm_s_per_rad": 0.1},
        "wall.damping_ratio: damping_nm_s_per_rad is given as well; keep one of them",
    ),
    # what no arithmetic bears
    *(
        ({key: value}, f"{key}: has to be {side} than or equal to")
        for key, value, side in (
            ("bus.cycle_s", 1e-20, "greater"),
            ("run.ramp_in_s", 1e17, "less"),
            ("mechanics.viscous_nm_s_per_rad", 1e20, "less"),
            ("mechanics.spring_nm_per_rad", 1e20, "less"),
            ("mechanics.inertia_kg_m2", 1e-300, "greater"),
            ("operator.heaviest_kg_m2", 1e300, "less"),
            ("wall.damping_ratio", 1e300, "less"),
            ("drive.counts_per_rev", 1e300, "less"),
            ("simulation.peak_torque_nm", 1e300, "less"),
        )
    ),
    (
        {"mechanics.handle_radius_m": 1e200, "wall.stiffness_n_per_m": 500},
        "mechanics.handle_radius_m: has to be less than or equal to 10",
    ),
    # at the handle
    (
        {"wall.stiffness_n_per_m": 500},
        "wall.stiffness_n_per_m: unknown key; lengths and forces at the handle need "
        "mechanics.handle_radius_m",
    ),
    ({"mechanics.handle_radius_m": 0}, "mechanics.handle_radius_m: has to be greater than 0"),
    (
        {"mechanics.handle_radius_m": 0, "wall.stiffness_n_per_m": 500},
        "mechanics.handle_radius_m: has to be greater than 0",
    ),
    (
        {
            "mechanics.handle_radius_m": 0.1,
            "wall.stiffness_n_per_m": 5,
            "wall.stiffness_nm_per_rad": 5,
        },
        "wall.stiffness_n_per_m: stiffness_nm_per_rad is given as well; keep one of them",
    ),
    (
        {
            "mechanics.handle_radius_m": 0.1,
            "schedule": [{"at_s": 1, "position_m": 0.1, "position_rad": 1}],
        },
        "schedule.0.position_m: position_rad is given as well; keep one of them",
    ),
    (
        {"mechanics.handle_radius_m": 0.1, "wall.position_m": "near"},
        "wall.position_m: has to be a valid number, not 'near'",
    ),
    (
        {"mechanics.handle_radius_m": 0.1, "wall.damping_n_s_per_m": True},
        "wall.damping_n_s_per_m: has to be a valid number, not True",
    ),
]


@pytest.mark.parametrize(("values", "message"), REFUSED)
def test_what_cannot_be_is_one_line_with_file_and_key(
    file: Path, values: dict[str, object], message: str
) -> None:
    file.write_text(tomli_w.dumps(with_values(values)), encoding="utf-8")
    assert refused(file).startswith(message)


def test_a_missing_file(file: Path) -> None:
    assert refused(file) == "no such file; give the path of a configuration"


def test_a_folder(tmp_path: Path) -> None:
    assert refused(tmp_path).startswith("cannot be read: ")


@pytest.mark.parametrize(
    "text", ["[bus\n", "cycle_s = \n", "a = 1\na = 2\n", "[bus]\ncycle_s = " + "9" * 5000]
)
def test_what_is_not_toml(file: Path, text: str) -> None:
    file.write_text(text, encoding="utf-8")
    assert refused(file).startswith("not valid TOML: ")


def test_what_is_not_text(file: Path) -> None:
    for text in (b"\xff\xfe\x00\x01", "# Prüfstand".encode("latin-1")):
        file.write_bytes(text)
        assert refused(file) == "cannot be read: is not UTF-8; save it as UTF-8"


def test_a_byte_order_mark_is_no_part_of_the_text(file: Path) -> None:
    file.write_text(tomli_w.dumps(with_values({})), encoding="utf-8-sig")
    assert load(file).drive.node_id


def test_an_empty_file(file: Path) -> None:
    file.touch()
    assert refused(file) == "drive, mechanics, limits: are missing; add them"


toml_values = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text('ab"\n', max_size=3) | st.dates(),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["law", "at_s", "x"]), inner, max_size=2)
    ),
    max_leaves=4,
)
keys = sorted(
    f"{section}.{key}"
    for section, field in Settings.model_fields.items()
    for key in getattr(field.annotation, "model_fields", {})
)


def test_every_key_is_explained() -> None:
    text = shipped("config/sim.toml").read_text(encoding="utf-8")
    missing = [key for key in keys if not re.search(rf"\b{key.partition('.')[2]}\b", text)]
    assert missing == []


@pytest.mark.slow
@BOUNDED
@given(
    st.dictionaries(
        st.sampled_from(
            [*keys, *Settings.model_fields, "mechanics.handle_radius_m", "wall.position_m"]
        ),
        toml_values,
        min_size=1,
        max_size=2,
    )
)
def test_whatever_the_values_it_is_settings_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, values: dict[str, object]
) -> None:
    file = tmp_path_factory.getbasetemp() / "any.toml"
    sections = [key for key in values if "." not in key]
    kept = {k: v for k, v in values.items() if k in sections or k.split(".")[0] not in sections}
    file.write_text(tomli_w.dumps(with_values(kept)), encoding="utf-8")
    try:
        assert isinstance(load(file, {"wall.law": "damped"}), Settings)
    except ConfigError as error:
        message = str(error)
        assert message.startswith(f"{file}: ")
        assert "\n" not in message
        assert "Traceback" not in message


def test_a_whole_number_is_a_number(loaded: Load) -> None:
    found = loaded({"bus.cycle_s": 1, "limits.position_rad": [-1, 2]})
    assert found.bus.cycle_s == 1.0
    assert isinstance(found.bus.cycle_s, float)
    assert found.limits.position_rad == (-1.0, 2.0)


def test_strikes_may_follow_one_another_without_a_rest(loaded: Load) -> None:
    hand = {"approach_s": 0.1, "press_s": 0.1, "withdraw_s": 0.1, "interval_s": 0.3}
    found = loaded({f"simulation.hand.{key}": value for key, value in hand.items()})
    assert found.simulation is not None
    assert found.simulation.hand.interval_s == 0.3


def test_a_single_strike_needs_no_interval(loaded: Load) -> None:
    assert loaded({"simulation.hand.strikes": 1, "simulation.hand.interval_s": 0.1}).simulation


def test_the_eds_is_found_from_the_file(
    loaded: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert loaded().drive.eds == tmp_path.resolve() / "drive.eds"
    above = loaded({"drive.eds": "../eds/a.dcf"}).drive.eds
    assert above == tmp_path.parent.resolve() / "eds" / "a.dcf"
    assert loaded({"drive.eds": "/opt/b.eds"}).drive.eds == Path("/opt/b.eds")


def test_the_eds_is_found_from_a_relative_path_to_the_file(
    loaded: Load, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded()
    monkeypatch.chdir(file.parent)
    assert load(Path(file.name)).drive.eds == file.parent.resolve() / "drive.eds"


def test_a_wall_at_the_handle_is_turned_into_angles(loaded: Load) -> None:
    radius = 0.08
    found = loaded(
        {
            "mechanics.handle_radius_m": radius,
            "wall.position_m": 0.016,
            "wall.stiffness_n_per_m": 5000,
            "wall.damping_n_s_per_m": 10.0,
            "schedule": [{"at_s": 1.0, "stiffness_n_per_m": 1000.0, "position_m": -0.008}],
        }
    )
    assert found.wall.position_rad == pytest.approx(0.2)
    # 1 N at the handle is r N·m at the shaft, 1 m there 1/r rad.
    assert found.wall.stiffness_nm_per_rad == pytest.approx(5000 * radius**2)
    assert found.wall.damping_nm_s_per_rad == pytest.approx(10 * radius**2)
    later = found.stages[1].wall
    assert later.stiffness_nm_per_rad == pytest.approx(1000 * radius**2)
    assert later.position_rad == pytest.approx(-0.1)
    assert later.damping_nm_s_per_rad == found.wall.damping_nm_s_per_rad


def test_with_a_handle_the_wall_may_still_be_in_angles(loaded: Load) -> None:
    found = loaded({"mechanics.handle_radius_m": 0.08, "wall.stiffness_nm_per_rad": 12.0})
    assert found.wall.stiffness_nm_per_rad == 12.0


def test_overrides_go_first(loaded: Load) -> None:
    found = loaded(
        {"wall.law": "standard", "wall.stiffness_nm_per_rad": 10.0},
        {"wall.law": "damped", "run.duration_s": 2.0},
    )
    assert (found.wall.law, found.wall.stiffness_nm_per_rad) == ("damped", 10.0)
    assert found.run.duration_s == 2.0


def test_overrides_go_before_what_is_written_at_the_handle(loaded: Load) -> None:
    found = loaded(
        {"mechanics.handle_radius_m": 0.1, "wall.stiffness_n_per_m": 500},
        {"wall.stiffness_nm_per_rad": 80.0},
    )
    assert found.wall.stiffness_nm_per_rad == 80.0


def test_overrides_are_validated_too(file: Path, loaded: Load) -> None:
    loaded()
    assert refused(file, {"wall.stiffness_nm_per_rad": -1.0}).startswith(
        "wall.stiffness_nm_per_rad: has to be greater than or equal to 0"
    )
    file.write_text(tomli_w.dumps(with_values({"wall": 3})), encoding="utf-8")
    assert refused(file, {"wall.law": "damped"}) == "wall: has to be a table, not 3"


def test_the_schedule_changes_only_what_it_names(loaded: Load) -> None:
    found = loaded(
        {
            "wall.law": "standard",
            "wall.stiffness_nm_per_rad": 10,
            "schedule": [
                {"at_s": 1, "law": "damped"},
                {"at_s": 2.5, "stiffness_nm_per_rad": 0, "tension": "budget"},
                {"at_s": 2.5, "damping_nm_s_per_rad": 0.5, "position_rad": 0.25},
                {"at_s": 4},
            ],
        }
    )
    instants = [stage.at_s for stage in found.stages]
    walls = [stage.wall for stage in found.stages]
    assert instants == [0.0, 1.0, 2.5, 2.5, 4.0]
    assert [w.law for w in walls] == ["standard", "damped", "damped", "damped", "damped"]
    assert [w.stiffness_nm_per_rad for w in walls] == [10.0, 10.0, 0.0, 0.0, 0.0]
    assert [w.damping_nm_s_per_rad for w in walls] == [0.0, 0.0, 0.0, 0.5, 0.5]
    assert [w.tension for w in walls] == ["clamp", "clamp", "budget", "budget", "budget"]
    assert [w.position_rad for w in walls] == [0.0, 0.0, 0.0, 0.25, 0.25]


def test_the_schedule_changes_limits_as_well(loaded: Load) -> None:
    found = loaded(
        {
            "limits.torque_nm": 1.0,
            "limits.speed_rad_s": 20.0,
            "schedule": [
                {"at_s": 1, "limits": {"torque_nm": 0.5}},
                {"at_s": 2, "limits": {"speed_rad_s": 5.0, "energy_j": 0.1}},
            ],
        }
    )
    limits = [stage.limits for stage in found.stages]
    assert [at.torque_nm for at in limits] == [1.0, 0.5, 0.5]
    assert [at.speed_rad_s for at in limits] == [20.0, 20.0, 5.0]
    assert [at.energy_j for at in limits] == [None, None, 0.1]


def test_laws_take_turns_with_their_own_options(loaded: Load) -> None:
    found = loaded(
        {
            "wall.law": "hysteresis",
            "wall.options": {"softening": 0.5},
            "wall.alternate": ["standard", "laws.py:mine"],
        }
    )
    turns = found.laws_in_turn(found.wall)
    assert [wall.law.rpartition("/")[2] for wall in turns] == [
        "hysteresis",
        "standard",
        "laws.py:mine",
    ]
    assert turns[2].law.startswith("/")
    assert [wall.options for wall in turns] == [{"softening": 0.5}, {}, {}]
    assert {wall.stiffness_nm_per_rad for wall in turns} == {found.wall.stiffness_nm_per_rad}


@pytest.mark.parametrize(
    ("values", "embedded", "real_time"),
    [
        ({}, False, True),
        ({"simulation": {}, "run.duration_s": 1}, True, False),
        ({"simulation": {}}, True, True),  # without an end
        ({"simulation": {}, "bus.pace": "simulated"}, True, False),
        ({"simulation": {}, "bus.pace": "real_time"}, True, True),
        ({"simulation": {}, "bus.interface": "unixcan"}, False, False),
        ({"simulation": {}, "bus.interface": "socketcan", "bus.channel": "vcan1"}, False, False),
        # There may be a real drive, and the file may have a simulated one for its sweeps.
        ({"simulation": {}, "bus.interface": "socketcan", "bus.channel": "can0"}, False, True),
        ({"simulation": {}, "bus.interface": "pcan", "run.duration_s": 1}, False, True),
        ({"bus.pace": "simulated"}, False, False),
    ],
)
def test_who_keeps_the_time_and_where_the_drive_is(
    loaded: Load, values: dict[str, object], embedded: bool, real_time: bool
) -> None:
    found = loaded(values)
    assert (found.embedded, found.real_time) == (embedded, real_time)


def test_settings_cannot_be_changed(loaded: Load) -> None:
    found = loaded()
    with pytest.raises(ValueError, match="frozen"):
        found.bus.cycle_s = 0.002  # type: ignore[misc]


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"simulation": {}, "bus.pace": "real_time", "drive.gear_ratio": 3},
        {
            "mechanics.handle_radius_m": 0.1,
            "wall.stiffness_n_per_m": 500,
            "schedule": [
                {"at_s": 1, "position_m": 0.01},
                {"at_s": 1, "law": "damped", "tension": "clamp"},
            ],
        },
        {"simulation.hand.press_rad": -0.2, "run.duration_s": 1, "limits.position_rad": [-1, 2]},
    ],
)
def test_settings_written_are_settings_read(
    loaded: Load, tmp_path: Path, values: dict[str, object]
) -> None:
    found = loaded(values)
    again = tmp_path / "run" / "config.toml"
    again.parent.mkdir()
    again.write_text(found.to_toml(), encoding="utf-8")
    assert load(again) == found
    assert load(again).to_toml() == found.to_toml()


SHIPPED = sorted(shipped("config").glob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_configurations_that_come_with_the_project(path: Path, tmp_path: Path) -> None:
    found = load(path)
    assert found.drive.eds.is_file()
    again = tmp_path / "config.toml"
    again.write_text(found.to_toml(), encoding="utf-8")
    assert load(again) == found


def test_there_is_a_configuration_for_a_start() -> None:
    assert "sim.toml" in [path.name for path in SHIPPED]
    assert load(shipped("config/sim.toml")).embedded
