"""The descriptor of the cycle: the kernel's time stamps on what comes through it."""

import signal
import socket
import time

import can
import numpy as np
from rig import RPDO1, TPDO1

from canwall.bus import socket_pair
from canwall.bus.cycle_socket import CycleSocket
from canwall.bus.raw_socket import FAILED, FRAME, PORT, place_port, receive, send


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
