"""The simulated drive alone, for long: frames in, frames out, and what it remembers of them."""

import gc
import resource
import struct
import time
from pathlib import Path
from typing import Any

from canwall import config, simdrive
from canwall.config import Settings
from canwall.run import make_simulated_drive

_WARM_UP = 100_000
_CYCLES = 10_000_000
_SYNC, _RPDO, _TPDO, _SDO, _NODE_ID = 0x080, 0x205, 0x185, 0x605, 5
_PAGE_BYTES = resource.getpagesize()
_TORQUE_PER_MILLE = 20


def endurance() -> dict[str, Any]:
    """Memory of a drive over ten million cycles, and how many of them it does per second.

    A cycle is SYNC, TPDO, RPDO and a tick of the protocol timers, enabled, in torque; the hand
    strikes as config/sim.toml has it. Every thousandth cycle an SDO reads a string in segments
    and an RPDO comes that is too short (EMCY).
    """
    settings: Settings = config.load(config.shipped("config/sim.toml"))
    drive = make_simulated_drive(settings)
    _enable(drive)
    _live(drive, _WARM_UP, settings.bus.cycle_s)
    before = _resident_mib()
    begin = time.perf_counter()
    _live(drive, _CYCLES, settings.bus.cycle_s)
    duration = time.perf_counter() - begin
    return {
        "cycles": _CYCLES,
        "cycles_per_s": round(_CYCLES / duration),
        "aim": ">= 50000",
        "resident_mib_before": before,
        "resident_mib_after": _resident_mib(),
    }


def _enable(drive: simdrive.ServoDrive) -> None:
    def write(index: int, subindex: int, value: int, size: int) -> None:
        head = 0x23 | (4 - size) << 2
        frames = drive.process(_SDO, struct.pack("<BHBL", head, index, subindex, value))
        if not any(can_id == 0x585 and data[0] == 0x60 for can_id, data in frames):
            raise RuntimeError(f"0x{index:04X}:{subindex:02X} was not written")

    drive.boot()
    drive.tick(0.001)
    for communication, cob_id, mapped in (
        (0x1400, _RPDO, (0x60400010, 0x60710010)),
        (0x1800, 0x40000000 | _TPDO, (0x60410010, 0x60640020, 0x60770010)),
    ):
        write(communication, 1, 0x80000000 | cob_id, 4)
        write(communication + 0x200, 0, 0, 1)
        for place, entry in enumerate(mapped, start=1):
            write(communication + 0x200, place, entry, 4)
        write(communication + 0x200, 0, len(mapped), 1)
        write(communication, 2, 1, 1)
        write(communication, 1, cob_id, 4)
    write(0x1801, 1, 0xC0000285, 4)
    write(0x1802, 1, 0xC0000385, 4)
    write(0x6060, 0, 10, 1)
    drive.process(0x000, bytes([1, _NODE_ID]))
    for controlword in (0x06, 0x07, 0x0F):
        write(0x6040, 0, controlword, 2)


def _live(drive: simdrive.ServoDrive, cycles: int, period_s: float) -> None:
    process, tick = drive.process, drive.tick
    rpdos = [struct.pack("<Hh", 0x0F, torque) for torque in (_TORQUE_PER_MILLE, -_TORQUE_PER_MILLE)]
    for cycle in range(cycles):
        frames = process(_SYNC, b"")
        process(_RPDO, rpdos[cycle // 100 & 1])
        tick(period_s)
        if cycle % 1000 == 0:
            process(_SDO, bytes.fromhex("40 0810 00 00000000"))
            for segment in range(5):
                process(_SDO, bytes([0x60 | (segment & 1) << 4]).ljust(8, b"\0"))
            process(_RPDO, b"\x0f")
            process(_RPDO, rpdos[0])
    statusword = int.from_bytes(frames[0][1][:2], "little")
    if frames[0][0] != _TPDO or statusword & 0x6F != 0x27:
        raise RuntimeError(f"the drive did not stay enabled: {statusword:04X}")


def _resident_mib() -> float:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * _PAGE_BYTES / 2**20, 1)
