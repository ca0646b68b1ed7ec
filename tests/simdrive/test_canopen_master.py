"""canopen's own master drives the simulated drive over python-can's virtual bus."""

import random
import threading
import time
from collections.abc import Callable, Iterator, Sized
from functools import partial

import can
import canopen
import pytest
from canopen.lss import LssError
from canopen.profiles.p402 import BaseNode402
from simdrive_bench import EDS, HEARTBEAT, NODE_ID, PERIOD_S, RecordingMotion

from canwall.simdrive import BusRunner, Dictionary, ServoDrive

WAIT_S = 10.0


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, "gave up waiting"
        time.sleep(0.001)


def has_length(items: Sized, count: int) -> bool:
    return len(items) == count


@pytest.fixture
def motion() -> RecordingMotion:
    return RecordingMotion()


@pytest.fixture
def node(request: pytest.FixtureRequest, motion: RecordingMotion) -> Iterator[BaseNode402]:
    """A node on a network whose other end is the drive, served by a thread of the test."""
    channel = request.node.name
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.02  # seconds that disconnecting may take
    network.connect(interface="virtual", channel=channel)
    node = BaseNode402(NODE_ID, str(EDS))
    network.add_node(node)
    # A busy machine is no failure of the drive.
    node.sdo.RESPONSE_TIMEOUT = node.TIMEOUT_CHECK_TPDO = WAIT_S
    node.TIMEOUT_SWITCH_OP_MODE = node.TIMEOUT_SWITCH_STATE_FINAL = WAIT_S
    node.TIMEOUT_SWITCH_STATE_SINGLE = WAIT_S
    bus = can.Bus(interface="virtual", channel=channel)
    drive = ServoDrive(Dictionary.load(EDS, NODE_ID), NODE_ID, motion, PERIOD_S)
    runner = BusRunner(drive, bus)
    stop = threading.Event()
    thread = threading.Thread(target=runner.run, args=(stop.is_set,))
    thread.start()
    try:
        wait_for(lambda: node.nmt.state == "PRE-OPERATIONAL")
        yield node
    finally:
        stop.set()
        thread.join()
        network.disconnect()
        bus.shutdown()


def test_sdo(node: BaseNode402) -> None:
    assert node.sdo["Device type"].raw == 0x00020192
    assert node.sdo["Manufacturer device name"].raw == "canwall simulated servo drive"
    assert node.sdo["Position encoder resolution"]["Encoder increments"].raw == 131072
    assert node.sdo["Motor rated torque"].raw == 637
    node.sdo["Max torque"].raw = 1234
    assert node.sdo["Max torque"].raw == 1234
    node.sdo.download(0x1014, 0, (0x80000085).to_bytes(4, "little"), force_segment=True)
    assert node.sdo[0x1014].raw == 0x80000085
    with pytest.raises(canopen.SdoAbortedError, match="06010002"):
        node.sdo["Statusword"].raw = 0
    with pytest.raises(canopen.SdoAbortedError, match="06090031"):
        node.sdo["Max torque"].raw = 4000


@pytest.mark.parametrize("size", [1, 7, 889, 890, 1 << 16])
def test_block_transfer(node: BaseNode402, size: int) -> None:
    sent = random.Random(size).randbytes(size)
    with node.sdo.open(0x2100, 0, "wb", size=size, block_transfer=True) as stream:
        stream.write(sent)
    with node.sdo.open(0x2100, 0, "rb", block_transfer=True) as stream:
        assert stream.read() == sent


def test_heartbeat_and_reset(node: BaseNode402) -> None:
    node.sdo["Producer heartbeat time"].raw = 5
    node.nmt.wait_for_heartbeat(WAIT_S)
    node.nmt.send_command(1)
    node.nmt.wait_for_heartbeat(WAIT_S)
    assert node.nmt.state == "OPERATIONAL"
    node.sdo["Max torque"].raw = 1234
    node.nmt.send_command(129)
    wait_for(lambda: bool(node.nmt.state == "PRE-OPERATIONAL"))
    assert node.sdo["Max torque"].raw == 3000
    assert node.sdo["Producer heartbeat time"].raw == 0


@pytest.mark.slow
def test_lss(node: BaseNode402) -> None:
    lss = node.network.lss
    lss.RESPONSE_TIMEOUT = WAIT_S
    assert lss.send_switch_state_selective(0, 1, 0x00010000, 1)
    assert [lss.inquire_lss_address(command) for command in range(0x5A, 0x5E)] == [0, 1, 65536, 1]
    assert lss.inquire_node_id() == NODE_ID
    lss.configure_node_id(9)
    lss.store_configuration()
    lss.configure_bit_timing(0)
    with pytest.raises(LssError, match="LSS Error: 1"):
        lss.configure_bit_timing(2)
    lss.activate_bit_timing(1)
    lss.send_switch_state_global(lss.WAITING_STATE)
    other = node.network.add_node(BaseNode402(9, str(EDS)))
    node.nmt.send_command(130)
    wait_for(lambda: bool(other.nmt.state == "PRE-OPERATIONAL"))
    other.sdo.RESPONSE_TIMEOUT = WAIT_S
    assert other.sdo[0x1200][1].raw == 0x609


@pytest.mark.slow
def test_lss_finds_who_has_no_node_id(node: BaseNode402) -> None:
    """canopen takes no answer to a scanned bit for a 1, so its patience is how long a 1 takes."""
    lss = node.network.lss
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    lss.configure_node_id(255)
    lss.send_switch_state_global(lss.WAITING_STATE)
    node.nmt.send_command(129)
    found: list[bytes] = []
    node.network.subscribe(0x7E4, lambda _, data, __: found.append(bytes(data)))
    lss.send_identify_non_configured_remote_slave()
    wait_for(partial(has_length, found, 1))
    assert found[0][0] == 0x50
    assert lss.fast_scan() == (True, [0, 1, 0x00010000, 1])
    assert lss.inquire_node_id() == 255
    lss.configure_node_id(NODE_ID)
    assert node.nmt.state == "INITIALISING"
    lss.send_switch_state_global(lss.WAITING_STATE)
    wait_for(lambda: bool(node.nmt.state == "PRE-OPERATIONAL"))
    assert node.sdo[0x1200][1].raw == 0x605


@pytest.mark.slow
def test_lss_identifies(node: BaseNode402) -> None:
    lss = node.network.lss
    lss.send_identify_remote_slave(0, 1, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF)
    answer = lss.responses.get(timeout=WAIT_S)
    assert answer[0] == 0x4F


def test_emcy(node: BaseNode402) -> None:
    node.nmt.send_command(1)
    node.network.send_message(0x405, b"\x06")
    wait_for(lambda: bool(node.emcy.active))
    assert node.emcy.active[0].code == 0x8210
    assert node.sdo[0x1003][1].raw & 0xFFFF == 0x8210


def configure_cycle(node: BaseNode402) -> None:
    """RPDO3 and TPDO3 with every SYNC, the statusword all 10 ms, nothing else."""
    node.tpdo.read()
    node.rpdo.read()
    node.tpdo[1].event_timer = 10
    node.tpdo[2].enabled = False
    node.tpdo[3].clear()
    for index in (0x6041, 0x6064, 0x6077):
        node.tpdo[3].add_variable(index)
    node.tpdo[3].trans_type = 1
    node.rpdo[3].clear()
    for index in (0x6040, 0x6071):
        node.rpdo[3].add_variable(index)
    node.rpdo[3].trans_type = 1
    node.tpdo.save()
    node.rpdo.save()


def test_enable_and_torque(node: BaseNode402, motion: RecordingMotion) -> None:
    configure_cycle(node)
    node.setup_402_state_machine()
    node.nmt.send_command(1)
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    assert node.op_mode == "CYCLIC SYNCHRONOUS TORQUE"
    node.state = "OPERATION ENABLED"
    assert node.state == "OPERATION ENABLED"

    received: list[tuple[int, ...]] = []
    node.tpdo[3].add_callback(lambda pdo: received.append(tuple(variable.raw for variable in pdo)))
    for count, torque in enumerate((100, -200, 5000), start=1):
        node.rpdo[3]["Controlword"].raw = 0x0F
        node.rpdo[3]["Target torque"].raw = torque
        node.rpdo[3].transmit()
        node.network.sync.transmit()
        wait_for(partial(has_length, received, count))

    assert received == [(0x1237, 1000, 100), (0x1237, 1007, -200), (0x1A37, 1014, 3000)]
    advanced = [call[1] for call in motion.calls if call[0] == "advance"]
    assert advanced == pytest.approx([0.0637, -0.1274])
    node.state = "SWITCH ON DISABLED"
    assert node.sdo["Torque actual value"].raw == 0


class Link:
    """Two ends of a virtual bus in one thread, the drive on one of them."""

    def __init__(self, channel: str) -> None:
        self.motion = RecordingMotion()
        self.master = can.Bus(interface="virtual", channel=channel)
        self.bus = can.Bus(interface="virtual", channel=channel)
        dictionary = Dictionary.load(EDS, NODE_ID)
        drive = ServoDrive(dictionary, NODE_ID, self.motion, PERIOD_S)
        self.runner = BusRunner(drive, self.bus)

    def send(
        self,
        can_id: int,
        data: bytes = b"",
        *,
        remote: bool = False,
        extended: bool = False,
        error: bool = False,
    ) -> None:
        self.master.send(
            can.Message(
                arbitration_id=can_id,
                data=data,
                is_extended_id=extended,
                is_remote_frame=remote,
                is_error_frame=error,
            )
        )

    def answers(self) -> list[tuple[int, bytes]]:
        frames = []
        while (message := self.master.recv(0)) is not None:
            assert not message.is_extended_id
            frames.append((message.arbitration_id, bytes(message.data)))
        return frames


@pytest.fixture
def link(request: pytest.FixtureRequest) -> Iterator[Link]:
    link = Link(request.node.name)
    yield link
    link.master.shutdown()
    link.bus.shutdown()


def test_attaching_boots_the_drive(link: Link) -> None:
    assert link.answers() == [(HEARTBEAT, b"\x00")]


def test_poll_handles_all_that_waits_in_order(link: Link) -> None:
    link.answers()
    for torque in (1, 2, 3):
        link.send(0x405, bytes([0, 0, torque, 0]))
    link.send(0x000, b"\x01\x05")
    for torque in (4, 5):
        link.send(0x405, bytes([0, 0, torque, 0]))
        link.send(0x605, b"\x40\x71\x60\x00\x00\x00\x00\x00")
    link.runner.poll()
    seen = [data[4] for can_id, data in link.answers() if can_id == 0x585]
    assert seen == [4, 5]


def test_node_guarding(node: BaseNode402) -> None:
    node.nmt.send_command(2)
    answers: list[int] = []
    node.network.subscribe(HEARTBEAT, lambda _, data, __: answers.append(data[0]))
    node.nmt.start_node_guarding(0.001)
    wait_for(lambda: len(answers) >= 4)
    node.nmt.stop_node_guarding()
    assert answers[:4] == [0x04, 0x84, 0x04, 0x84]


def test_remote_error_and_extended_frames_are_ignored(link: Link) -> None:
    link.answers()
    read = b"\x40\x00\x10\x00\x00\x00\x00\x00"
    link.send(0x605, read, extended=True)
    link.send(0x605, read, error=True)
    link.send(0x080, remote=True)
    link.runner.poll()
    assert [frame for frame in link.answers() if frame[0] != 0x185] == []
    assert [call for call in link.motion.calls if call[0] == "advance"] == []
    link.send(0x605, read)
    link.runner.poll()
    assert len(link.answers()) == 1


def test_poll_lets_the_timers_run(link: Link) -> None:
    link.answers()
    link.send(0x605, b"\x2b\x17\x10\x00\x01\x00\x00\x00")

    def heart_beats() -> bool:
        link.runner.poll()
        return (HEARTBEAT, b"\x7f") in link.answers()

    wait_for(heart_beats)
