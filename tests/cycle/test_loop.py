"""The whole loop against the simulated drive: one way in, one way out, whatever happens."""

import gc
import struct
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus
from numpy.typing import NDArray
from rig import RPDO1, SDO_REQUEST, SYNC, TPDO1, Loop, Rig, RigFactory, lack, settings_with

from canwall.bus.can_ids import NMT
from canwall.config import Settings
from canwall.cycle import Outcome, WallStage, run_loop, way_out
from canwall.cycle import exchange as exchange_module
from canwall.record import Phase

#: The hand strikes from cycle 200 on; by this one it rests on the wall and presses until 800.
PRESSING = 500
EMCY = 0x085
UP, DOWN = [0x00, 0x06, 0x07, 0x0F], [0x00]


@pytest.fixture(autouse=True)
def _no_long_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange_module, "_SIMULATED_TIMEOUT_S", 0.02)
    monkeypatch.setattr(exchange_module, "_MISSING_TIMEOUT_S", 0.002)


@pytest.fixture(autouse=True)
def _collector_is_as_before() -> Any:
    assert gc.isenabled()
    yield
    assert gc.isenabled()


def pressing(overrides: dict[str, Any] | None = None) -> Settings:
    """A wall on which the hand rests, so that there is a torque to be taken away."""
    return settings_with({"wall.law": "half_sample"} | (overrides or {}))


def steps(words: list[int]) -> list[int]:
    """Controlwords without their repetitions."""
    return [word for word, before in zip(words, [None, *words], strict=False) if word != before]


def assert_ended_in_order(loop: Loop, outcome: Outcome, rows: NDArray[np.void]) -> None:
    """Zero torque on the bus as the state machine goes down, and the drive says it is down."""
    leaving = rows[rows["phase"] == Phase.LEAVING]
    assert outcome.disabled
    assert not leaving["torque_cmd_per_mille"].any()
    assert loop.rig.rpdos()[-len(leaving) :] == [(int(w), 0) for w in leaving["controlword"]]
    assert steps(leaving["controlword"].tolist()) == DOWN
    assert loop.rig.node.read(0x6041) & 0x6F == 0x40
    assert loop.rig.node.read(0x6077) == 0


def assert_never_enabled(loop: Loop) -> None:
    assert all(torque == 0 for _, torque in loop.rig.rpdos())
    assert all(word & 0x0F != 0x0F for word, _ in loop.rig.rpdos())


# In order


def test_in_and_out(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    collecting: list[bool] = []

    def listen(j: int) -> bool:
        collecting.append(gc.isenabled())
        return False

    outcome = loop.run(500, listen)
    assert outcome.trips == []
    assert not outcome.interrupted
    rows = loop.rows()
    assert outcome.cycles == len(rows) == rows["j"][-1] + 1
    assert rows["j"].tolist() == list(range(len(rows)))
    assert np.diff(rows["phase"].astype(int)).min() == 0  # enabling, rendering, leaving
    assert rows["j"][rows["phase"] == Phase.RENDERING][-1] == 499
    enabling = rows[rows["phase"] == Phase.ENABLING]
    assert steps(enabling["controlword"].tolist()) == UP[: len(steps(enabling["controlword"]))]
    assert not enabling["torque_cmd_per_mille"].any()
    # The handle rests at 0.1 rad: the estimator has nothing to find out.
    assert np.abs(enabling["v_est"][1:]).max() < 0.01
    assert np.abs(rows["torque_cmd_per_mille"]).max() > 50
    assert not any(collecting)
    assert_ended_in_order(loop, outcome, rows)


def test_torque_is_applied_by_the_sync_after_the_rpdo(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.run(500)
    rows = loop.rows()
    nm = loop.setup.units.nm_per_mille
    assert np.array_equal(rows["torque_applied"][1:], rows["torque_cmd_per_mille"][:-1] * nm)


@pytest.mark.parametrize("kind", ["RPDO event timer", "consumer heartbeat", "life guarding"])
def test_drive_that_is_disabled_does_not_miss_its_master(make_rig: RigFactory, kind: str) -> None:
    rig = make_rig(pressing())
    if kind != "RPDO event timer":
        lack(rig, 0x1400)
    if kind == "life guarding":
        lack(rig, 0x1016)
    for _ in range(2):  # and a second run is as good as the first
        loop = Loop(rig)
        assert loop.setup.watchdog.kind == kind
        outcome = loop.run(PRESSING)
        assert (outcome.trips, outcome.notes) == ([], [])
        assert np.abs(loop.rows()["torque_cmd_per_mille"]).max() > 50
        # Longer than any watchdog of simulated time.
        assert [frame for frame in rig.tampering.tick(100.0) if frame[0] == EMCY] == []
    assert rig.node.emergencies == []


def test_watchdog_that_cannot_be_switched_off_is_said(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.rig.tampering.read_only[(0x1400, 5)] = 0x06010002
    outcome = loop.run(PRESSING)
    assert outcome.trips == []
    assert outcome.disabled
    (note,) = outcome.notes
    assert note.startswith("the drive's watchdog (RPDO event timer) stays set: node 5: writing 0x0")


def test_watchdog_stays_set_while_the_drive_may_give_torque(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))

    def deafen(j: int) -> bool:
        if j == PRESSING:
            loop.rig.tampering.deaf.update((RPDO1, SDO_REQUEST, 0x000))
        return j > 1000

    outcome = loop.run(None, deafen)
    assert not outcome.disabled
    loop.rig.runner.poll()  # the last of what it does not hear: NMT RESET NODE
    loop.rig.tampering.deaf.clear()
    assert loop.rig.node.read(0x1400, 5) == 30_000


def test_stopped_in_the_middle(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    outcome = loop.run(None, lambda j: j >= PRESSING)
    assert outcome.interrupted
    assert outcome.trips == []
    assert loop.rig.rpdos()[PRESSING - 1][1] != 0
    assert_ended_in_order(loop, outcome, loop.rows())
    assert outcome.cycles < PRESSING + 10


@pytest.mark.parametrize("j", [0, 1, 3])
def test_stopped_while_enabling(make_rig: RigFactory, j: int) -> None:
    loop = Loop(make_rig(pressing()))
    outcome = loop.run(None, lambda now: now >= j)
    assert outcome.interrupted
    assert outcome.disabled
    assert all(torque == 0 for _, torque in loop.rig.rpdos())
    assert loop.rig.node.read(0x6041) & 0x6F == 0x40


def test_changes_take_effect_at_their_cycle(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"run.blend_s": 0.0}))  # its schedule has both laws
    loop = Loop(rig)
    wall, limits = rig.settings.wall, rig.settings.limits
    changes = [
        WallStage(300, wall.model_copy(update={"law": "half_sample"}), limits),
        WallStage(310, wall.model_copy(update={"stiffness_nm_per_rad": 20.0}), limits),
        WallStage(310, wall.model_copy(update={"position_rad": -0.01}), limits),
    ]
    loop.run(400, changes=changes)
    rows = loop.rows()
    assert np.flatnonzero(np.diff(rows["law"])).tolist() == [299, 309]
    assert np.flatnonzero(np.diff(rows["wall_position_rad"])).tolist() == [309]
    assert rows["wall_position_rad"][310] == -0.01
    assert set(rows["stiffness"]) == {50.0}  # the later change of the same cycle has the last word


def test_progress_is_told_now_and_then(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    told: list[int] = []
    loop.run(450, progress=told.append)
    assert told == [100, 200, 300, 400]


@pytest.mark.slow
@pytest.mark.parametrize(
    "otherwise",
    [
        {},
        {"mechanics.inertia_kg_m2": 1.6e-3},
        {"mechanics.inertia_kg_m2": 3e-5},
        {"mechanics.coulomb_nm": 0.0, "simulation.coulomb_nm": 0.03},
        {"simulation.current_bandwidth_hz": 300.0, "simulation.torque_delay_cycles": 1.5},
        {"bus.cycle_s": 0.00025},
        {"bus.cycle_s": 0.01},
    ],
    ids=str,
)
@pytest.mark.parametrize("law", ["standard", "half_sample", "rigid"])
def test_no_limit_takes_a_strike_for_a_fault(
    make_rig: RigFactory, law: str, otherwise: dict[str, Any]
) -> None:
    """Chattering, stopped dead, with a model far off, a current loop that lags: none is a fault."""
    stiff = {"wall.law": law, "wall.stiffness_nm_per_rad": 300.0}
    loop = Loop(make_rig(settings_with(stiff | otherwise)))
    assert loop.run(round(1.05 / loop.rig.settings.bus.cycle_s)).trips == []


# Before enabling


def test_start_inside_the_wall_comes_without_a_kick(make_rig: RigFactory) -> None:
    inside = {"wall.position_rad": 0.11, "run.ramp_in_s": 0.1}
    loop = Loop(make_rig(pressing(inside)))  # the handle rests at 0.1 rad
    outcome = loop.run(150)
    assert outcome.trips == []
    rows = loop.rows()
    rows = rows[rows["phase"] == Phase.RENDERING]
    assert rows["y"][0] == pytest.approx(-0.01, abs=1e-4)
    full = 50.0 * 0.01
    assert np.diff(rows["force"][:100], prepend=0.0).max() < 0.02 * full
    # The wall is stiffer than the finger by far: it moves the handle to its surface.
    assert rows["y"][-1] > -0.001
    # The wall holds the finger's spring, which is about 0.1 rad: 3.2 N·m/rad times 0.0093 rad.
    assert rows["force"][-1] == pytest.approx(0.03, abs=0.01)


def test_no_tpdo_at_all(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.rig.tampering.mute.add(TPDO1)
    outcome = loop.run(500)
    assert outcome.trips == ["no TPDO within 10 SYNCs"]
    assert outcome.disabled  # SDO still says so
    assert_never_enabled(loop)
    assert loop.rig.node.read(0x6041) & 0x6F == 0x40


def test_drive_that_never_enables(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.rig.tampering.deaf.add(RPDO1)
    outcome = loop.run(500)
    assert outcome.trips == [
        "the drive stays in SWITCH ON DISABLED (statusword 0x0250: voltage enabled, remote)"
    ]
    assert outcome.disabled
    assert all(torque == 0 for _, torque in loop.rig.rpdos())


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (None, ""),
        ((SYNC, b""), "; somebody else sends SYNC (0x080) as well: end it, or set bus.sync"),
        ((NMT, b"\x80\x00"), "; somebody else has sent NMT PRE-OPERATIONAL (0x000): end it"),
        ((NMT, b"\x80\x07"), ""),  # another node
        ((0x705, b"\x7f"), "; the drive is in NMT PRE-OPERATIONAL"),
    ],
)
def test_drive_that_falls_silent_while_it_is_enabled(
    make_rig: RigFactory, frame: tuple[int, bytes] | None, reason: str
) -> None:
    loop = Loop(make_rig(pressing()))

    def silence(j: int) -> bool:
        if j == 2:
            loop.rig.tampering.mute.add(TPDO1)
        if j == 3 and frame is not None:
            loop.rig.inject(*frame)
        return False

    outcome = loop.run(500, silence)
    assert outcome.trips == [f"no TPDO for 50 cycles while enabling{reason}"]
    assert outcome.disabled  # SDO still says so
    assert all(torque == 0 for _, torque in loop.rig.rpdos())


def test_drive_in_fault_is_reset(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    node = loop.rig.node
    node.write(0x6007, 0, 1)  # what aborts the connection is a fault
    for word in (0x06, 0x07, 0x0F):
        node.write(0x6040, 0, word)
    node.command("PRE-OPERATIONAL")
    while node.read(0x6041) & 0x4F != 0x08:
        pass
    node.command("OPERATIONAL")
    outcome = loop.run(300)
    assert outcome.trips == []
    assert steps([word for word, _ in loop.rig.rpdos()])[:6] == [0x00, 0x80, 0x00, 0x06, 0x07, 0x0F]
    assert_ended_in_order(loop, outcome, loop.rows())


def test_fault_that_comes_back_after_every_reset(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    out, shown = loop.rig.tampering._out, iter(range(10**6))

    def lying(frames: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
        words = (b"\x18\x02", b"\x50\x02")  # FAULT, SWITCH ON DISABLED
        return [
            (i, data[:4] + words[next(shown) % 2] + data[6:] if i == TPDO1 else data)
            for i, data in out(frames)
        ]

    loop.rig.tampering._out = lying  # type: ignore[method-assign]
    outcome = loop.run(300)
    assert outcome.trips[0].startswith("the fault comes back after every reset")
    assert all(torque == 0 for _, torque in loop.rig.rpdos())


# Trips


def trip_of(loop: Loop, happens: Callable[[int], None]) -> str:
    """Return the text of the trip when something happens in the middle of the contact."""

    def once(j: int) -> bool:
        if j == PRESSING:
            happens(j)
        return j > 20_000

    outcome = loop.run(None, once)
    (trip,) = outcome.trips
    assert not outcome.interrupted
    torques = [torque for _, torque in loop.rig.rpdos()]
    assert torques[PRESSING - 1] != 0
    return trip


def test_drive_that_another_master_disables(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    disable = struct.pack("<BHBL", 0x2B, 0x6040, 0, 0)
    trip = trip_of(loop, lambda j: loop.rig.inject(SDO_REQUEST, disable))
    assert trip == (
        "cycle 500 (0.500 s): the drive left OPERATION ENABLED: SWITCH ON DISABLED "
        "(statusword 0x0250: voltage enabled, remote)"
    )
    assert loop.rig.rpdos()[-1] == (0x00, 0)


def test_drive_in_fault_is_named_with_its_emergency(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.rig.node.write(0x6007, 0, 1)
    loop.rig.node.write(0x1016, 1, 0x7F0001)  # misses the heartbeat of node 127 after 1 ms
    trip = trip_of(loop, lambda j: loop.rig.inject(0x77F, b"\x05"))
    assert trip.endswith("EMCY 0x8130 (Monitoring), register 0x11")
    assert loop.rig.rpdos()[-1][1] == 0


def test_emergency_that_is_only_to_be_noted(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing({"limits.emergency": "note"})))

    def warn(j: int) -> bool:
        if j == PRESSING:
            loop.rig.inject(0x085, b"\x10\x42\x08\0\0\0\0\0")
        return False

    outcome = loop.run(PRESSING + 20, warn)
    assert outcome.trips == []
    assert loop.monitor.notes == ["node 5: cycle 500: EMCY 0x4210 (Temperature), register 0x08"]


def test_torque_is_zero_in_the_cycle_of_the_emergency(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    trip_of(loop, lambda j: loop.rig.inject(0x085, b"\x10\x23\x03\0\0\0\0\0"))
    assert loop.rig.rpdos()[PRESSING][1] == 0


@pytest.mark.parametrize(
    ("state", "text"),
    [
        (0x00, "the drive restarted, or a second one with its node-ID started"),
        (0x04, "the drive is in NMT STOPPED"),
        (0xFF, "the drive is in NMT PRE-OPERATIONAL"),
    ],
)
def test_heartbeat_that_tells_of_another_state(make_rig: RigFactory, state: int, text: str) -> None:
    loop = Loop(make_rig(pressing()))
    trip = trip_of(loop, lambda j: loop.rig.inject(0x705, bytes([state])))
    assert trip == f"cycle 500 (0.500 s): {text}"


def test_heartbeat_of_a_drive_that_is_well_says_nothing(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    loop.rig.inject(0x705, b"\x05")
    assert loop.run(300).trips == []


def test_second_producer_of_the_sync(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    trip = trip_of(loop, lambda j: loop.rig.inject(SYNC, b""))
    assert (
        trip
        == "cycle 500 (0.500 s): somebody else sends SYNC (0x080) as well: end it, or set bus.sync"
    )


@pytest.mark.parametrize(
    ("can_id", "data", "text"),
    [
        (
            RPDO1,
            b"\x0f\x00\x64\x00",
            "somebody else sends RPDOs (0x205) to the drive as well: end it",
        ),
        (NMT, b"\x80\x05", "somebody else has sent NMT PRE-OPERATIONAL (0x000): end it"),
        (NMT, b"\x81\x00", "somebody else has sent NMT RESET NODE (0x000): end it"),
    ],
)
def test_second_master(make_rig: RigFactory, can_id: int, data: bytes, text: str) -> None:
    loop = Loop(make_rig(pressing()))
    trip = trip_of(loop, lambda j: loop.rig.inject(can_id, data))
    assert trip == f"cycle 500 (0.500 s): {text}"


@pytest.mark.parametrize(("can_id", "data"), [(NMT, b"\x01\x00"), (NMT, b"\x80\x07"), (0x207, b"")])
def test_frames_for_others_say_nothing(make_rig: RigFactory, can_id: int, data: bytes) -> None:
    loop = Loop(make_rig(pressing()))
    outcome = loop.run(300, lambda j: j == PRESSING or loop.rig.inject(can_id, data) or False)
    assert outcome.trips == []


def test_error_frames_are_counted_and_bus_off_ends_the_run(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))

    def report(kind: int) -> None:
        loop.rig.drive_bus.send(
            can.Message(arbitration_id=kind, is_error_frame=True, dlc=8, data=bytes(8))
        )

    def happens(j: int) -> bool:
        if j in (300, 400, PRESSING):
            report(0x40 if j == PRESSING else 0x04)  # bus-off, controller problems
        return False

    outcome = loop.run(None, happens)
    (trip,) = outcome.trips
    assert trip.endswith("the adapter is bus-off: look at bit rate, cable and termination")
    assert outcome.trip_cycle is not None
    assert PRESSING <= outcome.trip_cycle <= PRESSING + 1  # in the cycle that hears of it
    assert loop.monitor.error_frames == 3


def test_drive_that_falls_silent(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing({"limits.hold_cycles": 3, "limits.ramp_cycles": 5})))
    trip = trip_of(loop, lambda j: loop.rig.tampering.mute.add(TPDO1))
    assert trip == "cycle 507 (0.507 s): no TPDO for 8 cycles"
    rpdos = loop.rig.rpdos()
    held = rpdos[PRESSING - 1][1]
    torques = [torque for _, torque in rpdos[PRESSING : PRESSING + 8]]
    assert torques[:3] == [held] * 3
    assert torques[3:] == pytest.approx([held * (4 - i) / 5 for i in range(5)], abs=1.5)
    # It hears though it is not heard: quick stop, then down.
    assert rpdos[PRESSING + 8] == (0x02, 0)
    assert all(rpdo == (0x00, 0) for rpdo in rpdos[PRESSING + 9 :])
    assert loop.rig.node.read(0x6041) & 0x6F in (0x40, 0x07)


@pytest.mark.slow
def test_speed_and_position_limits_end_the_run(make_rig: RigFactory) -> None:
    for limit, value, text in (
        ("limits.speed_rad_s", 0.5, "rad/s beyond limits.speed_rad_s"),
        ("limits.position_rad", [-1.0, 0.05], "outside limits.position_rad"),
    ):
        loop = Loop(make_rig(pressing({limit: value})))
        outcome = loop.run(1000)
        (trip,) = outcome.trips
        assert text in trip
        assert_ended_in_order(loop, outcome, loop.rows())


def test_energy_put_out_in_one_contact_ends_the_run(make_rig: RigFactory) -> None:
    active = {"wall.law": "standard", "limits.energy_j": 1e-3}
    loop = Loop(make_rig(settings_with(active)))
    outcome = loop.run(1000)
    (trip,) = outcome.trips
    assert "J in this contact, beyond limits.energy_j" in trip
    rows = loop.rows()
    assert_ended_in_order(loop, outcome, rows)
    # The same by hand: work of the applied force since the contact began.
    end = int(np.flatnonzero(rows["j"] == outcome.trip_cycle)[0])
    force, y = rows["force_applied"], rows["y"]
    begin = end - int(np.argmax((y[end::-1] >= 0.0) & (force[end::-1] == 0.0)))
    work = float(np.sum(force[begin:end] * np.diff(y[begin : end + 1])))
    assert work > 1e-3
    assert work - force[end - 1] * (y[end] - y[end - 1]) <= 1e-3
    assert f"{work:.3g} J" in trip


# A bus that fails


over_python_can = pytest.mark.parametrize("native", ["python-can"], indirect=True)


class FailingBus(VirtualBus):
    """Fails to send what `fails` picks."""

    fails: Callable[[can.Message], bool] = staticmethod(lambda message: False)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.fails(msg):
            raise can.CanOperationError("transmit buffer full")
        super().send(msg, timeout)


def failing_rig(make_rig: RigFactory) -> tuple[Rig, FailingBus]:
    rig = make_rig(pressing(), bus=FailingBus)
    assert isinstance(rig.bus, FailingBus)
    return rig, rig.bus


@over_python_can
def test_bus_that_fails_once_is_left_in_order(make_rig: RigFactory) -> None:
    rig, bus = failing_rig(make_rig)
    loop = Loop(rig)
    times = 0

    def once(message: can.Message) -> bool:
        nonlocal times
        times += message.arbitration_id == RPDO1
        return times == PRESSING and message.arbitration_id == RPDO1

    bus.fails = once
    outcome = loop.run(None)
    assert outcome.trips == ["the bus failed: transmit buffer full"]
    assert_ended_in_order(loop, outcome, loop.rows())


@over_python_can
@pytest.mark.parametrize("can_id", [SYNC, RPDO1])
def test_cycle_that_fails_for_good_is_left_by_sdo(make_rig: RigFactory, can_id: int) -> None:
    rig, bus = failing_rig(make_rig)
    loop = Loop(rig)

    def fail_from_now_on(j: int) -> bool:
        if j == PRESSING:
            bus.fails = lambda message: message.arbitration_id == can_id
        return False

    outcome = loop.run(None, fail_from_now_on)
    assert outcome.trips == ["the bus failed: transmit buffer full"]
    assert outcome.disabled
    assert rig.node.read(0x6041) & 0x6F == 0x40
    assert rig.node.read(0x6071) == 0


@over_python_can
def test_bus_that_is_gone(make_rig: RigFactory) -> None:
    rig, bus = failing_rig(make_rig)
    loop = Loop(rig)

    def fail_from_now_on(j: int) -> bool:
        if j == PRESSING:
            bus.fails = lambda message: True
        return False

    outcome = loop.run(None, fail_from_now_on)
    assert len(outcome.trips) == 2
    assert outcome.trips[1] == (
        "the drive did not confirm that it is disabled (node 5: writing 0x0 to 0x6040:00 failed: "
        "transmit buffer full), NMT RESET NODE could not be sent: switch it off before you touch it"
    )
    assert not outcome.disabled
    assert not any("\n" in trip for trip in outcome.trips)


@over_python_can
def test_bus_that_fails_at_the_very_first_frame(make_rig: RigFactory) -> None:
    rig, bus = failing_rig(make_rig)
    loop = Loop(rig)
    bus.fails = lambda message: message.arbitration_id == SYNC
    outcome = loop.run(None)
    assert outcome.trips[0] == "the bus failed: transmit buffer full"
    assert outcome.cycles == 0
    assert outcome.disabled


def test_exception_of_the_program_itself_ends_in_order(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))

    def wrong(j: int) -> bool:
        if j == PRESSING:
            raise ZeroDivisionError
        return False

    with pytest.raises(ZeroDivisionError):
        loop.run(None, wrong)
    assert steps([word for word, _ in loop.rig.rpdos()])[-1:] == DOWN
    assert loop.rig.rpdos()[-1] == (0x00, 0)
    assert loop.rig.node.read(0x6041) & 0x6F == 0x40


def test_exchange_that_fails_for_good_is_left_by_sdo(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing()))
    outcome = Outcome()

    def fail(most: int = 1) -> None:
        raise ValueError("no cycle any more")

    def fail_from_now_on() -> bool:
        if loop.record["j"][0] == PRESSING:
            loop.exchange.cycle = fail  # type: ignore[method-assign]
        return False

    with pytest.raises(ValueError, match="no cycle any more"):
        run_loop(loop.exchange, lambda loop: loop.render(None), fail_from_now_on, outcome=outcome)
    assert outcome.trips == ["the program failed: ValueError: no cycle any more"]
    assert outcome.disabled
    assert loop.rig.node.read(0x6041) & 0x6F == 0x40
    assert loop.rig.node.read(0x6071) == 0


def test_lost_drive_is_reset_after_a_forged_heartbeat(make_rig: RigFactory) -> None:
    rig = make_rig(pressing())
    loop = Loop(rig)

    def lose(j: int) -> bool:
        if j == PRESSING:
            rig.inject(0x705, b"\x3b")
            rig.tampering.mute.update((SDO_REQUEST - 0x80, TPDO1))
        return False

    outcome = loop.run(None, lose)
    assert "is in NMT state 59" in outcome.trips[0]
    assert "NMT RESET NODE was sent: switch it off before you touch it" in outcome.trips[-1]
    assert (0x000, b"\x81\x05") in rig.frames


def test_lost_tpdos_are_those_that_the_simulation_loses(make_rig: RigFactory) -> None:
    fault = {"kind": "lost", "can_id": TPDO1, "at_sync": 50, "duration_syncs": 1}
    loop = Loop(make_rig(settings_with({"simulation.fault": [fault]})))
    assert loop.run(100).trips == []
    rows = loop.rows()
    assert rows["j"][~rows["received"].astype(bool)].tolist() == [50]
    assert loop.record["missed_tpdo"][0] == 1


# RPDOs that come too late, in real time: a drive that answers after the next SYNC is due


def answering_late(loop: Loop, late: Callable[[int], bool]) -> None:
    """In the cycles that are picked the TPDO comes when the next SYNC is over-due."""
    process = loop.rig.tampering.process

    def slow(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        if can_id == SYNC and late(int(loop.record["j"][0])):
            time.sleep(0.0013)
        return process(can_id, data)

    loop.rig.tampering.process = slow  # type: ignore[method-assign]


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [1, 1000])
def test_late_rpdos_end_the_run(make_rig: RigFactory, ahead: int) -> None:
    # A machine that is late by itself may end a run before there is a torque; one that stands still
    # moves its SYNCs, and the count begins anew: once more, then.
    for _ in range(4):
        loop = Loop(make_rig(pressing({"limits.late_cycles": 30})), real_time=True)
        loop.exchange.ahead = ahead
        counts: dict[int, int] = {}

        def late(j: int, loop: Loop = loop, counts: dict[int, int] = counts) -> bool:
            counts[j] = int(loop.axis.late_in_a_row)
            return j >= PRESSING

        answering_late(loop, late)
        outcome = loop.run(None)
        assert outcome.trip_cycle is not None
        if PRESSING < outcome.trip_cycle <= PRESSING + 30:
            break
    (trip,) = outcome.trips
    assert trip.endswith(
        ": RPDOs after the next SYNC for 30 cycles, limits.late_cycles = 30: the machine is too "
        "slow for bus.cycle_s"
    )
    # Of the cycles before some may have been late as well: the machine has other things to do.
    assert outcome.trip_cycle <= PRESSING + 30
    first = outcome.trip_cycle - 30
    # A cycle that was over before its SYNC was processed has no count.
    row = {j: n for j, n in counts.items() if first <= j < outcome.trip_cycle}
    assert row == {j: j - first for j in row}
    assert len(row) > 15
    assert max(n for j, n in counts.items() if j < outcome.trip_cycle) < 30
    assert loop.axis.late_rpdo >= 30
    rows = loop.rows()
    # The RPDO of a cycle that is late is out when its lateness is seen.
    assert rows["torque_cmd_per_mille"][rows["j"] == outcome.trip_cycle - 1] != 0
    assert rows["torque_cmd_per_mille"][rows["j"] == outcome.trip_cycle] == 0
    assert_ended_in_order(loop, outcome, rows)


@pytest.mark.slow
def test_late_rpdos_that_are_only_counted(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing({"limits.late_cycles": 0})), real_time=True)
    answering_late(loop, lambda j: PRESSING <= j < PRESSING + 60)
    outcome = loop.run(PRESSING + 60)
    assert outcome.trips == []
    assert loop.axis.late_rpdo >= 60


@pytest.mark.slow
def test_late_rpdos_with_one_in_time_among_them(make_rig: RigFactory) -> None:
    loop = Loop(make_rig(pressing({"limits.late_cycles": 30})), real_time=True)
    prompt = False

    def late(j: int) -> bool:
        nonlocal prompt
        # After a number that is not yet too large: prompt, until one was in time.
        in_a_row = loop.axis.late_in_a_row
        prompt = in_a_row >= 15 or (prompt and in_a_row > 0)
        return j >= PRESSING and not prompt

    answering_late(loop, late)
    outcome = loop.run(None, lambda j: loop.axis.late_rpdo >= 60)
    assert outcome.trips == []
    assert loop.axis.late_rpdo >= 60


def test_law_is_not_blamed_for_what_was_computed_before_it() -> None:
    loop: Any = SimpleNamespace(real_time=False, law_at_work=lambda: "cycle 9: law late")
    call: Any = SimpleNamespace(computed_s=1.0, waited_s=0.0, seen=(1, ""))
    assert way_out._hang(loop, call) == ""
    call.seen = 1, "cycle 8: law endless"
    assert way_out._hang(loop, call) == "cycle 8: law endless has not returned for 1 s"
