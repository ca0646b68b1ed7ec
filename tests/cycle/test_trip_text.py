"""Text of a trip after a pause of the master, or after missing TPDOs."""

import pytest
from rig import Loop, RigFactory, lack, settings_with

from canwall.cycle.trip_text import trip_text
from canwall.cycle.trips import Trip

#: Of simulated time.
WAITS = "the drive's watchdog ({}) waits 30000 ms"


@pytest.mark.parametrize(
    ("kind", "pause_s", "said"),
    [
        ("RPDO event timer", 29.9, None),
        ("RPDO event timer", 30.1, f"30.1 s, {WAITS}"),
        # The drive had heard of its master up to a period before the pause.
        ("life guarding", 20.1, f"20.1 s, {WAITS} for a frame every 10000 ms"),
        ("life guarding", 19.9, None),
    ],
)
def test_pause_that_the_watchdog_may_have_met(
    make_rig: RigFactory, kind: str, pause_s: float, said: str | None
) -> None:
    rig = make_rig(settings_with())
    if kind == "life guarding":
        lack(rig, 0x1400, 0x1016)
    loop = Loop(rig)
    assert loop.setup.watchdog.kind == kind
    loop.record["trip"] = Trip.REPORTED
    loop.axis.reported = "EMCY"
    loop.exchange.sync_interval["largest_ns"] = round(pause_s * 1e9)
    end = f"; the master had stood still for {said.format(kind)}" if said else ""
    assert trip_text(loop.axis, loop.exchange).endswith(f" s): EMCY{end}")


@pytest.mark.parametrize("trip", [Trip.SPEED, Trip.POSITION, Trip.JUMP, Trip.STUCK, Trip.ENERGY])
def test_trip_after_missing_tpdos_names_them(make_rig: RigFactory, trip: Trip) -> None:
    loop = Loop(make_rig(settings_with()))
    loop.record["trip"] = trip
    encoder = "look to the encoder and its cable, and to [mechanics] and [simulation]"
    without = trip_text(loop.axis, loop.exchange)
    assert ("TPDO" in without, encoder in without) == (False, trip is Trip.JUMP)
    loop.record["missed_recently"] = 0b1011
    said = trip_text(loop.axis, loop.exchange)
    assert said.endswith(
        "; 3 of the last 50 TPDOs were missing: look to the bus, its load and its termination, "
        "first"
    )
    assert encoder not in said


def test_jump_beyond_the_position_limits_names_these(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(settings_with()))
    loop.record["trip"] = Trip.JUMP
    loop.axis.row["position_rad"] = 3.5
    said = trip_text(loop.axis, loop.exchange)
    assert "position 3.5 rad outside limits.position_rad, by a jump of " in said
    assert said.endswith(" rad: look to the encoder and its cable")


@pytest.mark.parametrize("side", ["below", "above"])
def test_speed_is_that_of_the_drive_s_axis(make_rig: RigFactory, side: str) -> None:
    loop = Loop(make_rig(settings_with({"wall.side": side})))
    loop.record["trip"] = Trip.SPEED
    loop.record["estimator"]["v"] = 70.0 * loop.axis.settings.wall.orientation
    assert "speed 70 rad/s" in trip_text(loop.axis, loop.exchange)


def test_late_tpdos_are_named_where_none_came_in_time(make_rig: RigFactory) -> None:
    settings = settings_with()
    bus = settings.bus.model_copy(update={"pace": "real_time"})
    loop = Loop(make_rig(settings))
    loop.axis.settings = settings.model_copy(update={"bus": bus})
    loop.record["trip"], loop.record["missed_in_a_row"] = Trip.MISSED_TPDO, 12
    assert trip_text(loop.axis, loop.exchange).endswith("no TPDO for 12 cycles")
    loop.axis.frames["late_tpdo"], loop.axis.frames["late_tpdo_ns"] = 12, 930_000
    assert trip_text(loop.axis, loop.exchange).endswith(
        "no TPDO for 12 cycles; 12 came too late, the last one 0.93 ms after its SYNC: bus.cycle_s "
        "is too short for the drive or the bus"
    )
