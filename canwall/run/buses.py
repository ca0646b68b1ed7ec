"""The bus of a run: a real one, or one with the simulated drives of the configuration on it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

import can

from canwall import simdrive
from canwall.bus import open_bus as opened
from canwall.bus import socket_pair
from canwall.compiled import compile_beside
from canwall.config import ConfigError, Settings
from canwall.drive import Link, refuse_second_master

#: Interfaces that a process may open several times.
_SEVERAL = ("socketcan", "unixcan", "virtual")


def open_bus(settings: Settings) -> can.BusABC:
    """Open the bus of `[bus]`.

    Raises:
        ConfigError: If the bus does not exist.
    """
    bus = settings.bus
    return opened(bus.interface, bus.channel, bus.bitrate)


def make_simulated_drive(
    settings: Settings, report: Callable[[str], None] = lambda line: None
) -> simdrive.FaultyDrive:
    """Make the drive of `[simulation]`, from the dictionary of `[drive]`.

    Args:
        settings: Configuration of the run.
        report: Called with a line when a fault begins or ends.

    Raises:
        ConfigError: If there is no `[simulation]`.
        DictionaryError: If the dictionary cannot be used.
    """
    if settings.simulation is None:
        raise ConfigError("[simulation] is missing: there is no drive to simulate")
    if settings.real_time:
        # Loaded at its first SYNC, it would keep a master of this process from the next ones.
        simdrive.load_compiled_code(settings.simulation.real_time)
    bus = settings.bus
    return simdrive.make_drive(
        settings.drive, settings.simulation, bus.cycle_s, bus.bitrate, report
    )


@contextmanager
def on_the_bus(*many: Settings) -> Iterator[Link]:
    """Open a link to the bus; embedded drives run on the same bus, in the master's idle time.

    A single embedded drive is at the other end of a socket pair if compiled code exchanges its
    frames (`bus.exchange`). Otherwise embedded drives are on python-can's virtual bus.

    Raises:
        ConfigError: If the bus does not exist.
        DictionaryError: If the dictionary of a drive cannot be used.
        DriveError: If another master is on the bus.
    """
    with ExitStack() as stack:
        link = _open_link(stack, many)
        try:
            yield link
        finally:
            if link.abandoned:  # what comes back must not find its descriptors in other hands
                stack.pop_all()


def _open_link(stack: ExitStack, many: Sequence[Settings]) -> Link:
    """Open the bus, and embedded drives, until the stack is closed."""
    bus = many[0].bus
    reopen = partial(open_bus, many[0]) if bus.interface in _SEVERAL else None
    if not many[0].embedded:
        link = Link(stack.enter_context(open_bus(many[0])), reopen=reopen)
        refuse_second_master(link, bus, [settings.drive.node_id for settings in many])
        return link
    drives = [make_simulated_drive(settings) for settings in many]
    if len(many) == 1 and _is_alone(many[0]):
        master, slave = (stack.enter_context(end) for end in socket_pair(bus.channel))
        compile_beside("canwall.cycle.sockets", "compile_run")  # the drive is compiled here
        runner = simdrive.SocketRunner(drives[0], slave)
        return Link(master, runner.poll, runner.compiled)
    opened = stack.enter_context(open_bus(many[0]))
    polls = [
        simdrive.BusRunner(drive, stack.enter_context(open_bus(settings))).poll
        for drive, settings in zip(drives, many, strict=True)
    ]
    idle = polls[0] if len(polls) == 1 else partial(_call_all, polls)
    return Link(opened, idle, reopen=reopen)


def _is_alone(settings: Settings) -> bool:
    """Return True if only master and drive are on the bus, without another producer of SYNC."""
    bus = settings.bus
    if bus.exchange == "auto":
        return bus.sync == "produce"
    return bus.exchange != "python-can"


def _call_all(functions: Sequence[Callable[[], None]]) -> None:
    for function in functions:
        function()
