"""canopen's own master and drives that are processes, one with each dictionary.

The master is canopen from the package index as it is, the drive is `canwall drive`, between them
a bus between processes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from commands import COMMAND, Start, wait_for
from simdrive_bench import NODE_ID
from vendors import DICTIONARIES, OWN, VENDORS, path_of

from canwall.eds import load_eds

WAIT_S = 30.0
SYNC_S = 0.005
TORQUE = 80  # per mille; one of the drives is limited to 100 (0x6072)
MODES = {4: "PROFILED TORQUE", 10: "CYCLIC SYNCHRONOUS TORQUE"}
OPERATED = {vendor.file: vendor.modes for vendor in VENDORS} | {OWN: (10, 4)}

CONFIG = """
[bus]
interface = "unixcan"
channel = "{channel}"
cycle_s = {cycle_s}
[drive]
node_id = 5
eds = "{eds}"
[mechanics]
inertia_kg_m2 = 1.0e-4
[limits]
torque_nm = 1.0
speed_rad_s = 60.0
position_rad = [-3.0, 3.0]
[simulation]
rated_torque_nm = 0.637
inertia_kg_m2 = 1.0e-4
viscous_nm_s_per_rad = 1.0e-3
coulomb_nm = 0.01
[simulation.hand]  # it lets go
inertia_kg_m2 = 0.0
damping_nm_s_per_rad = 0.0
stiffness_nm_per_rad = 0.0
strikes = 0
"""


@dataclass
class Served:
    """A drive in a process of its own, and canopen's node for it."""

    file: str
    node: BaseNode402
    emergencies: list[int]


@pytest.fixture(params=DICTIONARIES)
def served(request: pytest.FixtureRequest, tmp_path: Path, start: Start) -> Iterator[Served]:
    eds = path_of(request.param)
    channel = tmp_path / "bus"
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.02  # seconds that disconnecting may take
    node = BaseNode402(NODE_ID, load_eds(eds, NODE_ID))
    network.add_node(node)
    # A busy machine is no failure of the drive.
    node.sdo.RESPONSE_TIMEOUT = node.TIMEOUT_CHECK_TPDO = WAIT_S
    node.TIMEOUT_SWITCH_OP_MODE = node.TIMEOUT_SWITCH_STATE_FINAL = WAIT_S
    node.TIMEOUT_SWITCH_STATE_SINGLE = WAIT_S
    emergencies: list[int] = []
    node.emcy.add_callback(lambda error: emergencies.append(error.code))
    network.connect(interface="unixcan", channel=str(channel))
    config = tmp_path / "drive.toml"
    config.write_text(CONFIG.format(channel=channel, eds=eds.resolve(), cycle_s=SYNC_S))
    try:
        process = start(COMMAND, "drive", config)
        wait_for(lambda: node.nmt.state == "PRE-OPERATIONAL" or process.poll() is not None)
        assert process.poll() is None, process.communicate()
        yield Served(request.param, node, emergencies)
        assert process.poll() is None
    finally:
        network.sync.stop()
        node.rpdo[1].stop()
        network.disconnect()


def configure(node: BaseNode402) -> None:
    """Controlword and torque in the first RPDO, what is measured in the first TPDO, all cyclic."""
    node.tpdo.read()
    node.rpdo.read()
    for pdos in (node.tpdo, node.rpdo):
        for pdo in pdos.values():
            pdo.enabled = False
    for pdo, objects in (
        (node.tpdo[1], (0x6041, 0x6064, 0x6077)),
        (node.rpdo[1], (0x6040, 0x6071)),
    ):
        pdo.clear()
        for index in objects:
            pdo.add_variable(index)
        pdo.enabled = True
        pdo.trans_type = 1
    node.tpdo.save()
    node.rpdo.save()


def choose(node: BaseNode402, mode: int) -> None:
    if node.is_op_mode_supported(MODES[mode]):
        node.op_mode = MODES[mode]
    else:
        # Some dictionaries leave the torque modes out of 0x6502, and canopen believes them.
        node.sdo[0x6060].raw = mode
    assert node.sdo[0x6061].raw == mode


@pytest.mark.slow
def test_life_of_a_drive(served: Served) -> None:
    node = served.node
    described = node.object_dictionary
    assert node.sdo[0x1018][1].raw == (described[0x1018][1].default or 0)
    assert node.sdo[0x1000].raw & 0xFFFF == 402
    if 0x6007 in described:
        node.sdo[0x6007].raw = 1  # a lost connection is a fault
    if 0x6087 in described:
        node.sdo[0x6087].raw = 100_000
    if 0x6073 in described:
        node.sdo[0x6073].raw = 1000  # some begin with less current than TORQUE takes
    configure(node)
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    node.network.sync.start(SYNC_S)
    node.rpdo[1].start(SYNC_S)

    for mode in OPERATED[served.file]:
        choose(node, mode)
        node.rpdo[1][1].raw = 0
        node.state = "OPERATION ENABLED"
        assert node.state == "OPERATION ENABLED"

        rest = node.tpdo[1][1].raw
        node.rpdo[1][1].raw = TORQUE
        wait_for(lambda: node.tpdo[1][2].raw == TORQUE)
        wait_for(lambda rest=rest: node.tpdo[1][1].raw > rest)
        assert node.sdo[0x6064].raw > rest

        node.rpdo[1][1].raw = 0
        wait_for(lambda: node.tpdo[1][2].raw == 0)
        node.state = "SWITCH ON DISABLED"
        assert node.state == "SWITCH ON DISABLED"
    assert served.emergencies == []

    node.state = "OPERATION ENABLED"
    node.nmt.state = "PRE-OPERATIONAL"
    wait_for(lambda: served.emergencies == [0x8100])
    wait_for(lambda: node.sdo[0x6041].raw & 0x4F == 0x08)
    assert node.sdo[0x6077].raw == 0
    node.nmt.state = "OPERATIONAL"
    wait_for(lambda: node.state == "FAULT")
    node.reset_from_fault()
    assert node.state == "OPERATION ENABLED"
    assert served.emergencies == [0x8100, 0]
    node.state = "SWITCH ON DISABLED"
