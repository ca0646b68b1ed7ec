"""CiA 301, 305 and 306: dictionary, SDO, PDO, SYNC, NMT, EMCY, watchdogs, LSS; a file a service.

The meaning of the objects from 0x6000 on is the business of `profile`.
"""
