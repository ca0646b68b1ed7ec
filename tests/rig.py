"""A simulated drive and its master on one virtual bus, in one thread: what several tests need."""

import itertools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, cast

import can
import numpy as np
from can.interfaces.virtual import VirtualBus
from numpy.typing import NDArray

from canwall import config, simdrive
from canwall.bus import socket_pair
from canwall.config import Settings
from canwall.cycle import (
    Exchange,
    Outcome,
    PythonCanTransport,
    SocketTransport,
    WallAxis,
    WallStage,
    run_laws,
    run_loop,
)
from canwall.drive import REQUIRED_OBJECTS, DriveNode, DriveSetup, Link, set_up
from canwall.eds import load_eds
from canwall.record import Ring
from canwall.run import make_monitor

SIM_CONFIG = config.shipped("config/sim.toml")
IDEAL_CONFIG = config.shipped("config/ideal.toml")
SYNC, TPDO1, RPDO1, SDO_REQUEST, SDO_ANSWER = 0x080, 0x185, 0x205, 0x605, 0x585

Object: TypeAlias = tuple[int, int]
"""Index and subindex."""

RigFactory: TypeAlias = Callable[..., "Rig"]
"""Makes a rig that is closed at the end of the test; arguments as Rig."""

_channels = itertools.count()
_INITIATE_DOWNLOAD = 1


def settings_with(overrides: Mapping[str, Any] | None = None) -> Settings:
    """config/ideal.toml with other values under dotted keys: an ideal servo, a matched model."""
    return config.load(IDEAL_CONFIG, overrides)


def multiplexer(data: bytes) -> Object:
    """Index and subindex of an SDO's first request or answer."""
    return int.from_bytes(data[1:3], "little"), data[3]


@dataclass
class Tampering:
    """Stands between the bus and a drive, so that tests have drives that misbehave."""

    drive: simdrive.ServoDrive
    #: Values that uploads give instead of the drive's own.
    lies: dict[Object, int] = field(default_factory=dict)
    #: Values of objects that the drive does not have.
    invented: dict[Object, int] = field(default_factory=dict)
    #: Abort codes that requests for these objects get.
    aborts: dict[Object, int] = field(default_factory=dict)
    #: Abort codes that writes to these objects get; they may be read.
    read_only: dict[Object, int] = field(default_factory=dict)
    #: CAN-IDs that the drive does not hear, and those that it does not send.
    deaf: set[int] = field(default_factory=set)
    mute: set[int] = field(default_factory=set)

    @property
    def real_time(self) -> bool:
        return self.drive.real_time

    def boot(self) -> list[simdrive.Frame]:
        return self._out(self.drive.boot())

    def tick(self, dt: float) -> list[simdrive.Frame]:
        return self._out(self.drive.tick(dt))

    def process(self, can_id: int, data: bytes) -> list[simdrive.Frame]:
        if can_id in self.deaf:
            return []
        refused = self.aborts
        if can_id == SDO_REQUEST and data[0] >> 5 == _INITIATE_DOWNLOAD:
            refused = self.aborts | self.read_only
        if can_id == SDO_REQUEST and multiplexer(data) in refused:
            code = refused[multiplexer(data)]
            return [(SDO_ANSWER, b"\x80" + data[1:4] + code.to_bytes(4, "little"))]
        if can_id == SDO_REQUEST and multiplexer(data) in self.invented and data[0] >> 5 == 2:
            value = self.invented[multiplexer(data)]
            return [(SDO_ANSWER, b"\x43" + data[1:4] + value.to_bytes(4, "little"))]
        return self._out(self.drive.process(can_id, data))

    def request(self, can_id: int) -> list[simdrive.Frame]:
        return [] if can_id in self.deaf else self._out(self.drive.request(can_id))

    def _out(self, frames: list[simdrive.Frame]) -> list[simdrive.Frame]:
        return [(i, self._lied(i, data)) for i, data in frames if i not in self.mute]

    def _lied(self, can_id: int, data: bytes) -> bytes:
        if can_id == SDO_ANSWER and data[0] >> 5 == 2 and multiplexer(data) in self.lies:
            return data[:4] + self.lies[multiplexer(data)].to_bytes(4, "little")
        return data


class Rig:
    """Drive, bus and master; `frames` is every frame that the master sent and received."""

    def __init__(
        self,
        settings: Settings | None = None,
        bus: Callable[[str], can.BusABC] = VirtualBus,
        native: bool = False,
    ) -> None:
        """`native`: on a socket pair, for the exchange in compiled code."""
        self.native = native
        self.settings = settings or settings_with()
        assert self.settings.simulation is not None
        if self.settings.real_time:
            simdrive.load_compiled_code(self.settings.simulation.real_time)
        channel = f"rig {next(_channels)}"
        self.bus: can.BusABC
        self.drive_bus: can.BusABC
        if native:
            self.bus, self.drive_bus = socket_pair(channel)
        else:
            self.bus, self.drive_bus = bus(channel), VirtualBus(channel)
        self.tampering = Tampering(
            simdrive.make_drive(
                self.settings.drive, self.settings.simulation, self.settings.bus.cycle_s
            )
        )
        self.runner = self.switch_on(cast(simdrive.ServoDrive, self.tampering))
        self.link = Link(self.bus, idle=self.runner.poll)
        self.link.log = self._note
        self.frames: list[tuple[int, bytes]] = []
        dictionary = load_eds(self.settings.drive.eds, 5, REQUIRED_OBJECTS)
        self.node = DriveNode(self.link, 5, dictionary, self.settings.drive.sdo_timeout_s)
        self.rings: list[Ring] = []

    def switch_on(self, drive: simdrive.ServoDrive) -> simdrive.BusRunner:
        """Put the drive onto its end of the bus."""
        return simdrive.BusRunner(drive, self.drive_bus)

    def _note(self, time_s: float, message: can.Message, received: bool) -> None:
        self.frames.append((message.arbitration_id, bytes(message.data)))

    def close(self) -> None:
        self.bus.shutdown()
        self.drive_bus.shutdown()
        for ring in self.rings:
            ring.close()

    def set_up(self) -> DriveSetup:
        settings = self.settings
        return set_up(
            self.node, settings.drive, settings.bus, settings.limits.torque_nm, settings.real_time
        )

    def inject(self, can_id: int, data: bytes) -> None:
        """A frame of somebody else, for master and drive."""
        self.drive_bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def rpdos(self) -> list[tuple[int, int]]:
        """Controlword and target torque of each RPDO so far."""
        return [
            (int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little", signed=True))
            for can_id, data in self.frames
            if can_id == RPDO1
        ]


def lack(rig: Rig, *missing: int) -> None:
    """Take objects out of the drive's dictionary or, for 0x1400, the event timers of its RPDOs."""
    for index in missing:
        if index == 0x1400:
            for communication in range(0x1400, 0x1404):
                del rig.node.dictionary[communication].subindices[5]
        else:
            del rig.node.dictionary[index]


class Loop:
    """Loop on a rig, assembled around a set-up drive as by `canwall run`, without a writer."""

    def __init__(self, rig: Rig, real_time: bool = False) -> None:
        self.rig = rig
        self.laws = run_laws(rig.settings)
        self.setup = rig.set_up()
        self.ring = Ring.create()
        rig.rings.append(self.ring)
        self.axis = WallAxis(rig.node, self.setup, rig.settings, self.laws, self.ring)
        self.record = self.axis.cycle
        self.exchange = self.make_exchange(real_time)
        self.monitor = make_monitor(rig.link, [self.axis])

    def make_exchange(self, real_time: bool = False, external_sync: bool = False) -> Exchange:
        """The exchange that the rig is for, with its own SYNC or somebody else's."""
        transport = SocketTransport if self.rig.native else PythonCanTransport
        return Exchange(self.rig.link, [self.axis], real_time, external_sync, transport)

    def run(
        self,
        cycles: int | None,
        stop: Callable[[int], bool] = lambda j: False,
        changes: list[WallStage] | None = None,
        progress: Callable[[int], None] = lambda j: None,
    ) -> Outcome:
        """`stop` is asked once a cycle, with the cycle: a place to do things as well."""
        self.axis.changes = changes or []
        return run_loop(
            self.exchange,
            lambda loop: loop.render(cycles),
            lambda: stop(int(self.record["j"][0])),
            progress,
        )

    def rows(self) -> NDArray[np.void]:
        """One row per cycle so far."""
        return self.ring.take_rows()


def eds_without(path: Path, *sections: str) -> Path:
    """The drive's EDS without some objects: names of sections, e.g. "6064" or "1400sub5"."""
    kept, keep = [], True
    for line in (SIM_CONFIG.parent.parent / "eds" / "canwall-drive.eds").read_text().splitlines():
        if line.startswith("["):
            name = line.strip("[]")
            keep = name not in sections and name.split("sub")[0] not in sections
        if keep:
            kept.append(line)
    path.write_text("\n".join(kept))
    return path


def eds_with(path: Path, changes: Mapping[tuple[str, str], str]) -> Path:
    """The drive's EDS with other values, by section and key, e.g. ("1800sub1", "AccessType")."""
    text = (SIM_CONFIG.parent.parent / "eds" / "canwall-drive.eds").read_text()
    for (section, key), value in changes.items():
        before, head, rest = text.partition(f"[{section}]\n")
        text = before + head + re.sub(rf"{key}=.*", f"{key}={value}", rest, count=1)
    path.write_text(text)
    return path
