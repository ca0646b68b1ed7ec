"""CAN-IDs of the predefined connection set (CiA 301, 7.3.3), to which a node-ID is added."""

NMT = 0x000
SYNC = 0x080
EMCY = 0x080
TIME = 0x100
TPDO1 = 0x180
RPDO1 = 0x200
SDO_RESPONSE = 0x580
SDO_REQUEST = 0x600
#: Heartbeat, boot-up message, node and life guarding.
ERROR_CONTROL = 0x700
LSS_RESPONSE = 0x7E4
LSS_REQUEST = 0x7E5

#: All PDOs of the predefined connection set, of every node.
PDOS = range(TPDO1, SDO_RESPONSE)
