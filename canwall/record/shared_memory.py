"""Blocks of shared memory of a run, which other processes open by the addresses in live.json."""

import errno
import fcntl
import os
import secrets
from typing import NamedTuple

#: Nobody who has a block open may cut it off: reading on would end the process of the run.
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class MemoryAddress(NamedTuple):
    """Address of a block: a descriptor of a process, and the file that it has to be."""

    pid: int
    descriptor: int
    file: str


class LiveAddresses(NamedTuple):
    """Addresses of all blocks of a run in progress."""

    mailbox: MemoryAddress
    rows: MemoryAddress
    state: MemoryAddress
    controls: MemoryAddress


def create_memory(kind: str, size: int) -> int:
    """Return the descriptor of a new block, with a name that no other has. Raises OSError."""
    memory = os.memfd_create(
        f"canwall-{kind}-{secrets.token_hex(16)}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
    )
    try:
        os.ftruncate(memory, size)
        fcntl.fcntl(memory, fcntl.F_ADD_SEALS, _SEALS)
        # Processes that are started have standard streams in place of whatever was closed here.
        return fcntl.fcntl(memory, fcntl.F_DUPFD_CLOEXEC, 3)
    finally:
        os.close(memory)


def address_of(descriptor: int) -> MemoryAddress:
    """Return the address by which other processes open a block while this process lives."""
    return MemoryAddress(os.getpid(), descriptor, os.readlink(f"/proc/self/fd/{descriptor}"))


def open_memory(kind: str, address: MemoryAddress, size: int, writable: bool = False) -> int:
    """Return a descriptor of a block of another process.

    Raises OSError if it no longer exists, or has another size: that of another version.
    """
    path = f"/proc/{address.pid}/fd/{address.descriptor}"
    # The process may have ended, and its number be that of another one, with other files.
    if exists(address) and address.file.startswith(f"/memfd:canwall-{kind}-"):
        access = os.O_RDWR if writable else os.O_RDONLY
        descriptor = os.open(path, access | os.O_NONBLOCK | os.O_CLOEXEC)
        is_it = os.readlink(f"/proc/self/fd/{descriptor}") == address.file
        if is_it and os.fstat(descriptor).st_size == size:
            return descriptor
        os.close(descriptor)
    raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)


def exists(address: MemoryAddress) -> bool:
    """Return True while the process of a block has it. Raises ValueError for no address."""
    try:
        return os.readlink(f"/proc/{address.pid}/fd/{address.descriptor}") == address.file
    except OSError:
        return False
