"""A master's hands for the tests: real frames into the simulated drive, real frames out."""

import struct
from dataclasses import dataclass, field
from pathlib import Path

from canopen import SdoAbortedError

from canwall.simdrive import Dictionary, Frame, ServoDrive
from canwall.simdrive.communication.memory import Memory

EDS = Path(__file__).parents[2] / "eds" / "canwall-drive.eds"
NODE_ID = 5
PERIOD_S = 0.001
SYNC = 0x080
EMCY = 0x080 + NODE_ID
SDO_REQUEST = 0x600 + NODE_ID
SDO_RESPONSE = 0x580 + NODE_ID
HEARTBEAT = 0x700 + NODE_ID
RPDO = {1: 0x205, 2: 0x305, 3: 0x405, 4: 0x505}
TPDO = {1: 0x185, 2: 0x285, 3: 0x385, 4: 0x485}

START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130

NOT_VALID = 1 << 31
NO_RTR = 1 << 30
CONTROLWORD = 0x60400010
MODE = 0x60600008
TARGET_TORQUE = 0x60710010
STATUSWORD = 0x60410010
POSITION = 0x60640020
ACTUAL_TORQUE = 0x60770010


@dataclass
class RecordingMotion:
    """Writes down what the drive does with it; each period moves it by ``step`` counts."""

    position: int = 1000
    step: int = 7
    speed: float = 12.6
    calls: list[tuple[object, ...]] = field(default_factory=list)

    def counts(self) -> int:
        self.calls.append(("counts", self.position))
        return self.position

    def speed_counts_per_s(self) -> float:
        return self.speed

    def torque_nm(self) -> float | None:
        return None

    def advance(self, torque_nm: float, duration_s: float) -> None:
        self.calls.append(("advance", torque_nm, duration_s))
        self.position += self.step


class Bench:
    """One booted drive, and what a master does to it."""

    def __init__(self, eds: Path = EDS, store: Path | None = None, node_id: int = NODE_ID) -> None:
        self.motion = RecordingMotion()
        dictionary = Dictionary.load(eds, node_id)
        self.drive = ServoDrive(dictionary, node_id, self.motion, PERIOD_S, Memory(store))
        self.sent = self.drive.boot()
        """Every frame that the drive has sent."""

    def give(self, can_id: int, data: bytes = b"") -> list[Frame]:
        frames = self.drive.process(can_id, data)
        self.sent += frames
        return frames

    def request(self, can_id: int) -> list[Frame]:
        """Send a remote frame."""
        frames = self.drive.request(can_id)
        self.sent += frames
        return frames

    def tick(self, dt: float = PERIOD_S) -> list[Frame]:
        frames = self.drive.tick(dt)
        self.sent += frames
        return frames

    def sync(self) -> list[Frame]:
        return self.give(SYNC)

    def nmt(self, command: int, node_id: int = NODE_ID) -> list[Frame]:
        return self.give(0x000, bytes([command, node_id]))

    def sdo(self, request: bytes) -> bytes:
        """Return the response to one SDO frame."""
        frames = self.give(SDO_REQUEST, request)
        (response,) = [data for can_id, data in frames if can_id == SDO_RESPONSE]
        if response[0] == 0x80:
            raise SdoAbortedError(struct.unpack_from("<L", response, 4)[0])
        return response

    def read(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        """Return a number of up to four bytes (expedited upload)."""
        response = self.sdo(struct.pack("<BHB4x", 0x40, index, subindex))
        assert response[0] & 0xE3 == 0x43, "expedited, size indicated"
        assert response[1:4] == struct.pack("<HB", index, subindex)
        size = 4 - (response[0] >> 2 & 3)
        return int.from_bytes(response[4 : 4 + size], "little", signed=signed)

    def write(self, index: int, subindex: int, value: int, size: int) -> None:
        """Write a number of ``size`` bytes (expedited download)."""
        data = value.to_bytes(size, "little", signed=value < 0).ljust(4, b"\0")
        head = 0x23 | (4 - size) << 2
        response = self.sdo(struct.pack("<BHB4s", head, index, subindex, data))
        assert response == struct.pack("<BHB4x", 0x60, index, subindex)

    def configure_pdo(
        self, communication: int, cob_id: int, kind: int, mapping: list[int], event_ms: int = 0
    ) -> None:
        """Set a PDO up in the order of CiA 301."""
        objects = communication + 0x200
        self.write(communication, 1, cob_id | NOT_VALID, 4)
        self.write(objects, 0, 0, 1)
        for place, mapped in enumerate(mapping, start=1):
            self.write(objects, place, mapped, 4)
        self.write(objects, 0, len(mapping), 1)
        self.write(communication, 2, kind, 1)
        self.write(communication, 5, event_ms, 2)
        self.write(communication, 1, cob_id, 4)

    def configure_cycle(self) -> None:
        """Make RPDO3 and TPDO3 the cyclic pair, and silence the event-driven TPDOs."""
        for communication in (0x1800, 0x1801):
            self.write(communication, 1, NOT_VALID | NO_RTR | 0x185, 4)
        self.configure_pdo(0x1402, RPDO[3], 1, [CONTROLWORD, TARGET_TORQUE])
        cyclic = [STATUSWORD, POSITION, ACTUAL_TORQUE]
        self.configure_pdo(0x1802, NO_RTR | TPDO[3], 1, cyclic)
        self.write(0x6060, 0, 10, 1)

    def command(self, controlword: int, torque: int = 0) -> None:
        """Send the cyclic RPDO."""
        self.give(RPDO[3], struct.pack("<Hh", controlword, torque))

    def cycle(self) -> tuple[int, int, int]:
        """Send SYNC; return statusword, position and actual torque of the one answer."""
        ((can_id, data),) = self.sync()
        assert can_id == TPDO[3]
        status, position, torque = struct.unpack("<Hih", data)
        return status, position, torque

    def enable(self) -> None:
        """Go to OPERATION ENABLED in mode 10 over SDO, and to NMT OPERATIONAL."""
        self.tick()
        self.write(0x6060, 0, 10, 1)
        self.nmt(START)
        for controlword in (0x06, 0x07, 0x0F):
            self.write(0x6040, 0, controlword, 2)
        assert self.read(0x6041) & 0x6F == 0x27

    def emergencies(self) -> list[tuple[int, int]]:
        """Return code and error register of every EMCY so far."""
        return [struct.unpack("<HB5x", data) for can_id, data in self.sent if can_id == EMCY]


def eds_with(directory: Path, sections: str) -> Path:
    """Return an EDS that has more objects than the drive's own."""
    path = directory / "more.eds"
    path.write_text(EDS.read_text() + "\n" + sections)
    return path
