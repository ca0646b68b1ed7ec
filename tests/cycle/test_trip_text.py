"""Text of a trip after a pause of the master."""

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
