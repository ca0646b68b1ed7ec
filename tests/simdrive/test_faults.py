"""Every kind of fault, configured and over SDO, seen by a master on a python-can bus."""

import itertools
import struct
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import can
import pytest
from can.interfaces.virtual import VirtualBus
from canopen import SdoAbortedError
from simdrive_bench import (
    EDS,
    EMCY,
    HEARTBEAT,
    NODE_ID,
    PERIOD_S,
    RPDO,
    SDO_RESPONSE,
    START,
    SYNC,
    TPDO,
    Bench,
)

from canwall.config import Drive as DriveSettings
from canwall.config import Fault as FaultSettings
from canwall.config import Hand, Simulation
from canwall.faults import KINDS
from canwall.simdrive import BusRunner, Frame, make_drive

ERROR_FRAME = 1 << 29
CLOCK_START_S = 50.0
SUBINDEX = {
    "kind": (1, 1),
    "amount": (2, 4),
    "can_id": (3, 2),
    "direction": (4, 1),
    "probability": (5, 2),
    "duration_syncs": (6, 4),
    "at_sync": (7, 4),
}
"""Sub-index of 0x5F00 and bytes, by the key of the configuration; at_sync counts from now on."""


class BusBench(Bench):
    """A drive at one end of a virtual bus, and at the other a master that sends raw frames."""

    def __init__(self, *faults: dict[str, Any], seed: int = 0, real_time: bool = False) -> None:
        simulation = Simulation(
            hand=Hand(strikes=0),
            coulomb_nm=0.0,
            ideal=True,
            seed=seed,
            real_time=real_time,
            fault=tuple(FaultSettings(**fault) for fault in faults),
        )
        channel = f"faults {next(_channels)}"
        self.master = VirtualBus(channel)
        self._bus = VirtualBus(channel)
        self.now_s = CLOCK_START_S
        self.lines: list[str] = []
        settings = DriveSettings(node_id=NODE_ID, eds=EDS)
        self.drive = make_drive(  # type: ignore[assignment]
            settings, simulation, PERIOD_S, report=self.lines.append
        )
        self.sent: list[Frame] = []
        self.runner = BusRunner(self.drive, self._bus, lambda: self.now_s)
        self._hear()

    def close(self) -> None:
        self.master.shutdown()
        self._bus.shutdown()

    def _hear(self) -> list[Frame]:
        heard = []
        while (message := self.master.recv(0)) is not None:
            flag = ERROR_FRAME if message.is_error_frame else 0
            heard.append((message.arbitration_id | flag, bytes(message.data)))
        self.sent += heard
        return heard

    def give(self, can_id: int, data: bytes = b"") -> list[Frame]:
        self.master.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        self.runner.poll()
        return self._hear()

    def request(self, can_id: int) -> list[Frame]:
        self.master.send(
            can.Message(arbitration_id=can_id, is_remote_frame=True, is_extended_id=False)
        )
        self.runner.poll()
        return self._hear()

    def tick(self, dt: float = PERIOD_S) -> list[Frame]:
        self.now_s += dt
        self.runner.poll()
        return self._hear()

    def start(self) -> "BusBench":
        """Enable the drive: SYNC 0 to 3, after which there are only RPDO3 and TPDO3."""
        self.configure_cycle()
        self.nmt(START)
        for controlword in (0x00, 0x06, 0x07, 0x0F):
            self.command(controlword)
            self.sync()
        return self

    def ask(self, **fault: Any) -> None:
        """Ask for a fault over SDO."""
        values = {**fault, "kind": KINDS[fault["kind"]].number}
        if "probability" in values:
            values["probability"] = round(1000 * values["probability"])
        if "direction" in values:
            values["direction"] = ("sent", "received", "both").index(values["direction"])
        for key, value in values.items():
            subindex, size = SUBINDEX[key]
            self.write(0x5F00, subindex, value, size)
        self.write(0x5F00, 8, 1, 1)

    def syncs(self, count: int) -> list[list[Frame]]:
        return [self.sync() for _ in range(count)]

    def tpdos(self, count: int) -> list[bytes | None]:
        """Return the TPDO after each of so many SYNCs, None where there is none."""
        answers = []
        for frames in self.syncs(count):
            data = [data for can_id, data in frames if can_id == TPDO[3]]
            answers.append(data[-1] if data else None)
        return answers


_channels = itertools.count()

BusBenchFactory: TypeAlias = Callable[..., BusBench]


@pytest.fixture
def on_the_bus() -> Iterator[BusBenchFactory]:
    benches: list[BusBench] = []

    def make(*faults: dict[str, Any], **settings: Any) -> BusBench:
        benches.append(BusBench(*faults, **settings))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()


Begin: TypeAlias = Callable[..., BusBench]


@pytest.fixture(params=["configured", "over SDO"])
def begun(request: pytest.FixtureRequest, on_the_bus: BusBenchFactory) -> Begin:
    """A drive that is enabled, SYNC 0 to 3 gone; its fault begins with SYNC 4."""

    def make(seed: int = 0, **fault: Any) -> BusBench:
        if request.param == "configured":
            return on_the_bus({**fault, "at_sync": 4}, seed=seed).start()
        bench = on_the_bus(seed=seed).start()
        bench.ask(**fault)
        return bench

    return make


def position(data: bytes | None) -> int:
    assert data is not None
    where: int = struct.unpack_from("<2xi", data)[0]
    return where


def test_lost_frames(begun: Begin) -> None:
    bench = begun(kind="lost", can_id=TPDO[3], duration_syncs=3)
    assert [data is None for data in bench.tpdos(5)] == [True, True, True, False, False]
    assert len(bench.lines) == 2
    assert bench.lines[0] == "SYNC 4: lost (0x385 sent) begins"
    assert bench.lines[1] == "SYNC 7: lost (0x385 sent) ends"


def test_lost_frames_to_the_drive(begun: Begin) -> None:
    bench = begun(kind="lost", can_id=RPDO[3], direction="received", duration_syncs=2)
    bench.sync()
    bench.command(0x0F, 500)
    assert bench.cycle()[2] == 0
    bench.sync()
    bench.command(0x0F, 500)
    assert bench.cycle()[2] == 500


def test_the_world_goes_on_where_the_drive_misses_a_sync(begun: Begin) -> None:
    bench = begun(kind="lost", can_id=SYNC, direction="received", duration_syncs=3)
    bench.command(0x0F, 500)
    still = begun(kind="silence", duration_syncs=3)
    still.command(0x0F, 500)
    assert bench.tpdos(3) == [None] * 3
    assert still.tpdos(3) == [None] * 3
    # The torque of the RPDO waits for a SYNC that arrives.
    assert position(bench.tpdos(1)[0]) < position(still.tpdos(1)[0])
    assert bench.drive.drive.syncs == still.drive.drive.syncs == 8  # type: ignore[attr-defined]


def test_probability(begun: Begin) -> None:
    bench = begun(kind="lost", can_id=TPDO[3], probability=0.25, seed=3)
    lost = sum(data is None for data in bench.tpdos(1000))
    assert lost == pytest.approx(250, abs=5 * (1000 * 0.25 * 0.75) ** 0.5)


@pytest.mark.parametrize("kind", ["lost", "corrupted"])
def test_seed_decides(on_the_bus: BusBenchFactory, kind: str) -> None:
    runs = [
        on_the_bus({"kind": kind, "can_id": TPDO[3], "probability": 0.5}, seed=seed)
        .start()
        .tpdos(60)
        for seed in (1, 1, 2)
    ]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


def test_late_frames(begun: Begin) -> None:
    bench = begun(kind="late", can_id=TPDO[3], amount=2, duration_syncs=2)
    bench.command(0x0F, 500)
    frames = [[data for can_id, data in sent if can_id == TPDO[3]] for sent in bench.syncs(5)]
    assert [len(sent) for sent in frames] == [0, 0, 2, 2, 1]
    in_order = [position(data) for data in (frames[2][0], frames[3][0], frames[2][1], frames[3][1])]
    assert in_order == sorted(in_order)  # SYNC 4, 5, 6, 7: the late one before that of the SYNC


def test_late_frames_to_the_drive(begun: Begin) -> None:
    bench = begun(kind="late", can_id=RPDO[3], direction="received", duration_syncs=1)
    bench.sync()
    bench.command(0x0F, 500)
    assert [bench.cycle()[2] for _ in range(3)] == [0, 500, 500]


def test_doubled_frames(begun: Begin) -> None:
    bench = begun(kind="doubled", can_id=TPDO[3], duration_syncs=1)
    first, second = bench.sync()
    assert first == second
    assert len(bench.sync()) == 1


def test_corrupted_frames(begun: Begin) -> None:
    bench = begun(kind="corrupted", can_id=TPDO[3], amount=3, duration_syncs=1)
    ((_, wrong),) = bench.sync()
    ((_, right),) = bench.sync()  # nothing moves without torque
    difference = int.from_bytes(wrong, "big") ^ int.from_bytes(right, "big")
    assert difference.bit_count() == 3


def test_corruption_that_the_crc_notices(begun: Begin) -> None:
    bench = begun(kind="corrupted", can_id=TPDO[3], amount=0, duration_syncs=1)
    (error_id, _), frame = bench.sync()
    assert error_id & ERROR_FRAME
    assert [frame] == bench.sync()


@pytest.mark.parametrize(("amount", "length"), [(-1, 7), (-3, 5), (-8, 0)])
def test_wrong_length(begun: Begin, amount: int, length: int) -> None:
    bench = begun(kind="wrong_length", can_id=TPDO[3], amount=amount, duration_syncs=1)
    ((_, wrong),) = bench.sync()
    ((_, right),) = bench.sync()
    assert wrong == right[:length]
    assert len(right) == 8


def test_wrong_length_to_the_drive(begun: Begin) -> None:
    bench = begun(kind="wrong_length", can_id=RPDO[3], direction="received", amount=-1)
    bench.sync()
    bench.command(0x0F, 500)
    assert 0x8210 in [code for code, _ in bench.emergencies()]
    assert bench.cycle()[2] == 0


def test_silence(begun: Begin) -> None:
    bench = begun(kind="silence", duration_syncs=3)
    bench.command(0x0F, 500)
    assert bench.syncs(1) == [[]]
    with pytest.raises(ValueError, match="unpack"):
        bench.read(0x6077)
    assert bench.syncs(2) == [[], []]
    assert bench.cycle()[2] == 500  # it has heard all the while


@pytest.mark.parametrize("syncs", [None, 3])
def test_reboot(begun: Begin, syncs: int | None) -> None:
    bench = begun(kind="reboot", **({"duration_syncs": syncs} if syncs else {}))
    for _ in range(syncs or 0):
        assert bench.sync() == []
        assert bench.nmt(START) == []
    assert bench.sync() == [(HEARTBEAT, b"\0")]
    assert bench.sync() == []
    assert bench.read(0x6041) == 0x0250
    assert bench.read(0x1402, 2) != 1  # what was set up is gone


def test_emergency(begun: Begin) -> None:
    bench = begun(kind="emcy", amount=0x4210, duration_syncs=2)
    assert bench.sync()[0] == (EMCY, bytes.fromhex("1042 09 005F 01 0000"))
    assert bench.cycle()[0] == 0x1237  # a message and no more
    assert bench.sync()[0] == (EMCY, bytes.fromhex("0000 00 005F 01 0000"))


def test_fault_of_the_drive(begun: Begin) -> None:
    bench = begun(kind="fault", amount=0x7305)
    bench.sync()
    assert 0x7305 in [code for code, _ in bench.emergencies()]
    bench.tick()
    bench.tick()
    assert bench.read(0x6041) & 0x4F == 0x08
    assert bench.read(0x603F) == 0x7305


def test_encoder_jump(begun: Begin) -> None:
    bench = begun(kind="encoder_jump", amount=-300, duration_syncs=2)
    before = bench.read(0x6064, signed=True)
    assert [position(data) - before for data in bench.tpdos(4)] == [-300, -300, 0, 0]


def test_stuck_encoder(begun: Begin) -> None:
    bench = begun(kind="encoder_stuck", duration_syncs=4)
    bench.command(0x0F, 500)
    stuck = [position(data) for data in bench.tpdos(4)]
    assert len(set(stuck)) == 1
    assert bench.read(0x606C) == 0
    assert abs(position(bench.tpdos(1)[0]) - stuck[0]) > 50


def test_torque_that_does_not_follow(begun: Begin) -> None:
    bench = begun(kind="torque", amount=200, duration_syncs=3)
    bench.command(0x0F, 500)
    assert [bench.cycle()[2] for _ in range(5)] == [100, 100, 100, 500, 500]
    assert bench.read(0x6074) == 500


def test_last_of_overlapping_faults_ends_them(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus(
        {"kind": "torque", "amount": 200, "at_sync": 4, "duration_syncs": 3},
        {"kind": "torque", "amount": 300, "at_sync": 5, "duration_syncs": 4},
    ).start()
    bench.command(0x0F, 500)
    assert [bench.cycle()[2] for _ in range(6)] == [100, 150, 150, 150, 150, 500]


def test_overlapping_encoder_jumps_end_one_by_one(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus(
        {"kind": "encoder_jump", "amount": 20, "at_sync": 4, "duration_syncs": 3},
        {"kind": "encoder_jump", "amount": 3, "at_sync": 5, "duration_syncs": 4},
    ).start()
    before = bench.read(0x6064, signed=True)
    assert [position(data) - before for data in bench.tpdos(6)] == [20, 23, 23, 3, 3, 0]


def test_encoder_that_jumps_while_it_is_stuck(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus(
        {"kind": "encoder_stuck", "at_sync": 4, "duration_syncs": 4},
        {"kind": "encoder_jump", "amount": 20, "at_sync": 5, "duration_syncs": 2},
        {"kind": "encoder_jump", "amount": 3, "at_sync": 6},
    ).start()
    before = bench.read(0x6064, signed=True)
    assert [position(data) - before for data in bench.tpdos(6)] == [0, 0, 0, 0, 3, 3]


def test_overlapping_emergencies_of_one_code_end_with_the_last(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus(
        {"kind": "emcy", "amount": 0x4210, "at_sync": 4, "duration_syncs": 3},
        {"kind": "emcy", "amount": 0x4210, "at_sync": 5, "duration_syncs": 3},
        {"kind": "emcy", "amount": 0x3310, "at_sync": 5, "duration_syncs": 1},
    ).start()
    codes = []
    for _ in range(6):
        bench.sync()
        codes.append(bench.read(0x603F))
    assert codes == [0x4210, 0x3310, 0x4210, 0x4210, 0, 0]


@pytest.mark.parametrize("kind", ["sto", "undervoltage"])
def test_no_power(begun: Begin, kind: str) -> None:
    bench = begun(kind=kind, duration_syncs=5)
    bench.command(0x0F, 500)
    for _ in range(4):
        bench.sync()
        bench.tick()
    assert bench.read(0x6077) == 0
    assert bench.read(0x6041) & 0x4F == 0x08
    assert bench.emergencies()
    bench.syncs(3)
    bench.write(0x6040, 0, 0x00, 2)
    bench.write(0x6040, 0, 0x80, 2)
    assert bench.read(0x6041) & 0x4F == 0x40


@pytest.mark.parametrize(("behaviour", "nmt_state"), [(0, 127), (1, 5), (2, 4)])
def test_bus_off(on_the_bus: BusBenchFactory, behaviour: int, nmt_state: int) -> None:
    bench = on_the_bus({"kind": "bus_off", "at_sync": 4, "duration_syncs": 3}).start()
    bench.write(0x1029, 1, behaviour, 1)
    bench.write(0x1017, 0, 20, 2)
    ((error_id, _),) = bench.sync()
    assert error_id == ERROR_FRAME | 0x40
    assert bench.tick(0.1) == []
    assert bench.nmt(START) == []
    assert bench.syncs(2) == [[], []]
    recovered = bench.sync()
    emergencies = [data for can_id, data in recovered if can_id == EMCY]
    if nmt_state != 4:  # STOPPED: no EMCY
        assert struct.unpack_from("<H", emergencies[0]) == (0x8140,)
    assert (HEARTBEAT, bytes([nmt_state])) in bench.tick(0.05)


def test_babbling(begun: Begin) -> None:
    bench = begun(kind="babbling", can_id=0x123, amount=7, duration_syncs=2)
    frames = bench.syncs(3)
    babbled = [[data for can_id, data in sent if can_id == 0x123] for sent in frames]
    assert [len(data) for data in babbled] == [7, 7, 0]
    assert len(set(babbled[0])) == 7
    assert frames[0][-1][0] == TPDO[3]  # which comes after them


def test_late_begin_over_sdo(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus().start()
    bench.ask(kind="silence", at_sync=2, duration_syncs=1)
    assert bench.read(0x5F00, 9) == 1
    assert [data is None for data in bench.tpdos(5)] == [False, False, True, False, False]
    assert bench.read(0x5F00, 9) == 0


def test_all_faults_end_on_command(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus().start()
    bench.ask(kind="encoder_jump", amount=100)
    bench.ask(kind="silence", at_sync=5)
    before = bench.read(0x6064, signed=True)
    assert position(bench.tpdos(1)[0]) == before + 100
    bench.write(0x5F00, 8, 0, 1)
    assert [position(data) for data in bench.tpdos(7)] == [before] * 7
    assert bench.read(0x5F00, 9) == 0


@pytest.mark.parametrize("fault", [{"kind": "wrong_length", "amount": 9}, {"kind": "emcy"}])
def test_what_is_no_fault_is_refused(on_the_bus: BusBenchFactory, fault: dict[str, Any]) -> None:
    bench = on_the_bus().start()
    if fault["kind"] == "emcy":
        bench.ask(kind="emcy")  # with the usual amount
        fault = {**fault, "amount": 0}
    with pytest.raises(SdoAbortedError) as abort:
        bench.ask(**fault)
    assert abort.value.code == 0x08000022


def test_number_beyond_the_kinds(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus()
    with pytest.raises(SdoAbortedError) as abort:
        bench.write(0x5F00, 1, len(KINDS) + 1, 1)
    assert abort.value.code == 0x06090031


def test_no_kind_is_no_fault(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus()
    with pytest.raises(SdoAbortedError):
        bench.write(0x5F00, 8, 1, 1)


def test_fault_from_power_on(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus({"kind": "lost", "can_id": HEARTBEAT})
    assert bench.sent == []
    assert bench.lines == ["power-on: lost (0x705 sent) begins"]
    assert bench.nmt(129) == []  # its boot-up message, too


def test_sdo_answers_are_lost(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus({"kind": "lost", "can_id": SDO_RESPONSE, "probability": 0.5}, seed=1)
    answers = [bench.give(0x605, bytes.fromhex("40 0010 00 00000000")) for _ in range(200)]
    assert 60 < sum(not frames for frames in answers) < 140


def test_seconds_are_syncs_in_sync_time(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus({"kind": "silence", "at_s": 0.006, "duration_s": 0.0021}).start()
    assert [data is None for data in bench.tpdos(6)] == [False, False, True, True, False, False]


def test_seconds_are_measured_in_real_time(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus(
        {"kind": "silence", "at_s": 0.5, "duration_s": 0.25},
        {"kind": "late", "can_id": TPDO[3], "amount": 30, "at_s": 1.0, "duration_s": 0.01},
        {"kind": "babbling", "amount": 2, "at_s": 2.0, "duration_s": 0.1},
        real_time=True,
    ).start()
    bench.tick(0.499)
    assert len(bench.sync()) == 1
    bench.tick(0.002)
    assert bench.sync() == []
    bench.tick(0.24)
    assert bench.sync() == []
    bench.tick(0.01)
    assert len(bench.sync()) == 1
    bench.tick(0.2491)
    assert bench.sync() == []
    assert bench.tick(0.02) == []
    assert len(bench.tick(0.011)) == 1
    bench.tick(0.9679)
    babbled = [len(bench.tick(0.01)) for _ in range(12)]
    assert sum(babbled[:10]) == pytest.approx(200, abs=1)
    assert babbled[10:] == [0, 0]
    assert bench.lines[0] == "0.501 s: silence begins"


def test_remote_frames(on_the_bus: BusBenchFactory) -> None:
    touched = {"direction": "received", "can_id": HEARTBEAT}
    bench = on_the_bus({"kind": "doubled", **touched}, {"kind": "lost", "at_sync": 1, **touched})
    assert len(bench.request(HEARTBEAT)) == 1  # node guarding
    bench.syncs(2)
    assert bench.request(HEARTBEAT) == []


def test_parameters_of_a_fault_are_not_stored(on_the_bus: BusBenchFactory) -> None:
    bench = on_the_bus()
    bench.write(0x5F00, 1, 3, 1)
    bench.write(0x1010, 1, int.from_bytes(b"save", "little"), 4)
    bench.nmt(129)
    assert bench.read(0x5F00, 1) == 0
