"""canopen's SDO client and the simulated drive at the two ends of a virtual bus, in one thread."""

import itertools
import math
from dataclasses import dataclass

import can
import canopen
from can.interfaces.virtual import VirtualBus
from simdrive_bench import EDS, NODE_ID, PERIOD_S, SYNC

from canwall.simdrive import BusRunner, Dictionary, ServoDrive
from canwall.simdrive.profile.hardware import Hardware

RATED_NM = 0.637
COUNTS_PER_RAD = 131072 / (2.0 * math.pi)

_channels = itertools.count()


@dataclass
class Flywheel:
    """A free inertia; torque is what the motor gives it."""

    inertia_kg_m2: float = 1.0e-4
    position_rad: float = 0.0
    speed_rad_s: float = 0.0
    pulled_nm: float = 0.0

    def counts(self) -> int:
        return round(self.position_rad * COUNTS_PER_RAD)

    def speed_counts_per_s(self) -> float:
        return self.speed_rad_s * COUNTS_PER_RAD

    def torque_nm(self) -> float | None:
        return None

    def advance(self, torque_nm: float, duration_s: float) -> None:
        self.pulled_nm = torque_nm
        change = torque_nm / self.inertia_kg_m2 * duration_s
        self.position_rad += (self.speed_rad_s + 0.5 * change) * duration_s
        self.speed_rad_s += change


class _Network(canopen.Network):
    """Gives the drive its turn after each frame; then everything sent has been answered."""

    def __init__(self, bench: "BusBench", bus: can.BusABC) -> None:
        super().__init__(bus)
        self._bench = bench

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        super().send_message(can_id, data, remote)
        self._bench.turn()


class BusBench:
    """A drive with a flywheel, and its master; time stands still but for ``wait``."""

    def __init__(self, hardware: Hardware | None = None) -> None:
        channel = f"bus bench {next(_channels)}"
        self.now_s = 0.0
        self.flywheel = Flywheel()
        self._master, self._slave = VirtualBus(channel), VirtualBus(channel)
        dictionary = Dictionary.load(EDS, NODE_ID)
        self.drive = ServoDrive(dictionary, NODE_ID, self.flywheel, PERIOD_S, hardware=hardware)
        self._runner = BusRunner(self.drive, self._slave, lambda: self.now_s)
        self.network = _Network(self, self._master)
        self.node = canopen.RemoteNode(NODE_ID, str(EDS))
        self.network.add_node(self.node)
        self.turn()

    def close(self) -> None:
        self._master.shutdown()
        self._slave.shutdown()

    def turn(self) -> None:
        """Let the drive, and then the master, have the frames that wait for them."""
        self._runner.poll()
        while (message := self._master.recv(0)) is not None:
            self.network.notify(message.arbitration_id, message.data, message.timestamp)

    def wait(self) -> None:
        """Let a tick of the protocol timers pass."""
        self.now_s += 1.5 * PERIOD_S
        self.turn()

    def sync(self) -> None:
        self.network.send_message(SYNC, b"")

    def nmt(self, command: int) -> None:
        self.network.send_message(0x000, bytes([command, NODE_ID]))

    def read(self, index: int, subindex: int = 0) -> int:
        value = self.node.sdo.upload(index, subindex)
        variable = self.node.object_dictionary.get_variable(index, subindex)
        assert variable is not None
        return int(variable.decode_raw(value))

    def write(self, index: int, value: int, subindex: int = 0) -> None:
        variable = self.node.object_dictionary.get_variable(index, subindex)
        assert variable is not None
        self.node.sdo.download(index, subindex, variable.encode_raw(value))

    def emergencies(self) -> list[int]:
        """Error codes of the EMCY so far."""
        return [error.code for error in self.node.emcy.log]
