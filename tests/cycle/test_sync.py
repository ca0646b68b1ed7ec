"""SYNC: its producer and its counter."""

import can
import pytest
from rig import SYNC, Loop, Rig, RigFactory, settings_with


def sent_by(rig: Rig) -> list[bytes]:
    return [data for can_id, data in rig.frames if can_id == SYNC]


def test_counter_runs_from_one_to_its_overflow_value(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"wall.law": "half_sample"}))
    rig.node.write(0x1019, 0, 7)
    loop = Loop(rig)
    assert loop.setup.sync_counter_overflow == 7
    rig.frames.clear()
    outcome = loop.run(300)
    assert outcome.trips == []
    assert [data[0] for data in sent_by(rig)[:16]] == [1, 2, 3, 4, 5, 6, 7] * 2 + [1, 2]
    assert int(loop.record["missed_tpdo"][0]) == 0


def test_without_a_counter_sync_is_empty(make_rig: RigFactory) -> None:
    rig = make_rig()
    loop = Loop(rig)
    loop.exchange.cycle()
    assert sent_by(rig) == [b""]


class Producer:
    """Another node that sends the SYNC, whenever the master waits for it."""

    def __init__(self, rig: Rig, limit: int | None = None) -> None:
        self._rig, self._limit, self.sent = rig, limit, 0
        self._idle = rig.link.idle
        rig.link.idle = self._produce

    def _produce(self) -> None:
        # The drive first: a SYNC follows when the cycle before is over.
        assert self._idle is not None
        self._idle()
        waits = self.sent == len([0 for can_id, _ in self._rig.frames if can_id == 0x205])
        if waits and (self._limit is None or self.sent < self._limit):
            self.sent += 1
            for bus in (self._rig.bus, self._rig.drive_bus):
                bus.send(can.Message(arbitration_id=SYNC, is_extended_id=False))


def with_external_sync(rig: Rig) -> Loop:
    loop = Loop(rig)
    rig.frames.clear()
    loop.exchange = loop.make_exchange(external_sync=True)
    return loop


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_wall_on_the_sync_of_another_producer(make_rig: RigFactory) -> None:
    settings = settings_with({"wall.law": "half_sample", "bus.sync": "external"})
    rig = make_rig(settings)
    loop = with_external_sync(rig)
    Producer(rig)
    outcome = loop.run(400)
    assert outcome.trips == []
    assert outcome.disabled
    produced = make_rig(settings_with({"wall.law": "half_sample"}))
    ours = Loop(produced)
    ours.run(400)
    external, own = loop.rows(), ours.rows()
    assert len(external) == len(own) > 400
    for name in ("j", "counts", "statusword", "torque_cmd_per_mille", "v_est"):
        assert external[name].tolist() == own[name].tolist(), name


def test_producer_that_falls_silent_ends_the_run(make_rig: RigFactory) -> None:
    settings = settings_with({"wall.law": "half_sample", "bus.sync": "external"})
    rig = make_rig(settings)
    loop = with_external_sync(rig)
    Producer(rig, limit=250)
    outcome = loop.run(None)
    assert outcome.trips[0] == "the bus failed: no SYNC from its producer for 0.1 s"
    assert outcome.disabled  # over SDO
    assert rig.node.read(0x6041) & 0x6F == 0x40
