"""A master as somebody else wrote it: it turns the drive until it is ended."""

import sys
import time

import canopen

interface, channel, eds = sys.argv[1:]
network = canopen.Network()
network.connect(interface=interface, channel=channel)
node = network.add_node(canopen.RemoteNode(5, eds))
node.sdo[0x1016][1].raw = 0x7F << 16 | 1000  # without the heartbeat of node 127 for 1 s: a fault
network.send_periodic(0x77F, b"\x05", 0.1)
node.nmt.state = "OPERATIONAL"
node.sdo["Modes of operation"].raw = 10  # cyclic synchronous torque
for controlword in (0x06, 0x07, 0x0F):
    node.sdo["Controlword"].raw = controlword
node.sdo["Target torque"].raw = 50
time.sleep(3600)
