"""One cycle without a bus: frames' data in and out, holding, trips, walls on either side."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rig import settings_with

from canwall.compiled import copied
from canwall.config import Settings
from canwall.cycle import Trip, fade_in, make_cycle, run_laws, set_wall, step
from canwall.cycle.state import RECENT_CYCLES, fade_over, start_at
from canwall.drive import DriveSetup, Field, PdoLayout
from canwall.record import ROW, TIMING_COLUMNS, Phase
from canwall.units import DriveUnits
from canwall.walls import UnknownLawError, age_at

ENABLED = 0x0237
POSITION, STATUSWORD, TORQUE = 0x6064, 0x6041, 0x6077
CONTROLWORD, TARGET = 0x6040, 0x6071

TPDO = PdoLayout(
    0x185, (Field(POSITION, 0, 0, 32), Field(STATUSWORD, 0, 32, 16), Field(TORQUE, 0, 48, 16))
)
RPDO = PdoLayout(0x205, (Field(CONTROLWORD, 0, 0, 16), Field(TARGET, 0, 16, 16)))
#: A count is 1 mrad, a per mille 1 mN·m.
UNITS = DriveUnits(2000.0 * np.pi, 1.0)


class Wall:
    """One wall on one drive, cycle by cycle."""

    def __init__(
        self,
        overrides: dict[str, Any] | None = None,
        tpdo: PdoLayout = TPDO,
        rpdo: PdoLayout = RPDO,
        units: DriveUnits = UNITS,
    ) -> None:
        # The estimator is to follow what the tests make the handle do.
        self.settings: Settings = settings_with(
            {"wall.law": "standard", "limits.torque_nm": 30.0} | (overrides or {})
        )
        self.laws = run_laws(self.settings)
        self.cycle = make_cycle(self.settings, DriveSetup(units, 0x80, tpdo, rpdo), self.laws)
        self.cycle["phase"] = Phase.RENDERING
        self.row = np.zeros(1, ROW)

    def give(self, data: int) -> int:
        """TPDO data in, RPDO data out, both as unsigned numbers."""
        signed = data - (1 << 64) if data >> 63 else data
        return step(self.cycle, self.row, signed, True) & (1 << 64) - 1

    def at(self, counts: int, statusword: int = ENABLED) -> int:
        """A TPDO with this position; returns the torque that the RPDO carries."""
        data = counts & 0xFFFFFFFF | statusword << 32 | self.torque() << 48 & 0xFFFF << 48
        return self._sent(self.give(data))

    def missing(self) -> int:
        """No TPDO; returns the torque that the RPDO carries."""
        return self._sent(step(self.cycle, self.row, 0, False))

    def torque(self) -> int:
        return int(self.row["torque_cmd_per_mille"][0])

    def trip(self) -> Trip:
        return Trip(int(self.cycle["trip"][0]))

    def _sent(self, answer: int) -> int:
        torque = (answer >> 16 & 0xFFFF ^ 0x8000) - 0x8000
        assert torque == self.torque()
        return torque


# Frames


@st.composite
def layouts(draw: st.DrawFn, objects: dict[int, tuple[int, int]], length: int) -> PdoLayout:
    """Objects in any order with gaps between them; the bits of each are drawn from its range."""
    order = draw(st.permutations(list(objects)))
    bits = {index: draw(st.integers(*objects[index])) for index in order}
    spare = length - sum(bits.values())
    fields, shift = [], 0
    for index in order:
        gap = draw(st.integers(0, spare))
        spare -= gap
        fields.append(Field(index, 0, shift + gap, bits[index]))
        shift += gap + bits[index]
    return PdoLayout(0x185, tuple(fields))


def value_of(data: int, field: Field | None, signed: bool) -> int:
    assert field is not None
    value = data // 2**field.shift % 2**field.bits
    return value - 2**field.bits if signed and value >= 2 ** (field.bits - 1) else value


@settings(deadline=None, max_examples=80)
@given(
    layout=layouts({POSITION: (2, 32), STATUSWORD: (7, 16), TORQUE: (2, 16)}, 64),
    data=st.integers(0, 2**64 - 1),
)
def test_values_are_taken_from_any_layout(layout: PdoLayout, data: int) -> None:
    wall = Wall(tpdo=layout)
    wall.give(data)
    assert wall.row["counts"][0] == value_of(data, layout.field(POSITION), signed=True)
    assert wall.row["statusword"][0] == value_of(data, layout.field(STATUSWORD), signed=False)
    torque = value_of(data, layout.field(TORQUE), signed=True)
    assert wall.row["torque_actual"][0] == torque * UNITS.nm_per_mille


@settings(deadline=None, max_examples=80)
@given(
    layout=layouts({CONTROLWORD: (16, 16), TARGET: (16, 16)}, 64),
    controlword=st.integers(0, 0xFFFF),
    depth=st.integers(0, 700),
    side=st.sampled_from(["below", "above"]),
)
def test_values_are_put_into_any_layout(
    layout: PdoLayout, controlword: int, depth: int, side: str
) -> None:
    wall = Wall({"wall.side": side, "limits.speed_rad_s": 1e9}, rpdo=layout)
    wall.cycle["controlword"] = controlword
    outwards = 1 if side == "below" else -1
    answer = wall.give(-outwards * depth & 0xFFFFFFFF | ENABLED << 32)
    assert wall.torque() == outwards * min(50 * depth, 30_000)
    field_c, field_t = layout.field(CONTROLWORD), layout.field(TARGET)
    assert field_c is not None
    assert field_t is not None
    assert answer == controlword * 2**field_c.shift + wall.torque() % 2**16 * 2**field_t.shift


def test_without_torque_actual_value_the_last_command_is_in_force() -> None:
    wall = Wall(tpdo=PdoLayout(0x185, TPDO.fields[:2]))
    wall.at(0)
    commanded = wall.at(-3)
    assert commanded == 150
    wall.at(-4)
    assert wall.row["torque_applied"][0] == pytest.approx(0.150)


def test_row_of_a_cycle() -> None:
    wall = Wall({"wall.position_rad": 0.01})
    start_at(wall.cycle, 20)
    wall.cycle["controlword"] = 0x0F
    for counts in (20, 20, 4):
        wall.at(counts)
    row = wall.row[0]
    assert row["j"] == 2
    assert row["t_s"] == pytest.approx(0.002)
    assert row["phase"] == Phase.RENDERING
    assert row["received"]
    assert row["statusword"] == ENABLED
    assert row["controlword"] == 0x0F
    assert row["position_rad"] == pytest.approx(0.004)
    assert row["y"] == pytest.approx(-0.006)
    assert row["force"] == pytest.approx(0.3)
    assert row["torque_cmd_per_mille"] == 300
    assert row["torque_cmd"] == pytest.approx(0.3)
    assert row["torque_applied"] == row["force_applied"] == 0.0
    assert row["stiffness"] == 50.0
    assert row["wall_position_rad"] == 0.01


def test_every_column_is_filled() -> None:
    """Those of the clock are the core's."""
    wall = Wall()
    wall.row.view(np.uint8)[:] = untouched = 0xA5
    wall.at(20)
    left = [n for n in ROW.names or () if set(wall.row[n].tobytes()) == {untouched}]
    assert left == [*TIMING_COLUMNS]


def test_first_position_is_no_motion() -> None:
    wall = Wall()
    wall.at(20)
    assert [wall.row[name][0] for name in ("y", "y_est", "v_est", "d_est")] == [
        0.02,
        0.02,
        0.0,
        0.0,
    ]


@pytest.mark.parametrize("phase", [Phase.ENABLING, Phase.LEAVING])
def test_no_torque_but_while_rendering(phase: Phase) -> None:
    wall = Wall()
    wall.cycle["phase"] = phase
    assert wall.at(-10) == 0
    assert wall.at(-10, statusword=0) == 0
    assert wall.trip() == Trip.NONE


def test_torque_is_held_to_its_limit() -> None:
    wall = Wall({"limits.torque_nm": 0.7})
    assert wall.at(-13) == 650
    assert wall.at(-15) == 700
    assert wall.row["force"][0] == pytest.approx(0.75)


# Missing TPDOs


#: A handle that no torque moves.
HEAVY = {"mechanics.inertia_kg_m2": 1e6}


def test_missing_tpdos_hold_then_ramp_then_trip() -> None:
    wall = Wall({"limits.hold_cycles": 2, "limits.ramp_cycles": 4} | HEAVY)
    start_at(wall.cycle, -20)
    assert wall.at(-20) == 1000
    assert [wall.missing() for _ in range(5)] == [1000, 1000, 750, 500, 250]
    assert wall.trip() == Trip.NONE
    assert wall.missing() == 0
    assert wall.trip() == Trip.MISSED_TPDO
    assert wall.cycle["missed_tpdo"][0] == 6


def test_tpdo_that_comes_back_ends_the_ramp() -> None:
    wall = Wall({"limits.hold_cycles": 1, "limits.ramp_cycles": 10} | HEAVY)
    start_at(wall.cycle, -20)
    wall.at(-20)
    assert [wall.missing() for _ in range(3)] == [1000, 900, 800]
    assert not wall.row["received"][0]
    assert wall.at(-20) == 1000
    assert [wall.missing() for _ in range(2)] == [1000, 900]
    assert wall.cycle["missed_tpdo"][0] == 5


def gliding(counts_per_cycle: int, at: int, overrides: dict[str, Any]) -> Wall:
    """A handle with a constant speed, unimpressed by torques, which the estimator knows."""
    wall = Wall({"limits.position_rad": [-9.0, 9.0]} | HEAVY | overrides)
    start_at(wall.cycle, at)
    wall.cycle["estimator"]["v"] = counts_per_cycle  # 1 mrad in 1 ms
    return wall


def test_law_goes_on_at_the_predicted_position() -> None:
    # Of a law that uses the sample of the position only.
    inwards = gliding(-3, 4, {"limits.hold_cycles": 3, "limits.ramp_cycles": 10})
    assert inwards.at(4) == 0
    assert [inwards.missing() for _ in range(3)] == [0, 100, 250]
    # From then on it only falls.
    assert inwards.missing() == 225
    outwards = gliding(3, -14, {"limits.hold_cycles": 2, "limits.ramp_cycles": 10})
    assert outwards.at(-14) == 700
    assert [outwards.missing() for _ in range(5)] == [550, 400, 250, 100, 0]


def test_rate_of_the_torque_is_limited_without_tpdos() -> None:
    wall = gliding(-3, 4, {"limits.torque_rate_nm_per_s": 60.0, "limits.hold_cycles": 3})
    wall.at(4)
    assert [wall.missing() for _ in range(3)] == [0, 60, 120]


#: A damper of 0.1 N·m·s/rad, which goes by the speed between its samples.
DAMPER = {"wall.law": "damped", "wall.damping_nm_s_per_rad": 0.1, "limits.hold_cycles": 20}
DAMPER["wall.stiffness_nm_per_rad"] = 0.0


@pytest.mark.parametrize("divider", [1, 3])
def test_law_without_a_sample_sees_the_speed_of_the_motion(divider: int) -> None:
    wall = gliding(-2, -10, DAMPER | {"wall.divider": divider})
    moves = [wall.at(-10 - 2 * j) for j in range(4 * divider)]
    assert moves[-1] == 200
    assert [wall.missing() for _ in range(7)] == [200] * 7


def test_wall_that_fades_out_sees_the_speed_of_the_motion() -> None:
    wall = gliding(-2, -10, DAMPER)
    wall.at(-10), wall.at(-12)
    fade_over(wall.cycle, 50)
    set_wall(wall.cycle, wall.settings.wall, wall.laws)  # into itself
    assert [wall.at(-14), wall.at(-16)] == [200, 200]
    for _ in range(5):
        wall.missing()
    assert [wall.at(-28 - 2 * j) for j in range(3)] == [200] * 3


def test_wall_that_moves_does_no_work() -> None:
    """The tension of a budget is what the operator has put in; here nobody moves."""
    wall = Wall({"wall.tension": "budget", "mechanics.inertia_kg_m2": 1e4})
    start_at(wall.cycle, 0)
    for j in range(220):
        wall.at(-min(j, 20))
    put_in = wall.cycle["rendered"]["wall"]["absorbed"].item()
    assert put_in > 5e-3  # ½·K·y² = 10 mJ
    for position in (0.01, -0.01):
        moved = copied(wall.cycle)
        set_wall(moved, wall.settings.wall.model_copy(update={"position_rad": position}), wall.laws)
        step(moved, wall.row, -20 & 0xFFFFFFFF | ENABLED << 32, True)
        assert moved["rendered"]["wall"]["absorbed"].item() == pytest.approx(put_in, rel=0.01)


def test_bank_goes_on_with_the_estimator_that_lags() -> None:
    """TPDOs that are a cycle late from one to the next, of a handle at 4 rad/s."""
    units = DriveUnits(131072.0, 0.637)
    far = {"limits.position_rad": [-3.0, 3.0], "wall.position_rad": -2.5, "operator.adapt": True}
    wall = Wall({"wall.law": "mean_force", "limits.stuck_rad": 0.0} | far, units=units)
    at = [round((1.0 - 4e-3 * j) / units.rad_per_count) for j in range(300)]
    start_at(wall.cycle, at[0])
    for j in range(200):
        wall.at(at[j])
    wall.missing()
    for j in range(200, 230):
        wall.at(at[j])
        estimator = wall.cycle["estimator"]
        if wall.cycle["lag"][0]:
            assert estimator["v"].item() == pytest.approx(-4.0, abs=0.02)
            expected = (1.0 - 4e-3 * (j + 1)) / units.rad_per_count
            assert estimator["y"].item() / units.rad_per_count == pytest.approx(expected, abs=1.0)
    assert wall.cycle["lag"][0] == 1


@pytest.mark.parametrize("drive_cycle", [0.00045, 0.0006])
def test_ages_of_positions_go_on_over_skipped_syncs(drive_cycle: float) -> None:
    units = DriveUnits(131072.0, 0.637)
    servo = {"drive.drive_cycle_s": drive_cycle, "drive.current_bandwidth_hz": 1600.0}
    far = {"limits.position_rad": [-3.0, 3.0], "wall.position_rad": -2.5, "limits.stuck_rad": 0.0}
    wall = Wall({"wall.law": "mean_force", "simulation.ideal": False} | servo | far, units=units)
    start_at(wall.cycle, round(1.0 / units.rad_per_count))
    errors = []
    for j in range(230):
        if j == 200:
            wall.cycle["skipped"] = 1
        number = j + (j >= 200)
        latched = (math.floor(number * 1e-3 / drive_cycle + 0.3) - 0.3) * drive_cycle
        wall.at(round((1.0 - latched) / units.rad_per_count))
        found = age_at(wall.cycle["latch"][0, 0], number)
        errors.append(found - (number - 1e3 * latched))
    assert np.std(errors[150:200]) < 0.01
    assert np.std(errors[200:215]) < 0.01


def test_memories_of_a_law_are_those_of_its_samples() -> None:
    blind = gliding(3, -14, {"wall.law": "two_step"})
    blind.at(-14)
    wall_before = blind.cycle["rendered"]["wall"]["memory"].copy()
    blind.missing()
    assert (blind.cycle["rendered"]["wall"]["memory"] == wall_before).all()


def test_torque_is_held_while_a_wall_fades_in() -> None:
    wall = gliding(3, -14, {})
    fade_in(wall.cycle, 9)
    assert wall.at(-14) == 70
    assert [wall.missing() for _ in range(2)] == [70, 70]


def test_gap_that_begins_before_the_wall_does_not_give_a_torque_of_no_law() -> None:
    wall = gliding(-3, -14, {})
    wall.cycle["phase"] = Phase.ENABLING
    wall.at(-14), wall.missing()
    wall.cycle["phase"] = Phase.RENDERING
    assert wall.missing() == 700 + 2 * 150


def test_no_hold_at_all() -> None:
    wall = Wall({"limits.hold_cycles": 0, "limits.ramp_cycles": 1})
    wall.at(-20)
    assert wall.missing() == 0
    assert wall.trip() == Trip.MISSED_TPDO


def test_speed_after_missing_tpdos_is_that_of_the_motion() -> None:
    overrides = {"wall.law": "damped", "wall.damping_nm_s_per_rad": 0.2}
    seen, blind = Wall(overrides), Wall(overrides)
    for wall in (seen, blind):
        start_at(wall.cycle, 5)
    torques = [seen.at(counts) for counts in (5, 2, -1, -4, -7)]
    assert torques[-1] == 50 * 7 + 200 * 3
    assert [blind.at(counts) for counts in (5, 2)] == torques[:2]
    blind.missing(), blind.missing()
    assert blind.at(-7) == torques[-1]


def test_estimate_after_a_pause_is_the_mean_velocity_of_the_pause() -> None:
    overrides = {"limits.hold_cycles": 100, "limits.ramp_cycles": 1000, "wall.position_rad": -2.9}
    wall = Wall(overrides)
    start_at(wall.cycle, 500)
    for counts in (500, 500, 500):
        wall.at(counts)
    for _ in range(49):
        wall.missing()
    wall.at(300)  # 0.2 rad in 50 ms
    assert wall.trip() == Trip.NONE
    assert wall.row["v_est"][0] == pytest.approx(-4.0, abs=0.7)  # a cycle of friction later
    assert wall.cycle["estimator"]["y"][0, 0] == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("bits", [16, 32])
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_position_that_overflows_goes_on(bits: int, data: st.DataObject) -> None:
    layout = PdoLayout(0x185, (Field(POSITION, 0, 0, bits), Field(STATUSWORD, 0, 32, 16)))
    wall = Wall(tpdo=layout)
    wall.cycle["phase"] = Phase.LEAVING
    half = 2 ** (bits - 1)
    counts = data.draw(st.integers(-half, half - 1))
    wall.give(counts & (2 * half - 1) | ENABLED << 32)
    start_at(wall.cycle, int(wall.cycle["counts"][0]))
    for change in data.draw(st.lists(st.integers(1 - half, half - 1), max_size=8)):
        counts += change
        wall.give(counts & (2 * half - 1) | ENABLED << 32)
        assert wall.row["counts"][0] == counts


def test_skipped_syncs_are_motion_and_no_jump() -> None:
    wall = gliding(20, -400, {"wall.position_rad": -0.9, "limits.speed_rad_s": 30.0})
    wall.at(-400)
    wall.cycle["skipped"] = 9
    wall.at(-400 + 10 * 20)
    assert wall.trip() == Trip.NONE
    assert wall.cycle["skipped_sync"][0] == 9
    assert wall.cycle["innovation"][0] == pytest.approx(0.0, abs=1e-9)
    wall.at(-400 + 11 * 20)
    assert wall.cycle["innovation"][0] == pytest.approx(0.0, abs=1e-9)


def test_position_after_missing_tpdos_is_a_jump_only_if_the_last_one_is_too_far_as_well() -> None:
    for far, trip in ((True, Trip.JUMP), (False, Trip.NONE)):
        wall = gliding(20, 0, {"limits.speed_rad_s": 30.0, "wall.position_rad": -2.0})
        wall.at(0)
        for _ in range(10):
            wall.missing()
        wall.cycle["estimator"]["y"] += 5.0
        wall.at(400 if far else 200)
        assert wall.trip() == trip


def test_missing_tpdos_of_late_are_counted() -> None:
    wall = gliding(0, 100, {})
    for j in range(200):
        wall.missing() if j % 5 == 0 else wall.at(100)
        recent = int(wall.cycle["missed_recently"][0]).bit_count()
        assert recent == min(j // 5 + 1, RECENT_CYCLES // 5)


# Trips


def test_position_beyond_its_limits() -> None:
    for counts, trip in ((-300, Trip.NONE), (-301, Trip.POSITION), (301, Trip.POSITION)):
        wall = Wall({"limits.position_rad": [-0.3, 0.3], "limits.speed_rad_s": 1e9})
        torque = wall.at(counts)
        assert wall.trip() == trip
        assert (torque == 0) == (trip is Trip.POSITION)


def test_speed_beyond_its_limit() -> None:
    wall = Wall({"limits.speed_rad_s": 10.0})
    start_at(wall.cycle, 2500)
    speeds = np.concatenate([np.linspace(0.0, 8.0, 200), np.full(50, 8.0)])  # counts per cycle
    for counts in 2500 - np.cumsum(speeds):
        wall.at(round(counts))
    assert wall.row["v_est"][0] == pytest.approx(-8.0, abs=1.5)
    assert wall.trip() == Trip.NONE
    position = float(round(2500 - np.cumsum(speeds)[-1]))
    for speed in np.linspace(8.0, 12.0, 100):
        position -= speed
        wall.at(round(position))
    assert wall.trip() == Trip.SPEED
    assert wall.at(round(position)) == 0


def moving(overrides: dict[str, Any], counts: int, speed: int, cycles: int = 60) -> Wall:
    """A wall that the handle goes along at a steady speed [counts per cycle], outside of it."""
    wall = Wall(overrides)
    start_at(wall.cycle, counts)
    for _ in range(cycles):
        counts += speed
        wall.at(counts)
    assert wall.trip() == Trip.NONE
    return wall


@pytest.mark.parametrize("phase", [Phase.ENABLING, Phase.RENDERING])
@pytest.mark.parametrize("missed", [0, 3])
def test_position_that_jumps(phase: Phase, missed: int) -> None:
    for counts, trip in ((12, Trip.NONE), (32 * (1 + missed) + 2, Trip.JUMP)):
        for sign in (1, -1):
            wall = Wall({"limits.jump_rad": 0.03, "limits.hold_cycles": 10})
            wall.cycle["phase"] = phase
            start_at(wall.cycle, 5)
            for _ in range(20):
                wall.at(5)
            for _ in range(missed):
                wall.missing()
            torque = wall.at(5 + sign * counts)
            assert wall.trip() == trip
            assert torque == (350 if trip is Trip.NONE and sign < 0 and phase else 0)


def test_jump_without_a_limit_of_its_own_is_what_the_speed_allows() -> None:
    for counts, trip in ((18, Trip.NONE), (24, Trip.JUMP)):
        wall = Wall({"limits.speed_rad_s": 20.0})
        start_at(wall.cycle, 500)
        for _ in range(20):
            wall.at(500)
        wall.cycle["speed_limit"] = 1e9  # the estimate makes of a jump whatever speed it likes
        wall.at(500 + counts)
        assert wall.trip() == trip


def test_jump_beyond_the_position_limits_is_a_jump() -> None:
    """A handle that a wall throws beyond them comes there without one."""
    wall = Wall({"limits.position_rad": [-0.3, 0.3], "limits.jump_rad": 0.03})
    start_at(wall.cycle, 0)
    wall.at(0)
    wall.at(400)
    assert wall.trip() == Trip.JUMP


def test_no_jump_before_the_first_position_nor_while_leaving() -> None:
    wall = Wall({"limits.position_rad": [-9.0, 9.0], "limits.speed_rad_s": 1e9})
    wall.cycle["jump_limit"] = 0.01
    wall.at(2000)
    assert wall.trip() == Trip.NONE
    start_at(wall.cycle, 2000)
    wall.cycle["phase"] = Phase.LEAVING
    wall.at(1000)
    assert wall.trip() == Trip.NONE
    wall.cycle["phase"] = Phase.RENDERING
    wall.at(2000)
    assert wall.trip() == Trip.JUMP


def test_position_that_stops_dead() -> None:
    wall = moving({"limits.stuck_cycles": 4}, 2500, -20)
    last = int(wall.cycle["counts"][0])
    trips = []
    for _ in range(5):
        wall.at(last)
        trips.append(wall.trip())
    assert trips == [Trip.NONE] * 3 + [Trip.STUCK] * 2


def test_position_that_stops_dead_where_that_is_not_watched() -> None:
    wall = moving({"limits.stuck_rad": 0.0}, 2500, -20)
    last = int(wall.cycle["counts"][0])
    for _ in range(50):
        wall.at(last)
    assert wall.trip() == Trip.NONE


def test_position_that_stops_dead_within_what_is_allowed() -> None:
    # 20 counts, 20 mrad, in a cycle.
    for stuck_rad, trip in ((0.05, Trip.STUCK), (0.2, Trip.NONE)):
        wall = moving({"limits.stuck_rad": stuck_rad}, 2500, -20)
        last = int(wall.cycle["counts"][0])
        for _ in range(10):
            wall.at(last)
        assert wall.trip() == trip


@example(per_turn=131072, period=0.00025, speed=0.9546, stop=2.0, phase=0.0, begin=0.953)
@settings(deadline=None, max_examples=150)
@given(
    per_turn=st.sampled_from([500, 2000, 8192, 131072, 1 << 20]),
    period=st.sampled_from([0.00025, 0.001, 0.004]),
    speed=st.floats(0.05, 12.0),
    stop=st.floats(2.0, 10.0),
    phase=st.floats(0.0, 1.0),
    begin=st.floats(0.0, 1.0),
)
def test_handle_that_something_stops_within_two_cycles_is_not_stuck(
    per_turn: int, period: float, speed: float, stop: float, phase: float, begin: float
) -> None:
    """By what no model knows of, along half a wave of a cosine, with encoders coarse and fine."""
    far = {"bus.cycle_s": period, "wall.position_rad": -2.9}
    wall = Wall(far, units=DriveUnits(float(per_turn), 0.637))
    since = np.clip(np.arange(100) - 40.0 + phase, 0.0, None)
    u = np.minimum(since, stop)
    slowed = u / 2.0 + stop / (2.0 * np.pi) * np.sin(np.pi * u / stop)
    way = speed * period * (np.arange(100) - since + slowed)
    counts = np.floor((2.9 - way) * per_turn / (2.0 * np.pi) + begin).astype(int)
    start_at(wall.cycle, int(counts[0]))
    for value in counts:
        wall.at(int(value))
        assert wall.trip() != Trip.STUCK


@pytest.mark.parametrize(
    ("per_turn", "speed"), [(2000, 7), (131072, 29), (131072, 100), (1 << 20, 233)]
)
def test_encoder_that_sticks_is_found_coarse_or_fine(per_turn: int, speed: int) -> None:
    wall = Wall({"wall.position_rad": -2.9}, units=DriveUnits(float(per_turn), 0.637))
    counts = 60 * speed
    start_at(wall.cycle, counts)
    for _ in range(40):
        counts -= speed
        wall.at(counts)
    for _ in range(5):
        wall.at(counts)
    assert wall.trip() == Trip.STUCK


@pytest.mark.parametrize("tremor", [0, 1])
def test_handle_that_comes_to_rest_or_creeps_is_not_stuck(tremor: int) -> None:
    wall = moving({}, 2500, -20)
    counts = float(wall.cycle["counts"][0])
    for j in range(400):
        counts -= max(20.0 * 0.7**j, 0.02)
        wall.at(round(counts) + tremor * (j % 2))
    assert wall.trip() == Trip.NONE


def test_model_with_a_mass_ten_times_too_large_takes_no_stop_for_a_stuck_encoder() -> None:
    heavy = {"mechanics.inertia_kg_m2": 1.6e-3}
    wall = moving(heavy, 2500, -20)
    counts = int(wall.cycle["counts"][0])
    for step_down in (*range(18, 0, -3), *[0] * 20):
        counts -= step_down
        wall.at(counts)
        assert wall.trip() == Trip.NONE
    assert wall.cycle["motion_missed"][0] > 2.0 * wall.cycle["stuck_limit"][0]
    wall = moving(heavy, 2500, -20)
    for _ in range(5):
        wall.at(int(wall.cycle["counts"][0]))
    assert wall.trip() == Trip.STUCK


def with_torque(wall: Wall, counts: int, actual: int, statusword: int = ENABLED) -> None:
    wall.give(counts & 0xFFFFFFFF | statusword << 32 | (actual & 0xFFFF) << 48)


@pytest.mark.parametrize("error", [-130, 130])
def test_torque_that_does_not_follow(error: int) -> None:
    limits = {"limits.torque_error_nm": 0.1, "limits.torque_error_cycles": 8}
    wall = Wall(limits)
    for _ in range(40):
        wall.at(-10)
    trips = []
    for _ in range(10):
        with_torque(wall, -10, 500 + error)
        trips.append(wall.trip())
    assert trips == [Trip.NONE] * 7 + [Trip.TORQUE] * 3
    for steady, statusword in ((error // 2, ENABLED), (error, ENABLED | 1 << 11)):
        wall = Wall(limits)
        for _ in range(40):
            wall.at(-10)
        for _ in range(40):
            with_torque(wall, -10, 500 + steady, statusword)
        assert wall.trip() == Trip.NONE


def test_torque_error_without_a_limit_of_its_own() -> None:
    # A tenth of the torque limit, and no less than 5 % of the rated torque, 1 N·m.
    for limit, error in ((2.0, 0.2), (0.1, 0.05)):
        wall = Wall({"limits.torque_nm": limit})
        assert wall.cycle["torque_error_limit"][0] == pytest.approx(error)
    wall = Wall({"limits.torque_error_nm": 0.0})
    assert wall.cycle["torque_error_limit"][0] == np.inf


@pytest.mark.parametrize("delay", [1, 3])
def test_torque_that_lags_follows(delay: int) -> None:
    """A chattering wall, a first-order lag of four cycles and a dead time."""
    wall = Wall({"limits.torque_error_nm": 0.1})
    actual, sent = 0.0, [0] * delay
    for j in range(2000):
        actual += (sent[-delay] - actual) / 4.0
        with_torque(
            wall, -round(10.0 + 10.0 * np.sin(j * 2.0 * np.pi / (10 + j // 20))), round(actual)
        )
        sent.append(wall.torque())
    assert max(sent) > 900
    assert wall.trip() == Trip.NONE


@pytest.mark.parametrize("phase", [Phase.RENDERING, Phase.MEASURING])
def test_no_torque_without_a_tpdo_once_something_has_ended_the_wall(phase: Phase) -> None:
    wall = Wall()
    wall.cycle["phase"] = phase
    wall.cycle["test_per_mille"] = 100
    wall.at(-10)
    assert wall.torque() != 0
    wall.cycle["trip"] = Trip.REPORTED
    assert wall.missing() == 0


def test_estimate_that_is_not_a_number_is_beyond_the_speed_limit() -> None:
    wall = Wall()
    wall.cycle["estimator"]["v"] = np.nan
    assert wall.at(-10) == 0
    assert wall.trip() == Trip.SPEED


@pytest.mark.parametrize("statusword", [0x0250, 0x0231, 0x0233, 0x0217, 0x0218, 0x021F, 0x0000])
def test_drive_that_is_not_enabled(statusword: int) -> None:
    wall = Wall()
    assert wall.at(-10) == 500
    assert wall.at(-10, statusword) == 0
    assert wall.trip() == Trip.NOT_ENABLED


@pytest.mark.parametrize("tension", ["allow", "clamp", "budget"])
@pytest.mark.parametrize("value", ["math.nan", "math.inf", "-math.inf"])
def test_law_whose_force_is_not_a_number(tmp_path: Path, value: str, tension: str) -> None:
    file = tmp_path / "wrong.py"
    file.write_text(
        f"import math\n\ndef wrong(wall):\n    return {value} if wall.y_sample < 0.0 else 0.0\n"
    )
    wall = Wall({"wall.law": f"{file}:wrong", "wall.tension": tension})
    assert wall.at(1) == 0
    assert wall.trip() == Trip.NONE
    assert wall.at(-10) == 0
    assert wall.trip() == Trip.NOT_A_NUMBER
    assert wall.row["force"][0] == 0.0


# The wall


def strike() -> NDArray[np.int64]:
    """Counts of a handle that comes in, bounces and leaves."""
    t = np.arange(400) * 1e-3
    counts: NDArray[np.int64] = np.round(60.0 - 900.0 * t + 4.0 * np.sin(300.0 * t)).astype(int)
    return np.concatenate([counts[:80], counts[80::-1]])


@pytest.mark.parametrize("law", ["standard", "damped", "midpoint", "half_sample"])
def test_wall_above_mirrors_the_wall_below(law: str) -> None:
    common = {"wall.law": law, "wall.damping_nm_s_per_rad": 0.1, "limits.torque_nm": 0.4}
    below = Wall(common | {"wall.side": "below", "wall.position_rad": 0.0301})
    above = Wall(common | {"wall.side": "above", "wall.position_rad": -0.0301})
    for wall, sign in ((below, 1), (above, -1)):
        start_at(wall.cycle, sign * 60)
    forces = set()
    for counts in strike():
        assert below.at(int(counts)) == -above.at(-int(counts))
        for same in ("y", "y_est", "v_est", "d_est", "force", "force_applied"):
            assert below.row[same][0] == above.row[same][0], same
        for opposite in ("position_rad", "torque_cmd", "torque_applied", "wall_position_rad"):
            assert below.row[opposite][0] == -above.row[opposite][0], opposite
        forces.add(below.torque())
    assert max(forces) == 400  # into the limit, and back out
    assert len(forces) > 5


def test_wall_is_changed_between_two_cycles() -> None:
    wall = Wall({"wall.law": "standard", "wall.stiffness_nm_per_rad": 50.0})
    wall.at(0)
    assert wall.at(-10) == 500
    estimate = wall.cycle["estimator"].copy()
    stiffer = wall.settings.wall.model_copy(
        update={"stiffness_nm_per_rad": 20.0, "position_rad": 0.005}
    )
    set_wall(wall.cycle, stiffer, wall.laws)
    assert wall.cycle["estimator"] == estimate
    assert wall.at(-10) == 300
    assert wall.row["y"][0] == pytest.approx(-0.015)
    assert wall.row["stiffness"][0] == 20.0


def test_another_law_starts_without_memories() -> None:
    wall = Wall()
    assert [law.name for law in wall.laws] == ["standard", "half_sample"]
    wall.cycle["rendered"]["wall"]["memory"] = 7.0
    set_wall(wall.cycle, wall.settings.wall, wall.laws)
    assert wall.cycle["rendered"]["wall"]["memory"].item(0) == 7.0
    other = wall.settings.wall.model_copy(update={"law": "half_sample"})
    set_wall(wall.cycle, other, wall.laws)
    assert wall.cycle["rendered"]["law"][0] == 1
    assert not wall.cycle["rendered"]["wall"]["memory"].any()


def test_law_that_nobody_knows() -> None:
    wall = Wall()
    with pytest.raises(UnknownLawError):
        set_wall(wall.cycle, wall.settings.wall.model_copy(update={"law": "none"}), wall.laws)


@pytest.mark.parametrize(
    ("told", "adapt", "given", "modelled"),
    [
        (0.95, True, None, 1.05),
        (0.95, False, None, 0.95),
        (0.95, False, 0.3, 1.25),
        (1.0, True, 0.0, 1.0),
        (2.95, True, None, 3.0),
    ],
)
def test_model_has_a_margin_of_the_delay_and_what_acted_has_none(
    told: float, adapt: bool, given: float | None, modelled: float
) -> None:
    keys = {"estimator.delay_cycles": told, "operator.adapt": adapt, "wall.law": "mean_force"}
    if given is not None:
        keys["estimator.delay_margin_cycles"] = given
    wall = Wall(keys)
    wall.cycle["bank"]["regression"]["excess_before"] = 1e18, 0.0  # it is as told
    estimator = wall.cycle["estimator"][0, 0]
    share = estimator["before"]["duration"] / wall.cycle["period"][0]
    assert estimator["delay_periods"] + share == pytest.approx(modelled)
    commanded, applied = [], []
    for counts in (0, -4, -9, -12, -9, -4):
        wall.at(counts)
        commanded.append(wall.row["torque_cmd"][0])
        applied.append(wall.row["torque_applied"][0])
    assert len(set(commanded[1:])) > 3
    whole = int(told)
    rest = told - whole
    for j in range(whole + 1, len(commanded)):
        older = rest * commanded[j - whole - 1] if rest else 0.0
        expected = older + (1.0 - rest) * commanded[j - whole]
        assert applied[j] == pytest.approx(expected, rel=1e-9)
