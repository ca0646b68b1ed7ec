"""The drive for other people's tests: on a bus at once, looked into, with faults as methods."""

from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from canopen.sdo import SdoCommunicationError

from canwall import config
from canwall.errors import ConfigError
from canwall.faults import KINDS
from canwall.library.simulated_drive import SimulatedDrive

PATIENCE_S = 60.0
#: Without friction and lags: motion in closed form.
FREE = {"ideal": True, "coulomb_nm": 0.0, "viscous_nm_s_per_rad": 0.0, "velocity_filter_hz": 0.0}
RATED_NM, INERTIA = 0.637, 1.0e-4


class Master:
    """canopen at the other end of a drive's bus."""

    def __init__(self, drive: SimulatedDrive) -> None:
        self.drive = drive
        self.network = canopen.Network()
        self.network.NOTIFIER_CYCLE = 0.02
        self.network.connect(interface=drive.interface, channel=drive.channel)
        self.node = self.network.add_node(canopen.RemoteNode(drive.node_id, str(drive.eds)))
        self.node.sdo.RESPONSE_TIMEOUT = PATIENCE_S

    def enable(self) -> None:
        self.node.nmt.send_command(1)
        self.node.sdo[0x6060].raw = 10
        for word in (0x06, 0x07, 0x0F):
            self.node.sdo[0x6040].raw = word

    def sync(self, count: int) -> None:
        wanted = self.drive.syncs + count
        for _ in range(count):
            self.network.sync.transmit()
        self.drive.wait_until(lambda: self.drive.syncs == wanted, PATIENCE_S)

    def __enter__(self) -> "Master":
        return self

    def __exit__(self, *error: object) -> None:
        self.network.disconnect()


@pytest.fixture
def drive() -> Iterator[SimulatedDrive]:
    with SimulatedDrive() as drive:
        yield drive


@pytest.fixture
def master(drive: SimulatedDrive) -> Iterator[Master]:
    with Master(drive) as master:
        yield master


def test_shows_what_the_bus_shows(drive: SimulatedDrive, master: Master) -> None:
    assert (drive.nmt_state, drive.state) == ("PRE-OPERATIONAL", "SWITCH ON DISABLED")
    assert (drive.torque, drive.position, drive.errors) == (0.0, 0.0, ())
    master.enable()
    assert (drive.nmt_state, drive.state) == ("OPERATIONAL", "OPERATION ENABLED")
    master.node.sdo[0x6071].raw = 100
    drive.wait_until(lambda: drive.velocity > 0.1, PATIENCE_S)
    assert drive.torque == pytest.approx(0.1 * RATED_NM, rel=0.01)
    assert drive[0x6071] == 100
    assert drive[0x608F, 1] == master.node.sdo[0x608F][1].raw
    assert "OPERATION ENABLED" in repr(drive)
    master.node.sdo[0x6040].raw = 0
    assert drive.torque == 0.0
    with pytest.raises(KeyError, match="0x6099:07 is not in"):
        drive[0x6099, 7]


def test_moves_as_closed_forms_do_where_syncs_are_the_time() -> None:
    with SimulatedDrive(real_time=False, simulation=FREE) as drive, Master(drive) as master:
        master.enable()
        master.sync(1)
        master.node.sdo[0x6071].raw = 50
        master.sync(40)
        acceleration = 0.05 * RATED_NM / INERTIA
        assert drive.torque == pytest.approx(0.05 * RATED_NM)
        assert drive.velocity == pytest.approx(acceleration * 0.040)
        assert drive.position == pytest.approx(acceleration * 0.040**2 / 2.0)
        counts = drive.position * 131072 / (2.0 * 3.141592653589793)
        assert master.node.sdo[0x6064].raw == pytest.approx(counts, abs=0.51)


@pytest.mark.parametrize("real_time", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_faults_begin_and_end_as_told(kind: str, real_time: bool) -> None:
    with SimulatedDrive(real_time=real_time) as drive:
        with getattr(drive.faults, kind)():
            assert drive[0x5F00, 9] == (0 if KINDS[kind].momentary else 1)
        assert drive[0x5F00, 9] == 0
        drive.faults.begin(kind)
        drive.faults.end_all()
        assert drive[0x5F00, 9] == 0


def test_fault_is_on_the_bus(drive: SimulatedDrive, master: Master) -> None:
    answers = drive.faults.lost(can_id=0x585)
    master.node.sdo.RESPONSE_TIMEOUT = 0.05
    with pytest.raises(SdoCommunicationError):
        master.node.sdo.upload(0x1000, 0)
    answers.end()
    master.node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    assert master.node.sdo[0x1000].raw == 0x20192

    drive.faults.emcy(amount=0x2310)
    assert drive.errors == (0x2310,)
    drive.wait_until(lambda: master.node.emcy.log, PATIENCE_S)
    assert master.node.emcy.log[0].code == 0x2310
    with drive.faults.reboot():
        drive.wait_until(lambda: not drive.errors, PATIENCE_S)


def test_fault_ends_after_its_duration(drive: SimulatedDrive) -> None:
    drive.faults.sto(duration_s=0.02)
    assert drive[0x60FD] & 8
    drive.wait_until(lambda: not drive[0x60FD] & 8, PATIENCE_S)


def test_fault_that_does_not_exist(drive: SimulatedDrive) -> None:
    with pytest.raises(AttributeError, match=r"no fault 'overheating'; there are .*sto"):
        drive.faults.overheating()
    with pytest.raises(ConfigError, match="amount: the kind sto has none; remove it"):
        drive.faults.sto(amount=1)
    assert "encoder_jump" in dir(drive.faults)
    assert drive.faults.sto.__doc__ == KINDS["sto"].__doc__


@pytest.mark.parametrize("overflow", [0, 3])
def test_produces_sync_if_asked(overflow: int) -> None:
    options = {"cycle_s": 0.002, "simulation": {"objects": {"0x1019": overflow}}}
    with SimulatedDrive(sync=True, **options) as drive:  # type: ignore[arg-type]
        filters = [can.typechecking.CanFilter(can_id=0x080, can_mask=0x7FF)]
        with can.Bus(interface="virtual", channel=drive.channel, can_filters=filters) as bus:
            frames = [bus.recv(PATIENCE_S) for _ in range(7)]
        data = [bytes(frame.data) for frame in frames if frame is not None]
        if overflow:
            first = data[0][0]
            assert data == [bytes([(first - 1 + k) % 3 + 1]) for k in range(7)]
        else:
            assert data == [b""] * 7
        assert drive.errors == ()
        assert drive.syncs >= 7


def test_any_bus(tmp_path: Path) -> None:
    channel = str(tmp_path / "bus")
    with (
        SimulatedDrive(interface="unixcan", channel=channel, node_id=77) as drive,
        Master(drive) as master,
    ):
        assert master.node.sdo[0x1018][1].raw == drive[0x1018, 1]
    with pytest.raises(ConfigError, match="channel is missing: unixcan"):
        SimulatedDrive(interface="unixcan")
    with pytest.raises(ConfigError, match=r"bus.interface = 'nonesuch'"):
        SimulatedDrive(interface="nonesuch", channel="x").__enter__()


VENDOR = Path(__file__).parents[3] / "shared" / "vendor-eds" / "maxon_epos4_0x1018.eds"


@pytest.mark.skipif(not VENDOR.is_file(), reason=f"there is no {VENDOR}")
def test_dictionary_of_a_vendor() -> None:
    with SimulatedDrive(VENDOR) as drive, Master(drive) as master:
        master.enable()
        assert drive.state == "OPERATION ENABLED"
        assert master.node.sdo[0x6041].raw & 0x6F == 0x27


def test_gives_up_waiting_with_the_state_of_the_drive(drive: SimulatedDrive) -> None:
    with pytest.raises(TimeoutError, match=r"waited for 0\.01 s: <SimulatedDrive node 5 .*SYNCs>"):
        drive.wait_until(lambda: False, 0.01)


def test_bus_that_fails_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(timeout: float) -> None:
        raise can.CanOperationError("cut")

    drive = SimulatedDrive()
    drive.__enter__()
    monkeypatch.setattr(drive._bus, "recv", fail)
    with pytest.raises(can.CanOperationError, match="cut"):
        drive.wait_until(lambda: False, PATIENCE_S)
    with pytest.raises(can.CanOperationError, match="cut"):
        drive.__exit__(None, None, None)


def test_from_a_configuration() -> None:
    settings = config.load(config.shipped("config/sim.toml"), {"drive.node_id": 9})
    drive = SimulatedDrive.from_settings(settings)
    assert (drive.node_id, drive.eds, drive.channel) == (9, settings.drive.eds, "canwall")
    assert drive.position == 0.1  # rad: where the hand of sim.toml rests
    bench = settings.model_copy(update={"simulation": None})
    with pytest.raises(ConfigError, match=r"\[simulation\] is missing"):
        SimulatedDrive.from_settings(bench)
    with pytest.raises(ConfigError, match="coulomb: unknown key; did you mean coulomb_nm"):
        SimulatedDrive(simulation={"coulomb": 1.0})


def test_a_drive_has_one_life(drive: SimulatedDrive) -> None:
    with pytest.raises(RuntimeError, match="make another one"):
        drive.__enter__()
