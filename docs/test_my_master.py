"""python-canopen's BaseNode402, with a drive that loses its DC link."""

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402


@pytest.fixture
def node(simulated_drive):
    network = canopen.Network()
    network.connect(interface=simulated_drive.interface, channel=simulated_drive.channel)
    node = network.add_node(BaseNode402(simulated_drive.node_id, str(simulated_drive.eds)))
    node.setup_402_state_machine(read_pdos=False)  # all over SDO
    node.nmt.state = "OPERATIONAL"
    yield node
    network.disconnect()


def test_undervoltage_ends_the_torque_and_can_be_reset(simulated_drive, node):
    drive = simulated_drive
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    node.state = "OPERATION ENABLED"
    node.sdo["Target torque"].raw = 100  # per mille of 0.637 N·m
    drive.wait_until(lambda: drive.torque > 0.06 and drive.position > 0.0)
    with drive.faults.undervoltage():
        drive.wait_until(lambda: drive.state == "FAULT" and drive.torque == 0.0)
        drive.wait_until(lambda: node.emcy.log)
        assert node.emcy.log[0].code == 0x3220
        assert node.state == "FAULT"
    node.reset_from_fault()
    assert drive.state == "OPERATION ENABLED"
