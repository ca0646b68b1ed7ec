"""The simulated drive: frames to services by NMT state, and the effect of SYNC."""

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from canwall.bus.can_ids import LSS_REQUEST, NMT
from canwall.compiled import data_to_number
from canwall.simdrive.communication.dictionary import Dictionary, Key
from canwall.simdrive.communication.emcy import (
    COMMUNICATION,
    HEARTBEAT_LOST,
    RECOVERED_FROM_BUS_OFF,
    EmergencyProducer,
)
from canwall.simdrive.communication.error_behaviour import ERROR_BEHAVIOUR, ErrorBehaviour
from canwall.simdrive.communication.frame import NS_PER_MS, Clock, Frame
from canwall.simdrive.communication.guarding import NodeGuarding
from canwall.simdrive.communication.heartbeat import HeartbeatConsumer, HeartbeatProducer
from canwall.simdrive.communication.lss import LssSlave
from canwall.simdrive.communication.memory import UNCONFIGURED, Memory
from canwall.simdrive.communication.nmt import NmtSlave, NmtState
from canwall.simdrive.communication.rpdo import Rpdo
from canwall.simdrive.communication.sdo import SdoServer
from canwall.simdrive.communication.store import ParameterStore
from canwall.simdrive.communication.sync import SyncConsumer
from canwall.simdrive.communication.tpdo import Tpdo
from canwall.simdrive.mechanics.actuator import Actuator
from canwall.simdrive.mechanics.motion import RecordedMotion
from canwall.simdrive.profile.hardware import Hardware
from canwall.simdrive.profile.power_drive_system import Motion, PowerDriveSystem
from canwall.simdrive.state import DriveRecord
from canwall.simdrive.steady import DECLINED, take

Receive: TypeAlias = Callable[[bytes], None]
"""Takes the data of the frames with one CAN-ID."""

DEFAULT_BITRATE = 1_000_000
"""Bit/s."""

_ABORT_CONNECTION = (0x6007, 0)
_SYNC_GONE_S = 0.1
_LONGEST_TICK_S = 0.01


class ServoDrive:
    """A CiA 402 servo drive in its torque modes: frames in, frames out.

    No threads and no clock: SYNC moves the physics by one period, ``tick`` the protocol timers.
    In real time ``tick`` moves the physics too, and SYNC does not.

    The physics are lazy: the motion is moved on, under the torque that held until now, only when
    something is about to be sampled or changed.

    In steady operation, one compiled call handles a SYNC or RPDO (`steady`); at all other times
    the services do, on the same record (`state`).
    """

    def __init__(
        self,
        dictionary: Dictionary,
        node_id: int,
        motion: Motion,
        sync_period_s: float,
        memory: Memory | None = None,
        bitrate: int = DEFAULT_BITRATE,
        torque_delay_cycles: float = 0.0,
        real_time: bool = False,
        hardware: Hardware | None = None,
    ) -> None:
        """Build the drive, which is switched off until ``boot``.

        Args:
            dictionary: object dictionary, loaded for this node-ID; the drive takes it over.
            node_id: 1 to 127, or UNCONFIGURED: then LSS alone has to give it one.
            motion: motor, encoder and hand.
            sync_period_s: time in seconds from one SYNC to the next.
            memory: keeps stored parameters (0x1010) and the node-ID of LSS.
            bitrate: of the bus, in bit/s.
            torque_delay_cycles: from the torque that a PDO brings to its effect, in SYNC periods,
                beyond what the transmission type of the PDO makes of it.
            real_time: the physics move with ``tick``.
            hardware: properties of the drive that its dictionary does not have; None: defaults.

        Raises:
            DictionaryError: no drive can be built from the dictionary.
            ValueError: the node-ID is not that of the dictionary, the period not positive, or the
                delay negative.
        """
        if node_id not in (dictionary.node_id, UNCONFIGURED):
            raise ValueError(f"node-ID {node_id}, but {dictionary.node_id} in the dictionary")
        if not sync_period_s > 0:
            raise ValueError(f"SYNC period {sync_period_s} s is not positive")
        if not torque_delay_cycles >= 0.0:
            raise ValueError(f"torque delay of {torque_delay_cycles} cycles is negative")
        self.state = DriveRecord()
        """State that a cycle reads and writes."""
        self._record, self._fields = self.state.record, self.state.fields
        self._fields.period = sync_period_s
        self._motion = motion
        self._recorded = motion if isinstance(motion, RecordedMotion) else None
        if self._recorded and self._recorded.record is not None:
            self._fields.motion = self._recorded.record.ctypes.data
        self._actuator = Actuator(motion, sync_period_s, torque_delay_cycles)
        self._sync_period_s = sync_period_s
        self._memory = memory or Memory(None)
        self._bitrate = bitrate
        self.real_time = real_time
        """True if the physics move with ``tick``, not with the count of SYNCs."""
        self._passes_syncs = True
        self._hardware = hardware or Hardware()
        self._extensions: list[Callable[[Dictionary], None]] = []
        self._power_on_node_id = node_id
        self._build(dictionary, node_id)

    def _build(self, dictionary: Dictionary, node_id: int) -> None:
        """Build the services on a dictionary, and with its node-ID unless there is none."""
        self._dictionary = dictionary
        self._node_id = node_id
        self._silent_until_ns = 0
        dictionary.keep_in(self.state)
        self._clock = Clock(self.state)
        self._outbox: list[Frame] = []
        send = self._outbox.append
        self._emcy = EmergencyProducer(dictionary, send)
        self._store = ParameterStore(dictionary, self._memory)
        self._pds = PowerDriveSystem(
            dictionary, self.state, self._motion, self._emcy, self._hardware, self._sync_period_s
        )
        self._sync = SyncConsumer(
            dictionary, self.state, self._emcy, self._route, self._connection_lost
        )
        self._sdo = SdoServer(dictionary, self._clock, send)
        self._heartbeat_producer = HeartbeatProducer(dictionary, self._clock, send)
        self._heartbeat_consumer = HeartbeatConsumer(
            dictionary, self._clock, self._route, self._heartbeat_lost, self._heartbeat_regained
        )
        self._guarding = NodeGuarding(
            dictionary, self._clock, send, self._heartbeat_lost, self._heartbeat_regained
        )
        self._rpdos = [
            Rpdo(dictionary, index, self.state, self._emcy, self._route, self._connection_lost)
            for index in dictionary.indices(Rpdo.communication)
        ]
        self._tpdos = [
            Tpdo(dictionary, index, self.state, send, self._route)
            for index in dictionary.indices(Tpdo.communication)
        ]
        self._lss = LssSlave(
            dictionary,
            node_id,
            self._bitrate,
            send,
            self._store_node_id,
            partial(self._reset, False),
            self._fall_silent,
        )
        self._nmt = NmtSlave(dictionary.node_id, self._leaving, self._entered, self._reset)
        self._error_behaviour = ErrorBehaviour(dictionary, self._nmt)
        for serve in self._extensions:
            serve(dictionary)
        self._route()

    @property
    def syncs(self) -> int:
        """Number of SYNCs that have been on the bus."""
        return int(self._fields.syncs)

    @property
    def passes_syncs(self) -> bool:
        """True if time passes with each received SYNC, False if only with ``pass_sync``."""
        return self._passes_syncs

    @passes_syncs.setter
    def passes_syncs(self, passes: bool) -> None:
        self._passes_syncs = passes
        self._settle()

    @property
    def axis(self) -> PowerDriveSystem:
        """The CiA 402 side of the drive."""
        return self._pds

    @property
    def actuator(self) -> Actuator:
        """Path of the demanded torque to the motion."""
        return self._actuator

    @property
    def dictionary(self) -> Dictionary:
        """Its objects, with their present values."""
        return self._dictionary

    @property
    def nmt_state(self) -> NmtState:
        """State of the node (CiA 301)."""
        return self._nmt.state

    @property
    def torque_nm(self) -> float:
        """Torque that acts on the motor now, at the shaft, in N·m; 0 without the power stage."""
        return 0.0 if self._pds.motor_free else self._actuator.torque_nm(self._pds.torque_nm)

    @property
    def emcy(self) -> EmergencyProducer:
        """The errors that are present."""
        return self._emcy

    @property
    def sync_period_s(self) -> float:
        """Time from one SYNC to the next, in seconds."""
        return self._sync_period_s

    @property
    def sync_can_id(self) -> int:
        """CAN-ID of the SYNC that the drive hears (0x1005)."""
        return self._sync.can_id

    def extend(self, serve: Callable[[Dictionary], None]) -> None:
        """Let another service have objects of the dictionary as well.

        Args:
            serve: called now, and again with every dictionary that takes the place of this one.
        """
        self._extensions.append(serve)
        serve(self._dictionary)

    def switch_off(self) -> None:
        """Switch the device off until ``boot``."""
        self._pds.disable()
        self._nmt.state = NmtState.INITIALISATION
        self._route()
        self._outbox.clear()

    def bus_off(self) -> None:
        """React to a controller that has left the bus (0x6007 and 0x1029)."""
        self._pds.abort_connection(COMMUNICATION, _ABORT_CONNECTION)
        self._error_behaviour.communication_error()

    def bus_recovered(self) -> None:
        """Report the recovery from bus-off (EMCY 0x8140)."""
        self._emcy.occurred(RECOVERED_FROM_BUS_OFF, ERROR_BEHAVIOUR)
        self._emcy.gone(RECOVERED_FROM_BUS_OFF, ERROR_BEHAVIOUR)

    def boot(self) -> list[Frame]:
        """Switch the device on: power-on values, boot-up message, PRE-OPERATIONAL state."""
        # What LSS has not stored is gone with the supply.
        self._lss.power_on(self._power_on_node_id)
        self._reset(communication_only=False)
        return self.take_outbox()

    def process(self, can_id: int, data: bytes) -> list[Frame]:
        """Take a frame from the bus and return the frames that the drive sends in return.

        Args:
            can_id: 11-bit identifier.
            data: 0 to 8 bytes.
        """
        if self._fields.steady:
            sent = take(self._record, can_id, len(data), data_to_number(data))
            if sent != DECLINED:
                return [(tpdo, bytes(payload)) for tpdo, payload in self._sync_frames[:sent]]
        receive = self._routes.get(can_id)
        if receive is None:
            return []
        receive(data)
        for transmitted in self._event_tpdos:
            transmitted.poll()
        return self.take_outbox()

    def request(self, can_id: int) -> list[Frame]:
        """Take a remote frame (11-bit identifier) and return the frames that answer it."""
        respond = self._remote_routes.get(can_id)
        if respond is not None:
            respond()
        return self.take_outbox()

    def tick(self, dt: float) -> list[Frame]:
        """Let the protocol timers go on by ``dt`` seconds; return the frames that are due."""
        self._clock.advance(dt)
        if self.real_time:
            self._pass(dt / self._sync_period_s)
            self._apply_torque()
        elif self._pds.slowing_down:
            self._go_on_without_sync(dt)
        if self._nmt.state is not NmtState.INITIALISATION:
            self._pds.state_machine.step()
            self._heartbeat_producer.tick(self._nmt.state)
            self._heartbeat_consumer.tick()
            self._guarding.tick()
            self._sync.tick()
            self._sdo.tick()
            for received in self._rpdos:
                received.tick()
            for transmitted in self._event_tpdos:
                transmitted.poll()
        return self.take_outbox()

    def take_outbox(self) -> list[Frame]:
        """Return the frames that the drive has to send after a change from outside."""
        self._settle()
        if not self._outbox:
            return []
        frames = self._outbox.copy()
        self._outbox.clear()
        return frames if self._clock.now_ns >= self._silent_until_ns else []

    def _settle(self) -> None:
        """Decide whether the next frame is for `steady`."""
        self._fields.steady = (
            self._pdos_are_steady
            and self._pds.steady
            and self._actuator.steady
            and self._passes_syncs
            and not self.real_time
            and not self._sync.counted
            and not self._emcy.present
            and self._clock.now_ns >= self._silent_until_ns
            and self._recorded is not None
            and self._recorded.record is not None
            and all(pdo.quiet for pdo in self._event_tpdos)
        )

    def _store_node_id(self, node_id: int) -> None:
        self._memory.store_node_id(self._dictionary, node_id)
        self._power_on_node_id = node_id

    def _fall_silent(self, duration_ms: int) -> None:
        self._silent_until_ns = self._clock.now_ns + duration_ms * NS_PER_MS

    def _route(self) -> None:
        """Assign services to CAN-IDs, after every change of NMT state or of a COB-ID."""
        state = self._nmt.state
        operational = state is NmtState.OPERATIONAL
        rpdos = [pdo for pdo in self._rpdos if operational and pdo.active]
        tpdos = [pdo for pdo in self._tpdos if operational and pdo.active]
        self._sync_rpdos = [pdo for pdo in rpdos if pdo.synchronous]
        self._sync_tpdos = [pdo for pdo in tpdos if pdo.synchronous]
        self._event_tpdos = [pdo for pdo in tpdos if pdo.event_driven]
        routes: dict[int, Receive] = {}
        remote_routes: dict[int, Callable[[], None]] = {}
        if state is not NmtState.INITIALISATION:
            routes |= _receivers([(pdo, self._receive_of(pdo)) for pdo in rpdos])
            routes |= self._heartbeat_consumer.routes()
            if state is not NmtState.STOPPED:
                routes[self._sdo.can_id] = self._with_immediate_torque(self._sdo.receive)
            # The motion does not stand still in NMT states without SYNC.
            routes[self._sync.can_id] = self._on_sync
            routes[NMT] = self._nmt.receive
            routes[LSS_REQUEST] = self._lss.receive
            remote_routes = {pdo.can_id: pdo.respond for pdo in tpdos if pdo.answers_remote}
            remote_routes |= self._guarding.routes(state)
        elif self._node_id == UNCONFIGURED:
            routes = {LSS_REQUEST: self._lss.receive, self._sync.can_id: self._on_sync}
        self._routes = routes
        self._remote_routes = remote_routes
        self._settle_pdos()

    def _settle_pdos(self) -> None:
        """Write to the record which PDOs SYNC moves, and see whether `steady` covers them."""
        fields, rpdos, tpdos = self._fields, self._sync_rpdos, self._sync_tpdos
        self._pdos_are_steady = (
            len(rpdos) == 1
            and rpdos[0].steady
            and self._routes.get(rpdos[0].can_id) == rpdos[0].receive
            and all(pdo.steady for pdo in tpdos)
        )
        fields.sync_id = self._sync.can_id
        fields.sync_rpdo = rpdos[0].number if rpdos else 0
        fields.sync_tpdo_count = len(tpdos)
        for place, pdo in enumerate(tpdos):
            fields.sync_tpdos[place] = pdo.number
        self._sync_frames = [(pdo.can_id, pdo.payload) for pdo in tpdos]

    def _receive_of(self, received: Rpdo) -> Receive:
        return (
            received.receive
            if received.synchronous
            else self._with_immediate_torque(received.receive)
        )

    def _with_immediate_torque(self, receive: Receive) -> Receive:
        """Let a torque that a frame brings act from its arrival on, not from the next SYNC."""

        def received(data: bytes) -> None:
            receive(data)
            self._apply_torque()

        return received

    def _pass(self, periods: float) -> None:
        """Let time pass for the physics, under the torque that has held until now."""
        actuator = self._actuator
        if actuator.delayed and self._pds.motor_free:
            actuator.cut()
        actuator.advance(self._pds.torque_nm, periods)
        self._fields.passed += periods * self._sync_period_s

    def pass_sync(self) -> None:
        """Let time pass until a SYNC on the bus, whether the drive receives it or not."""
        fields = self._fields
        fields.syncs += 1
        fields.without_sync = 0.0
        if self.real_time:
            return
        if fields.syncs > 1:
            self._pass(1.0)
        else:
            # Before the first SYNC there is no period, but the first step of a slope is due.
            fields.passed = self._sync_period_s

    def _apply_torque(self) -> None:
        """Let the target torque hold from now on."""
        self._pds.apply_torque(self._fields.passed)
        self._fields.passed = 0.0
        if self._pds.motor_free:
            self._pds.show_torque(0.0)  # the power stage is off, whatever was latched before
        elif not self._actuator.direct:
            self._pds.show_torque(self._actuator.torque_nm(self._pds.torque_nm))

    def _go_on_without_sync(self, dt: float) -> None:
        """Go on with a slow-down after the SYNC, and so the master, has gone.

        A tick counts for a few milliseconds at most, because after a pause of the program itself
        a SYNC may already be waiting.
        """
        fields = self._fields
        fields.without_sync += min(dt, _LONGEST_TICK_S)
        while fields.without_sync > _SYNC_GONE_S + self._sync_period_s:
            fields.without_sync -= self._sync_period_s
            self._pass(1.0)
            self._apply_torque()
            self._pds.sample()

    def _on_sync(self, data: bytes) -> None:
        if self._passes_syncs:
            self.pass_sync()
        if not self._sync.receive(data):
            return
        self._pds.state_machine.step()
        for received in self._sync_rpdos:
            received.sync()
        self._apply_torque()
        self._pds.sample()
        for transmitted in self._sync_tpdos:
            transmitted.sync(self._sync.counter)

    def _leaving(self, state: NmtState) -> None:
        # SDO may have enabled a drive that is not OPERATIONAL; in STOPPED nothing reaches it.
        if self._nmt.state is NmtState.OPERATIONAL or state is NmtState.STOPPED:
            self._pds.abort_connection(COMMUNICATION, _ABORT_CONNECTION)

    def _entered(self) -> None:
        self._emcy.silent = self._nmt.state is NmtState.STOPPED
        if self._nmt.state is NmtState.STOPPED:
            self._sdo.reset()  # an abort after its timeout would break the silence
        self._sync.stop()
        for received in self._rpdos:
            received.stop()
        for transmitted in self._tpdos:
            transmitted.start()
        self._route()

    def _reset(self, communication_only: bool) -> None:
        node_id = self._lss.node_id
        renumbered = node_id != self._node_id
        if communication_only and not renumbered:
            self._pds.abort_connection(COMMUNICATION, _ABORT_CONNECTION)
        else:
            self._pds.disable()
        if renumbered:
            # Another node-ID is another power-on, whichever reset it was.
            known = self._dictionary.node_id if node_id == UNCONFIGURED else node_id
            self._build(self._dictionary.renumbered(known), node_id)
            communication_only = False
        self._nmt.state = NmtState.INITIALISATION
        self._dictionary.reset(communication_only=communication_only)
        self._store.load(communication_only=communication_only)
        self._emcy.reset(communication_only=communication_only)
        if not communication_only:
            self._pds.reset()
        self._sdo.reset()
        self._heartbeat_consumer.reset()
        self._guarding.reset()
        self._sync.reset()
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.configure()
        self._heartbeat_producer.reset()
        if self._node_id == UNCONFIGURED:
            # CiA 305: the initialisation goes on when LSS has given it a node-ID.
            self._emcy.silent = True
            self._route()
            return
        self._heartbeat_producer.boot_up()
        self._nmt.enter(NmtState.PRE_OPERATIONAL)

    def _connection_lost(self, code: int, source: Key) -> None:
        self._emcy.occurred(code, source)
        self._pds.abort_connection(code, source)

    def _heartbeat_lost(self, source: Key) -> None:
        self._connection_lost(HEARTBEAT_LOST, source)
        self._error_behaviour.communication_error()

    def _heartbeat_regained(self, source: Key) -> None:
        self._emcy.gone(HEARTBEAT_LOST, source)


def _receivers(rpdos: list[tuple[Rpdo, Receive]]) -> dict[int, Receive]:
    """Return the receiver of each CAN-ID; several RPDOs may listen to one."""
    listeners: dict[int, list[Receive]] = {}
    for pdo, receive in rpdos:
        listeners.setdefault(pdo.can_id, []).append(receive)
    return {
        can_id: receivers[0] if len(receivers) == 1 else partial(_call_each, receivers)
        for can_id, receivers in listeners.items()
    }


def _call_each(receivers: list[Receive], data: bytes) -> None:
    for receive in receivers:
        receive(data)
