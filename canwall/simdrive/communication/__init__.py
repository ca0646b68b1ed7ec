"""CiA 301, 305 and 306: dictionary, SDO, PDO, SYNC, NMT, EMCY, watchdogs and LSS.

Each service has a module of its own. Objects from 0x6000 on are handled by `profile`.
"""
