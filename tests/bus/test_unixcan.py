"""The bus between processes: what is sent arrives, whoever comes, sleeps, leaves or is killed."""

import asyncio
import contextlib
import errno
import fcntl
import gc
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import canopen
import pytest
from fork_server import ForkedPopen
from hypothesis import given, settings
from hypothesis import strategies as st

from canwall.bus.unixcan import UnixBus

ALONE_S = 0.05  # how long to listen where nothing should come
PLENTY_S = 20.0  # how long to wait for what must come

Join = Callable[..., UnixBus]
Spawn = Callable[..., "subprocess.Popen[str]"]

HUB = """
import sys, can
bus = can.Bus(interface="unixcan", channel=sys.argv[1])
print("joined", flush=True)
while True:
    bus.recv(1)
"""


@pytest.fixture
def channel(tmp_path: Path) -> Path:
    return tmp_path / "bus"


@pytest.fixture
def join(channel: Path) -> Iterator[Join]:
    with contextlib.ExitStack() as stack:
        yield lambda **options: stack.enter_context(UnixBus(str(channel), **options))


@pytest.fixture
def spawn() -> Iterator[Spawn]:
    with contextlib.ExitStack() as stack:

        def start(*command: str) -> "subprocess.Popen[str]":
            process = ForkedPopen[str](
                [sys.executable, "-u", *command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield start


def line_of(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def numbered(number: int) -> can.Message:
    return can.Message(
        arbitration_id=0x181, is_extended_id=False, data=number.to_bytes(4, "little")
    )


def number_of(msg: can.Message | None) -> int:
    assert msg is not None
    return int.from_bytes(msg.data, "little")


def assert_same(received: can.Message | None, sent: can.Message) -> None:
    assert received is not None
    assert received.equals(sent, timestamp_delta=None, check_channel=False)


def assert_talk(sender: UnixBus, receiver: UnixBus, number: int) -> None:
    """Frames may be lost while the hub changes, then they must pass."""
    deadline = time.monotonic() + PLENTY_S
    while time.monotonic() < deadline:
        sender.send(numbered(number))
        while msg := receiver.recv(ALONE_S):
            if number_of(msg) == number:
                return
    pytest.fail("no frame came through")


@st.composite
def messages(draw: st.DrawFn) -> can.Message:
    extended = draw(st.booleans())
    kind = draw(st.sampled_from(["data", "remote", "error"]))
    return can.Message(
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)),
        is_extended_id=extended,
        is_remote_frame=kind == "remote",
        is_error_frame=kind == "error",
        dlc=draw(st.integers(0, 8)) if kind == "remote" else None,
        data=None if kind == "remote" else draw(st.binary(max_size=8)),
        check=True,
    )


# Frames


@pytest.fixture(scope="module")
def trio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[UnixBus]]:
    path = str(tmp_path_factory.mktemp("trio") / "bus")
    with UnixBus(path) as hub, UnixBus(path) as second, UnixBus(path) as third:
        yield [hub, second, third]


@settings(deadline=None, max_examples=60)
@given(sent=messages(), sender=st.integers(0, 2))
def test_every_kind_of_frame_reaches_all_the_others(
    trio: list[UnixBus], sent: can.Message, sender: int
) -> None:
    before = time.time()
    trio[sender].send(sent)
    for index, bus in enumerate(trio):
        if index != sender:
            received = bus.recv(PLENTY_S)
            assert_same(received, sent)
            assert received is not None
            assert received.channel == bus.channel
            assert before <= received.timestamp <= time.time()
    for bus in trio:
        assert bus.recv(0) is None


def test_a_packet_is_a_can_frame_of_the_kernel(join: Join, channel: Path) -> None:
    bus = join()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as foreign:
        foreign.connect(str(channel))
        foreign.settimeout(PLENTY_S)
        bus.send(can.Message(arbitration_id=0x12345678, is_remote_frame=True, dlc=3))
        wire = (0x12345678 | 0x80000000 | 0x40000000).to_bytes(4, sys.byteorder)
        assert foreign.recv(100) == wire + b"\3\0\0\0" + bytes(8)

        foreign.send(b"abc")  # none of these is a classical CAN frame
        foreign.send(bytes(72))
        foreign.send(bytes(4) + b"\x09" + bytes(11))
        foreign.send((0x205).to_bytes(4, sys.byteorder) + b"\2\0\0\0" + b"\x0f\x00" + bytes(6))
        expected = can.Message(arbitration_id=0x205, is_extended_id=False, data=b"\x0f\x00")
        assert_same(bus.recv(PLENTY_S), expected)
        assert bus.recv(0) is None


@pytest.mark.parametrize(
    ("msg", "reason"),
    [
        (can.Message(is_fd=True, data=bytes(12)), "not CAN FD"),
        (can.Message(data=bytes(9)), "0 to 8 bytes"),
        (can.Message(is_remote_frame=True, dlc=9), "0 to 8 bytes"),
        (
            can.Message(arbitration_id=0x800, is_extended_id=False),
            "0x800 does not fit a CAN identifier of 11 bits",
        ),
        (can.Message(arbitration_id=0x20000000), "not fit a CAN identifier of 29 bits"),
        (can.Message(arbitration_id=-1), "not fit a CAN identifier of 29 bits"),
    ],
)
def test_refuses_what_the_bus_cannot_carry(join: Join, msg: can.Message, reason: str) -> None:
    bus, other = join(), join()
    with pytest.raises(can.CanOperationError, match=reason):
        bus.send(msg)
    assert other.recv(0) is None


def test_length_is_that_of_the_data(join: Join) -> None:
    bus, other = join(), join()
    msg = can.Message(data=b"\1\2")
    msg.data = bytearray(b"\1\2\3\4")  # as canopen updates a periodic message
    bus.send(msg)
    assert_same(other.recv(PLENTY_S), can.Message(data=b"\1\2\3\4"))


@pytest.mark.parametrize("own", ["hub", "client"])
def test_own_messages_on_request_only(join: Join, own: str) -> None:
    buses = [join(receive_own_messages=own == "hub"), join(receive_own_messages=own == "client")]
    bus, other = buses if own == "hub" else buses[::-1]
    bus.send(numbered(1))
    other.send(numbered(2))
    assert number_of(other.recv(PLENTY_S)) == 1
    received = bus.recv(PLENTY_S)
    assert number_of(received) == 1
    assert received is not None
    assert not received.is_rx
    assert number_of(bus.recv(PLENTY_S)) == 2
    assert bus.recv(0) is None
    assert other.recv(0) is None


def test_filters(join: Join) -> None:
    bus = join()
    filtered = join(can_filters=[{"can_id": 0x200, "can_mask": 0x780, "extended": False}])
    for can_id in (0x181, 0x205, 0x281):
        bus.send(can.Message(arbitration_id=can_id, is_extended_id=False))
    received = filtered.recv(PLENTY_S)
    assert received is not None
    assert received.arbitration_id == 0x205
    assert filtered.recv(ALONE_S) is None


def test_order_is_kept_both_ways(join: Join) -> None:
    count, ahead = 5000, 200  # a window, since nothing but its buffer slows a sender down
    buses = [join(), join()]
    windows = [threading.Semaphore(ahead), threading.Semaphore(ahead)]
    received: list[list[int]] = [[], []]

    def send(side: int) -> None:
        for number in range(count):
            windows[side].acquire(timeout=PLENTY_S)
            buses[side].send(numbered(number))

    def receive(side: int) -> None:
        while len(received[side]) < count and (msg := buses[side].recv(PLENTY_S)):
            received[side].append(number_of(msg))
            windows[1 - side].release()

    threads = [threading.Thread(target=work, args=(s,)) for work in (send, receive) for s in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert received == [list(range(count))] * 2


# Who sleeps


def test_hub_owner_that_never_receives_stalls_nobody(join: Join) -> None:
    hub, one, two = join(), join(), join()
    for number in range(200):
        one.send(numbered(2 * number))
        assert number_of(two.recv(PLENTY_S)) == 2 * number
        two.send(numbered(2 * number + 1))
        assert number_of(one.recv(PLENTY_S)) == 2 * number + 1
    # They waited for the owner.
    assert [number_of(hub.recv(0)) for _ in range(400)] == list(range(400))


def test_participant_that_never_reads_loses_its_own_frames_only(
    join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("canwall.bus.unixcan._SEND_BUFFER", 4 << 20)
    hub, sender, reader, deaf = join(), join(), join(), join()
    total = 0
    while hub.overruns == 0:
        assert total < 16000, "the deaf one's buffer never filled"
        for number in range(total, total + 100):
            sender.send(numbered(number))
        for number in range(total, total + 100):
            assert number_of(reader.recv(PLENTY_S)) == number
        total += 100
    while number_of(hub.recv(PLENTY_S)) < total - 1:
        pass  # what its owner has, the hub is done with
    dropped = hub.overruns
    assert [number_of(deaf.recv(0)) for _ in range(total - dropped)] == list(range(total - dropped))
    assert deaf.recv(0) is None
    assert_talk(sender, deaf, total)


def test_inbox_of_the_hub_is_bounded(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("canwall.bus.unixcan._INBOX_FRAMES", 10)
    hub, sender, reader = join(), join(), join()
    for number in range(15):
        sender.send(numbered(number))
        assert number_of(reader.recv(PLENTY_S)) == number
    hub.send(numbered(15))  # waits until the hub is done with the last one
    assert hub.overruns == 5
    assert [number_of(hub.recv(0)) for _ in range(10)] == list(range(10))
    assert hub.recv(0) is None


@pytest.mark.slow
def test_sender_waits_while_the_hub_is_stopped(channel: Path, join: Join, spawn: Spawn) -> None:
    hub = spawn("-c", HUB, str(channel))
    assert line_of(hub) == "joined"
    sender, reader = join(), join()
    assert_talk(sender, reader, 0)
    os.kill(hub.pid, signal.SIGSTOP)
    sent = 0

    def send_on() -> None:
        nonlocal sent
        while sent < 1_000_000:
            sender.send(numbered(sent), timeout=0)
            sent += 1

    with pytest.raises(can.CanOperationError, match="transmit buffer full"):
        send_on()
    with pytest.raises(can.CanOperationError, match="transmit buffer full"):
        sender.send(numbered(sent), timeout=0.01)

    received: list[int] = []
    thread = threading.Thread(
        target=lambda: received.extend(number_of(reader.recv(PLENTY_S)) for _ in range(sent + 1))
    )
    thread.start()
    os.kill(hub.pid, signal.SIGCONT)
    sender.send(numbered(sent), timeout=PLENTY_S)
    thread.join()
    assert received == list(range(sent + 1))


# Who leaves


def test_hub_that_closes_removes_its_socket(join: Join, channel: Path) -> None:
    hub = join()
    assert channel.is_socket()
    hub.shutdown()
    assert not channel.exists()


def test_forgotten_hub_is_collected_and_closed(
    channel: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hub = UnixBus(str(channel))
    del hub
    gc.collect()
    assert "UnixBus was not properly shut down" in caplog.text
    assert not channel.exists()


def test_hub_closes_its_own_socket_wherever_the_process_went(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with UnixBus("bus"):
        monkeypatch.chdir("/")
    assert not (tmp_path / "bus").exists()


def test_others_talk_on_when_the_hub_closes(
    join: Join, channel: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hub, one, two = join(), join(), join()
    assert_talk(one, two, 1)
    hub.shutdown()
    assert_talk(one, two, 2)
    assert_talk(two, one, 3)
    assert channel.is_socket()
    late = join()
    assert_talk(late, one, 4)
    assert_talk(two, late, 5)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_others_talk_on_when_the_hub_is_killed(channel: Path, join: Join, spawn: Spawn) -> None:
    hub = spawn("-c", HUB, str(channel))
    assert line_of(hub) == "joined"
    one, two = join(), join()
    assert_talk(one, two, 1)
    os.kill(hub.pid, signal.SIGKILL)
    hub.wait()
    assert channel.is_socket()  # nobody has removed it
    assert_talk(one, two, 2)
    assert_talk(two, one, 3)


def test_receivers_that_wait_rejoin_when_the_hub_is_killed(
    channel: Path, join: Join, spawn: Spawn
) -> None:
    hub = spawn("-c", HUB, str(channel))
    assert line_of(hub) == "joined"
    one, two, three = join(), join(), join()
    heard: list[int] = []
    waiting = [
        threading.Thread(target=lambda bus=bus: heard.append(number_of(bus.recv(PLENTY_S))))
        for bus in (two, three)
    ]
    for thread in waiting:
        thread.start()
    os.kill(hub.pid, signal.SIGKILL)
    hub.wait()
    while any(thread.is_alive() for thread in waiting):
        one.send(numbered(7))
        time.sleep(0.01)
    assert heard == [7, 7]


def test_stale_socket_of_a_killed_hub_is_replaced(channel: Path, join: Join, spawn: Spawn) -> None:
    hub = spawn("-c", HUB, str(channel))
    assert line_of(hub) == "joined"
    os.kill(hub.pid, signal.SIGKILL)
    hub.wait()
    assert channel.is_socket()
    one, two = join(), join()
    assert_talk(one, two, 1)


def test_forked_child_keeps_what_was_opened_after_a_bus_was_closed(join: Join) -> None:
    bus = join()
    bus.shutdown()
    pipes = [os.pipe() for _ in range(4)]  # some have the numbers that the bus had
    child = os.fork()
    if child == 0:
        try:
            for pipe in pipes:
                for descriptor in pipe:
                    os.fstat(descriptor)
        except OSError:
            os._exit(1)
        os._exit(0)
    for pipe in pipes:
        for descriptor in pipe:
            os.close(descriptor)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert bus.channel_info


def test_hub_with_a_forked_child_still_dies_for_the_others(
    channel: Path, join: Join, spawn: Spawn
) -> None:
    forking = HUB.replace(
        "while",
        "import os, time\nif (child := os.fork()) == 0: time.sleep(600)\n"
        "print(child, flush=True)\nwhile",
    )
    hub = spawn("-c", forking, str(channel))
    assert line_of(hub) == "joined"
    child = int(line_of(hub))
    try:
        one, two = join(), join()
        assert_talk(one, two, 1)
        os.kill(hub.pid, signal.SIGKILL)
        hub.wait()
        assert_talk(one, two, 2)
    finally:
        os.kill(child, signal.SIGKILL)


def test_last_frames_of_who_leaves_arrive(join: Join) -> None:
    hub, leaving, staying = join(), join(), join()
    hub.send(numbered(999))  # which it leaves unread
    for number in range(100):
        leaving.send(numbered(number))
    leaving.shutdown()
    assert [number_of(hub.recv(PLENTY_S)) for _ in range(100)] == list(range(100))
    for expected in (999, *range(100)):
        assert number_of(staying.recv(PLENTY_S)) == expected

    for number in range(5):
        hub.send(numbered(number))
    hub.shutdown()
    staying.send(numbered(0))  # finds out, and rejoins
    assert [number_of(staying.recv(PLENTY_S)) for _ in range(5)] == list(range(5))


def test_shutdown_is_final_and_idempotent(join: Join) -> None:
    bus = join()
    bus.shutdown()
    bus.shutdown()
    assert bus.fileno() == -1
    with pytest.raises(can.CanOperationError, match="shut down"):
        bus.send(numbered(0))
    with pytest.raises(can.CanOperationError, match="shut down"):
        bus.recv(0)


# Who comes


def test_two_processes_at_once_agree_on_one_hub(tmp_path: Path, spawn: Spawn) -> None:
    rounds = 10
    participant = """
import sys, can, canwall.bus.unixcan
me, *channels = sys.argv[1:]
for channel in channels:
    print("ready"); input()
    with can.Bus(interface="unixcan", channel=channel) as bus:
        print("joined"); input()
        bus.send(can.Message(arbitration_id=int(me)))
        other = bus.recv(20)
        print(other and other.arbitration_id); input()
"""
    channels = [str(tmp_path / str(number)) for number in range(rounds)]
    both = [spawn("-c", participant, me, *channels) for me in ("1", "2")]
    for _ in channels:
        for expected in (["ready", "ready"], ["joined", "joined"], ["2", "1"]):
            assert [line_of(process) for process in both] == expected
            for process in both:
                assert process.stdin is not None
                process.stdin.write("\n")
                process.stdin.flush()


def test_many_at_once_agree_on_one_hub(tmp_path: Path) -> None:
    count = 6
    for attempt in range(10):
        start = threading.Barrier(count)
        buses: list[UnixBus] = []

        def come(
            path: str = str(tmp_path / str(attempt)),
            start: threading.Barrier = start,
            buses: list[UnixBus] = buses,
        ) -> None:
            start.wait()
            buses.append(UnixBus(path))

        threads = [threading.Thread(target=come) for _ in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        with contextlib.ExitStack() as stack:
            for bus in buses:
                stack.enter_context(bus)
            assert len(buses) == count
            for sender, bus in enumerate(buses):
                bus.send(numbered(sender))
                for other in buses:
                    if other is not bus:
                        assert number_of(other.recv(PLENTY_S)) == sender


def test_who_has_joined_hears_the_next_frame(join: Join) -> None:
    hub = join()
    for number in range(5):
        late = join()
        hub.send(numbered(number))
        assert number_of(late.recv(PLENTY_S)) == number


def test_all_who_have_joined_hear_the_next_frame(join: Join) -> None:
    hub, sender, *others = (join() for _ in range(5))
    sender.send(numbered(1))  # before the hub has looked who is there
    for bus in (hub, *others):
        assert number_of(bus.recv(PLENTY_S)) == 1


# Channels that cannot be used


def refusal(channel: str | None, fd: bool = False) -> str:
    with pytest.raises(can.CanInitializationError) as caught:
        UnixBus(channel, fd=fd)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_no_channel() -> None:
    assert "give the path" in refusal(None)
    assert "give the path" in refusal("")
    with pytest.raises(can.CanInitializationError, match="give the path"):
        can.Bus(interface="unixcan", ignore_config=True)


def test_can_fd_is_not_offered(channel: Path) -> None:
    assert "leave fd out" in refusal(str(channel), fd=True)
    assert not channel.exists()


def test_directory_that_does_not_exist(tmp_path: Path) -> None:
    path = str(tmp_path / "nowhere" / "bus")
    message = refusal(path)
    assert path in message
    assert "directory does not exist; create it" in message


def test_directory_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "choose another path" in refusal(str(tmp_path / "file" / "bus"))


def test_directory_that_is_not_writable() -> None:
    message = refusal("/sys/canwall")
    assert "/sys/canwall" in message
    assert "no permission" in message or os.strerror(errno.EROFS) in message


def test_path_that_is_too_long(tmp_path: Path) -> None:
    path = str(tmp_path / ("x" * 107))
    message = refusal(path)
    assert path in message
    assert "107 bytes" in message


@pytest.mark.parametrize("kind", ["file", "directory", "link"])
def test_what_is_not_a_socket_is_left_alone(channel: Path, kind: str) -> None:
    if kind == "file":
        channel.write_text("a thesis")
    elif kind == "directory":
        channel.mkdir()
    else:
        channel.symlink_to("nowhere")
    assert "not a socket" in refusal(str(channel))
    assert os.path.lexists(channel)
    assert kind != "file" or channel.read_text() == "a thesis"
    assert [entry.name for entry in channel.parent.iterdir()] == ["bus"]


def test_socket_of_another_program_is_left_alone(channel: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as foreign:
        foreign.bind(str(channel))
        foreign.listen()
        assert "choose another path" in refusal(str(channel))
    assert channel.is_socket()


@pytest.mark.slow
@pytest.mark.parametrize("target", ["a thesis", None], ids=["to a file", "to nowhere"])
def test_lock_that_is_a_symbolic_link(channel: Path, target: str | None) -> None:
    foreign = channel.with_name("thesis")
    if target is not None:
        foreign.write_text(target)
    Path(f"{channel}.lock").symlink_to(foreign)
    with pytest.raises(can.CanInitializationError, match=r"its \.lock file is a symbolic link"):
        UnixBus(str(channel))
    assert (foreign.read_text() if foreign.exists() else None) == target
    assert not channel.exists()


@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo])
def test_lock_that_is_no_file(channel: Path, make: Callable[[str], None]) -> None:
    make(f"{channel}.lock")
    with pytest.raises(can.CanInitializationError, match=r"its \.lock is not a regular file"):
        UnixBus(str(channel))


def test_content_of_a_lock_file_is_left_alone(channel: Path) -> None:
    lock = Path(f"{channel}.lock")
    lock.write_text("a thesis")
    UnixBus(str(channel)).shutdown()
    assert lock.read_text() == "a thesis"


def test_lock_held_by_who_does_not_listen(channel: Path) -> None:
    with open(f"{channel}.lock", "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "hub does not answer" in refusal(str(channel))
    UnixBus(str(channel)).shutdown()


# python-can and canopen


@pytest.mark.parametrize("side", ["hub", "client"])
def test_fileno_is_readable_as_long_as_frames_wait(join: Join, side: str) -> None:
    buses = [join(), join()]
    bus, other = buses if side == "hub" else buses[::-1]
    bus.send(numbered(0))
    other.recv(PLENTY_S)

    def readable(timeout: float) -> bool:
        return bool(select.select([bus], [], [], timeout)[0])

    assert not readable(ALONE_S)
    for number in range(3):
        other.send(numbered(number))
    bus.send(numbered(3))  # the hub takes them in by this already
    for number in range(3):
        assert readable(PLENTY_S)
        assert number_of(bus.recv(0)) == number
    assert not readable(0)


@pytest.mark.parametrize("side", ["hub", "client"])
def test_notifier_with_asyncio(join: Join, side: str) -> None:
    buses = [join(), join()]
    bus, other = buses if side == "hub" else buses[::-1]

    async def listen() -> list[int]:
        reader = can.AsyncBufferedReader()
        with can.Notifier(bus, [reader], loop=asyncio.get_running_loop()):
            for number in range(20):
                other.send(numbered(number))
            bus.send(numbered(99))
            return [
                number_of(await asyncio.wait_for(reader.get_message(), PLENTY_S)) for _ in range(20)
            ]

    assert asyncio.run(listen()) == list(range(20))


def test_notifier_with_asyncio_outlives_the_hub(join: Join) -> None:
    hub, one, two = join(), join(), join()

    async def listen() -> None:
        reader = can.AsyncBufferedReader()
        with can.Notifier(one, [reader], loop=asyncio.get_running_loop()):
            hub.shutdown()
            heard = asyncio.ensure_future(reader.get_message())
            deadline = time.monotonic() + PLENTY_S
            while not heard.done() and time.monotonic() < deadline:
                two.send(numbered(1))
                await asyncio.sleep(0.01)
            assert number_of(await asyncio.wait_for(heard, ALONE_S)) == 1

    asyncio.run(listen())


def test_signal_handler_may_send_while_the_bus_sends(join: Join) -> None:
    bus, other = join(), join()
    main = threading.main_thread().ident
    assert main is not None
    done = threading.Event()

    def interrupt() -> None:
        while not done.is_set():
            signal.pthread_kill(main, signal.SIGUSR1)
            time.sleep(0.0005)

    interrupted: list[int] = []

    def handle(*_: object) -> None:
        interrupted.append(len(interrupted))
        bus.send(numbered(1_000_000 + interrupted[-1]))

    previous = signal.signal(signal.SIGUSR1, handle)
    thread = threading.Thread(target=interrupt)
    try:
        thread.start()
        received = []
        for number in range(2000):
            bus.send(numbered(number))
            while msg := other.recv(0):
                received.append(number_of(msg))
    finally:
        done.set()
        thread.join()
        signal.signal(signal.SIGUSR1, previous)
    while msg := other.recv(ALONE_S):
        received.append(number_of(msg))
    assert [number for number in received if number < 1_000_000] == list(range(2000))
    assert len([number for number in received if number >= 1_000_000]) == len(interrupted) > 0


def test_logger_of_python_can_records(
    channel: Path, tmp_path: Path, join: Join, spawn: Spawn
) -> None:
    record = tmp_path / "out.log"
    logger = spawn("-m", "can.logger", "-i", "unixcan", "-c", str(channel), "-f", str(record))
    assert line_of(logger) == f"Connected to UnixBus: unixcan channel '{channel}'"
    assert line_of(logger).startswith("Can Logger")
    bus = join()
    sent = [
        *(numbered(number) for number in range(50)),
        can.Message(arbitration_id=0x12345678, data=b"\xff"),
        can.Message(arbitration_id=0x701, is_extended_id=False, is_remote_frame=True),
    ]
    for msg in sent:
        bus.send(msg)
    # Its file is buffered: what pushes the record out of the buffer follows.
    filler = can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(8))
    deadline = time.monotonic() + PLENTY_S
    while not (record.exists() and "7FF#" in record.read_text()):
        assert time.monotonic() < deadline
        bus.send(filler)
        time.sleep(0.001)
    os.kill(logger.pid, signal.SIGINT)
    assert logger.wait(PLENTY_S) == 0
    with can.LogReader(record) as reader:
        recorded = [msg for msg in reader if msg.arbitration_id != 0x7FF]
    assert len(recorded) == len(sent)
    for received, expected in zip(recorded, sent, strict=True):
        assert_same(received, expected)


def test_sdo_upload_of_canopen(channel: Path) -> None:
    def dictionary() -> canopen.ObjectDictionary:
        objects = canopen.ObjectDictionary()
        name = canopen.objectdictionary.ODVariable("Manufacturer device name", 0x1008)
        name.data_type = canopen.objectdictionary.VISIBLE_STRING
        objects.add_object(name)
        return objects

    with contextlib.ExitStack() as stack:
        master, slave = canopen.Network(), canopen.Network()
        for network in (slave, master):
            network.NOTIFIER_CYCLE = 0.1
            network.connect(interface="unixcan", channel=str(channel))
            stack.callback(network.disconnect)
        local = slave.create_node(5, dictionary())
        remote = master.add_node(5, dictionary())
        remote.sdo.RESPONSE_TIMEOUT = PLENTY_S
        text = "longer than the four bytes of an expedited transfer"
        local.sdo[0x1008].raw = text
        assert remote.sdo[0x1008].raw == text
