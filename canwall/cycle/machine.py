"""Set-up of the machine for a cycle in real time, as far as the process has permission.

Besides the priority of the loop's thread (`realtime`), it covers locked memory, idle states,
processor affinity, and the switch interval of other Python threads.
"""

import ctypes
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from canwall.realtime import Grant, limits_line, real_time_priority

#: sys/mman.h. Only touched pages are locked, because libraries map far more than they use.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
#: While open, this file limits the wake-up latency of the processors.
_WAKE_UP = Path("/dev/cpu_dma_latency")
_UDEV_RULE = (
    "in /etc/udev/rules.d/99-cpu-dma-latency.rules, for a group that you are in: "
    'KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"'
)
#: Longest time that another Python thread keeps the interpreter while the loop waits for it [s].
_SWITCH_INTERVAL_S = 1e-4


@contextmanager
def real_time_machine(processor: int | None = None) -> Iterator[dict[str, Grant]]:
    """Set the machine up as far as permitted; yield what was granted, and how to get the rest.

    processor: processor for the loop's thread, e.g. one that isolcpus keeps free. All settings are
    restored at the end.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(min(interval, _SWITCH_INTERVAL_S))
    try:
        with (
            real_time_priority() as scheduling,
            _memory_locked() as memory,
            _awake() as wake_up,
            _on_processor(processor) as processors,
        ):
            yield {
                "scheduling": scheduling,
                "memory": memory,
                "wake_up": wake_up,
                "processor": processors,
            }
    finally:
        sys.setswitchinterval(interval)


@contextmanager
def _memory_locked() -> Iterator[Grant]:
    library = ctypes.CDLL(None, use_errno=True)
    if library.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        why = os.strerror(ctypes.get_errno())
        yield Grant(f"not locked ({why})", limits_line("memlock", "unlimited"))
        return
    try:
        yield Grant("locked")
    finally:
        library.munlockall()


@contextmanager
def _awake() -> Iterator[Grant]:
    try:
        file = _WAKE_UP.open("wb", buffering=0)
    except OSError as error:
        yield Grant(
            f"processors may sleep deeply ({_WAKE_UP}: {error.strerror})",
            "" if isinstance(error, FileNotFoundError) else _UDEV_RULE,
        )
        return
    with file:
        file.write(struct.pack("=i", 0))
        yield Grant("processors stay awake")


@contextmanager
def _on_processor(processor: int | None) -> Iterator[Grant]:
    before = os.sched_getaffinity(0)
    if processor is None:
        yield Grant(f"any of {len(before)}")
        return
    try:
        os.sched_setaffinity(0, {processor})
    except OSError as error:
        yield Grant(
            f"any of {len(before)}: bus.processor = {processor}: {error.strerror}",
            f"bus.processor: one of {', '.join(map(str, sorted(before)))}",
        )
        return
    try:
        yield Grant(f"number {processor}")
    finally:
        os.sched_setaffinity(0, before)
