"""The drive on a socket pair: frame for frame the drive on python-can's virtual bus."""

import ctypes
import struct
import time
from typing import Any

import numpy as np
import pytest
from rig import settings_with
from simdrive_bench import EMCY, HEARTBEAT, RPDO, SYNC, TPDO
from test_steady import enabled

from canwall.bus import DataFrame, socket_pair
from canwall.config import Simulation
from canwall.cycle import WallAxis, run_laws
from canwall.record import TIMING_COLUMNS, Ring
from canwall.run import drive_dictionary, make_axis, make_exchange, on_the_bus, render
from canwall.simdrive import SocketRunner

CYCLES = 1200
#: CAN-IDs of PDOs, which are compared by rows.
PDOS = range(0x180, 0x580)


def rendered(exchange: str, overrides: dict[str, Any], asks_at: int = 0) -> Any:
    """Rows and PDOs of a run, how often Python had to do with the drive, and objects read."""
    settings = settings_with(
        {"run.duration_s": CYCLES * 1e-3, "bus.exchange": exchange} | overrides
    )
    frames: list[tuple[int, bytes]] = []
    polls: list[None] = []
    read: list[int] = []
    with on_the_bus(settings) as link:
        laws, ring = run_laws(settings), Ring.create()
        axis: WallAxis = make_axis(link, settings, drive_dictionary(settings), laws, ring)
        link.log = lambda time_s, message, received: frames.append(
            (message.arbitration_id, bytes(message.data))
        )
        cycle = make_exchange(link, [axis])
        poll = link.idle
        assert poll is not None

        def counted() -> None:
            polls.append(None)
            poll()

        def stop() -> bool:
            if asks_at and not read and axis.cycle["j"][0] >= asks_at:
                read.extend(axis.node.read(index) for index in (0x6064, 0x6071, 0x6077, 0x6041))
                read.append(int(axis.cycle["j"][0]))
            return False

        link.idle = counted
        outcome = render(cycle, stop)
        assert outcome.trips == []
    rows = ring.take_rows()
    ring.close()
    pdos = [frame for frame in frames if frame[0] in PDOS]
    return rows, pdos, len(polls), read


def assert_same(ours: Any, theirs: Any) -> None:
    for name in set(ours.dtype.names) - set(TIMING_COLUMNS):
        assert ours[name][:CYCLES].tolist() == theirs[name][:CYCLES].tolist(), name


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        {"wall.law": "half_sample"},
        # Beyond the rated torque: limits and I²t.
        {"wall.law": "standard", "limits.torque_error_nm": 0.0, "simulation.overload_s": 0.02},
        {
            "wall.law": "mean_force",
            "simulation.current_bandwidth_hz": 500.0,
            "simulation.drive_cycle_s": 0.00025,
            "simulation.clock_ppm": 50.0,
        },
        {"wall.law": "half_sample", "simulation.velocity_filter_hz": 100.0},
        # Not in steady operation.
        {"wall.law": "half_sample", "simulation.torque_delay_cycles": 0.5},
    ],
)
def test_frames_are_the_same(overrides: dict[str, Any]) -> None:
    ours, our_pdos, polls, _ = rendered("native", overrides)
    theirs, their_pdos, their_polls, _ = rendered("python-can", overrides)
    assert_same(ours, theirs)
    assert our_pdos[: 3 * CYCLES] == their_pdos[: 3 * CYCLES]
    steady = "simulation.torque_delay_cycles" not in overrides
    assert (polls < their_polls / 4) == steady


def test_drive_is_whole_for_those_who_ask_in_between() -> None:
    rows, _, _, (position, target, actual, statusword, j) = rendered(
        "native", {"wall.law": "half_sample"}, asks_at=600
    )
    before = rows[rows["j"] == j - 1][0]
    assert position == before["counts"]
    assert statusword == before["statusword"]
    nm = rows["torque_cmd"][j - 1] / rows["torque_cmd_per_mille"][j - 1]
    assert actual == round(before["torque_applied"] / nm)
    # A synchronous RPDO has its effect at the next SYNC.
    assert target == rows["torque_cmd_per_mille"][j - 2] != 0
    assert np.all(np.diff(rows["j"]) == 1)


def test_timers_go_on_in_steady_operation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Heartbeats every 10 ms, and EMCY 0x8250 once no RPDO has come for 40 ms."""
    bench = enabled(Simulation())
    bench.write(0x1017, 0, 10, 2)
    bench.write(0x1402, 5, 40, 2)
    bench.sync()
    monkeypatch.setattr(bench.drive, "boot", list)  # it is up
    master, slave = socket_pair()
    with master, slave:
        runner = SocketRunner(bench.drive, slave)
        serve = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_uint64)(runner.compiled.address)
        heard: list[tuple[int, bytes]] = []
        polls = cycles = 0
        sent_s = [0.0]
        begin_s = time.monotonic()
        while (passed_s := time.monotonic() - begin_s) < 2.0 and EMCY not in dict(heard):
            if passed_s < 0.1:
                sent_s.append(passed_s)
                master.send(DataFrame(RPDO[3], struct.pack("<Hh", 0x0F, 10)))
            master.send(DataFrame(SYNC, b""))
            cycles += 1
            if not serve(runner.compiled.state):
                polls += 1
                runner.poll()
            while (message := master.recv(0)) is not None:
                heard.append((message.arbitration_id, bytes(message.data)))
    ids = [can_id for can_id, _ in heard]
    assert ids.count(TPDO[3]) >= cycles - 1
    # A machine that stands still between two RPDOs, or two ticks, misses some of either.
    assert 1 <= ids.count(HEARTBEAT) <= passed_s / 0.01 + 1
    assert struct.unpack_from("<H", dict(heard)[EMCY])[0] == 0x8250
    assert np.diff([*sent_s, passed_s]).max() > 0.04
    assert polls < cycles / 5
