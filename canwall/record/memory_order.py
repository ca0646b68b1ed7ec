"""Order of accesses to memory that two processes share.

Whoever publishes writes the content first and then, with release order, a counter; whoever reads
the counter with acquire order then finds the content. x86 keeps this order by itself, ARM does not.
Compiled code has instructions for it (`append`), Python has `fence`.
"""

import threading


def fence() -> None:
    """Have all accesses before this call take place before all accesses after it.

    Nothing before the release of a
    lock takes place after it, nothing after an acquisition before it, and a release and a following
    acquisition keep their order.
    """
    lock = threading.Lock()
    lock.acquire()
    lock.release()
    lock.acquire()
