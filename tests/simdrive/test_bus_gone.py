"""A drive whose bus is gone for a while goes on: time passes for it, what it sends is lost."""

import errno
import struct

import can
import pytest
from can.interfaces.virtual import VirtualBus
from rig import settings_with

from canwall import simdrive

_SDO_ANSWER, _SDO_REQUEST = 0x585, 0x605
_READ_STATUSWORD = bytes.fromhex("4041600000000000")


class Interface(VirtualBus):
    """Interface that may be down or have a full queue, with the errors of SocketCAN."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        self.receive_error = self.send_error = 0
        self.refused = 0

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.receive_error:
            code, self.receive_error = self.receive_error, 0  # told once
            raise can.CanOperationError("Error receiving: Network is down", code)
        return super().recv(timeout)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.send_error:
            self.refused += 1
            raise can.CanOperationError("Failed to transmit", self.send_error)
        super().send(msg, timeout)


def _ask(bus: VirtualBus) -> None:
    bus.send(can.Message(arbitration_id=_SDO_REQUEST, data=_READ_STATUSWORD, is_extended_id=False))


def _answers(bus: VirtualBus) -> int:
    found = 0
    while (message := bus.recv(0)) is not None:
        found += message.arbitration_id == _SDO_ANSWER
    return found


@pytest.mark.parametrize("code", [errno.ENETDOWN, errno.ENOBUFS])
def test_drive_goes_on(code: int) -> None:
    settings = settings_with()
    assert settings.simulation is not None
    drive = simdrive.make_drive(settings.drive, settings.simulation, 0.001)
    told: list[str] = []
    now_s = 0.0
    with Interface(f"gone {code}") as interface, VirtualBus(f"gone {code}") as master:
        runner = simdrive.BusRunner(drive, interface, lambda: now_s, report=told.append)
        heartbeat = struct.pack("<BHBI", 0x2B, 0x1017, 0, 50)  # every 50 ms
        master.send(can.Message(arbitration_id=_SDO_REQUEST, data=heartbeat, is_extended_id=False))
        rounds = 0

        def stop() -> bool:
            nonlocal rounds, now_s
            rounds += 1
            now_s += 0.01
            if rounds == 10:
                assert _answers(master) == 1
                interface.send_error = interface.receive_error = code
            if rounds == 20:
                _ask(master)
            if rounds == 30:
                assert _answers(master) == 0
                interface.send_error = 0
                _ask(master)
            return rounds == 40

        runner.run(stop)
        assert _answers(master) == 1
    assert interface.refused >= 3, "heartbeats and an answer"
    assert [line.split(":")[0] for line in told] == ["the bus is gone", "the bus is back"]


def test_interface_that_is_no_more_ends_it() -> None:
    settings = settings_with()
    assert settings.simulation is not None
    drive = simdrive.make_drive(settings.drive, settings.simulation, 0.001)
    with Interface("removed") as interface:
        runner = simdrive.BusRunner(drive, interface)
        interface.receive_error = errno.ENODEV
        with pytest.raises(can.CanOperationError):
            runner.run(lambda: False)
