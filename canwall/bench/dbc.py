"""DBC file of what is on the bus of a wall, for SavvyCAN, PlotJuggler, cantools and their like."""

import re
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, NamedTuple

from canopen.objectdictionary import ObjectDictionary, datatypes
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.conversion import BaseConversion

from canwall.bus.can_ids import EMCY, ERROR_CONTROL
from canwall.config import Settings
from canwall.drive import DriveError, DriveNode, DriveSetup, Link, PdoLayout, set_up
from canwall.drive import objects as od
from canwall.drive.pdo import tpdos_on_sync
from canwall.eds import load_eds

_MASTER = "Master"
_FIRST_OBJECT = 0x1000  # indices below fill gaps in a mapping
_TORQUE_DEMAND = 0x6074
_NMT_STATES = OrderedDict[int, Any](
    {0: "Boot_up", 4: "Stopped", 5: "Operational", 127: "Pre_operational"}
)


class MappedDrive(NamedTuple):
    """A drive as it is mapped for a wall.

    Attributes:
        node_id: Its node-ID.
        dictionary: Its objects.
        setup: PDOs of the wall, and scales.
        others: Its other TPDOs that come with SYNC.
    """

    node_id: int
    dictionary: ObjectDictionary
    setup: DriveSetup
    others: Sequence[PdoLayout]


def mapped_drive(link: Link, settings: Settings, required: Sequence[int]) -> MappedDrive:
    """Set a drive up as for a run, ask for its mapping, and put it back; it is not enabled.

    Args:
        link: The bus.
        settings: Configuration of the drive.
        required: Indices of objects that its dictionary has to have.

    Raises:
        DictionaryError: If the dictionary cannot be used.
        DriveError: If the drive cannot be set up or put back.
    """
    node_id = settings.drive.node_id
    dictionary = load_eds(settings.drive.eds, node_id, required)
    node = DriveNode(link, node_id, dictionary, settings.drive.sdo_timeout_s)
    lenient = settings.drive.model_copy(update={"accept_no_watchdog": True})
    try:
        setup = set_up(node, lenient, settings.bus, settings.limits.torque_nm, settings.real_time)
        others = [pdo for pdo in tpdos_on_sync(node) if pdo.cob_id != setup.tpdo.cob_id]
    finally:
        failures = node.restore()
    if failures:
        raise DriveError(f"node {node_id}: not restored: {'; '.join(failures)}")
    return MappedDrive(node_id, dictionary, setup, others)


def dbc_text(drives: Sequence[MappedDrive]) -> str:
    """Return a DBC with SYNC, and with PDOs, EMCY and heartbeat of each drive on a bus.

    Signals have the names of the dictionary. Position and torques are in rad and Nm at the shaft,
    other objects as on the bus.
    """
    messages = [_sync(drives[0].setup)]
    nodes = [Node(_MASTER)]
    for drive in drives:
        nodes.append(Node(_name(drive), comment=str(drive.setup.identity)))
        messages += _messages(drive)
    text: str = Database(messages, nodes).as_dbc_string()
    return text


def _name(drive: MappedDrive) -> str:
    return f"Drive{drive.node_id}"


def _sync(setup: DriveSetup) -> Message:
    counter = [Signal("Counter", 0, 8)] if setup.sync_counter_overflow else []
    return Message(setup.sync_cob_id, "SYNC", len(counter), counter, senders=[_MASTER])


def _messages(drive: MappedDrive) -> list[Message]:
    name, setup = _name(drive), drive.setup
    rpdo = setup.rpdo.communication - od.RPDO_COMMUNICATION + 1
    messages = [_pdo(drive, setup.rpdo, f"{name}_RPDO{rpdo}", _MASTER)]
    for layout in (setup.tpdo, *drive.others):
        tpdo = layout.communication - od.TPDO_COMMUNICATION + 1
        messages.append(_pdo(drive, layout, f"{name}_TPDO{tpdo}", name))
    emcy = [
        Signal("Error_code", 0, 16, comment="0x603F"),
        Signal("Error_register", 16, 8, comment="0x1001"),
        Signal("Manufacturer_specific", 24, 40),
    ]
    states = BaseConversion.factory(choices=_NMT_STATES)
    heartbeat = [Signal("NMT_state", 0, 7, conversion=states), Signal("Toggle", 7, 1)]
    messages += [
        Message(EMCY + drive.node_id, f"{name}_EMCY", 8, emcy, senders=[name]),
        Message(ERROR_CONTROL + drive.node_id, f"{name}_Heartbeat", 1, heartbeat, senders=[name]),
    ]
    return messages


def _pdo(drive: MappedDrive, layout: PdoLayout, name: str, sender: str) -> Message:
    units = drive.setup.units
    torque = (units.nm_per_mille, "Nm")
    scales = {
        od.POSITION_ACTUAL_VALUE: (units.rad_per_count, "rad"),
        od.TARGET_TORQUE: torque,
        _TORQUE_DEMAND: torque,
        od.TORQUE_ACTUAL_VALUE: torque,
    }
    signals: dict[str, Signal] = {}
    for field in layout.fields:
        if field.index < _FIRST_OBJECT:
            continue
        variable = drive.dictionary.get_variable(field.index, field.subindex)
        scale, unit = scales.get(field.index, (1, None))
        symbol = _symbol(variable.name if variable else "", field.index, field.subindex)
        while symbol in signals:
            symbol += f"_{field.index:04X}_{field.subindex:02X}"
        signals[symbol] = Signal(
            symbol,
            field.shift,
            field.bits,
            is_signed=variable is not None and variable.data_type in datatypes.SIGNED_TYPES,
            conversion=BaseConversion.factory(scale=scale),
            unit=unit,
            comment=f"0x{field.index:04X}:{field.subindex:02X}",
        )
    return Message(layout.cob_id, name, layout.length, [*signals.values()], senders=[sender])


def _symbol(words: str, index: int, subindex: int) -> str:
    """Return the name of an object as an identifier of a DBC."""
    name = re.sub(r"\W+", "_", words, flags=re.ASCII).strip("_")
    return name if name[:1].isalpha() else f"Object_{index:04X}_{subindex:02X}"
