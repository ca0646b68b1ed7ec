"""The descriptor of the cycle: the kernel's stamps on what comes through it, and its end."""

import os
import signal
import socket
import time
from pathlib import Path

import can
import numpy as np
import pytest
from rig import RPDO1, TPDO1

from canwall.bus import socket_pair
from canwall.bus.cycle_socket import CycleSocket
from canwall.bus.raw_socket import FAILED, FRAME, PORT, place_port, receive, send
from canwall.cycle.core import CORE, begin
from canwall.cycle.sockets import SocketTransport
from canwall.cycle.transport import CycleFrames
from canwall.drive import Link


def test_kernel_stamps_of_a_borrowed_descriptor() -> None:
    port = np.zeros(1, PORT)
    place_port(port)
    ours, theirs = socket_pair("stamps")
    with ours, theirs:
        sock = CycleSocket(ours, [TPDO1], [RPDO1], stamps=True)
        assert sock.stamped
        assert not sock.own
        before = time.time_ns()
        theirs.send(can.Message(arbitration_id=TPDO1, data=b"\x01", is_extended_id=False))
        after = time.time_ns()
        assert receive(port[0], sock.descriptor, True) == FRAME
        assert before <= port["stamp_ns"][0] <= after
        assert not CycleSocket(theirs, [TPDO1], [RPDO1]).stamped


def test_signal_does_not_end_the_wait_for_room() -> None:
    port = np.zeros(1, PORT)
    place_port(port)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    handler = signal.signal(signal.SIGALRM, lambda *_: None)
    with ours, theirs:
        while send(port[0], ours.fileno(), 0x181, 8, 0, 0) == FRAME:
            pass
        signal.setitimer(signal.ITIMER_REAL, 0.02, 0.02)
        begin = time.monotonic()
        try:
            assert send(port[0], ours.fileno(), 0x181, 8, 0, 200_000_000) == FAILED
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, handler)
        assert time.monotonic() - begin >= 0.2


def test_number_of_a_connection_that_is_closed_is_not_used_again(tmp_path: Path) -> None:
    """It may be that of another file by then, as of the record: no RPDO gets into it."""
    channel = str(tmp_path / "bus")
    hub = can.Bus(interface="unixcan", channel=channel)
    with can.Bus(interface="unixcan", channel=channel) as bus:
        core, frames = np.zeros(1, CORE), CycleFrames((TPDO1,), (RPDO1,), False, 0.001)
        transport = SocketTransport(Link(bus), core, frames)
        hub.shutdown()
        begin(core, 1, 0)
        with pytest.raises(can.CanOperationError):
            transport.run()
        bus.recv(0.0)  # it joins again, as the hub
        with (tmp_path / "file").open("wb") as file:
            os.dup2(file.fileno(), transport.descriptor)
            begin(core, 1, 0)
            with pytest.raises(can.CanOperationError, match="the other side of the bus has gone"):
                transport.run()
            os.close(transport.descriptor)
            assert file.tell() == 0
        transport.close()
