"""The bus of a run: a real one, or one with the simulated drives of the configuration on it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

import can

from canwall import simdrive
from canwall.bus import reason, socket_pair
from canwall.compiled import compile_beside
from canwall.config import ConfigError, Settings
from canwall.drive import Link, refuse_second_master


def open_bus(settings: Settings) -> can.BusABC:
    """Open the bus of `[bus]`.

    Raises:
        ConfigError: If the bus does not exist.
    """
    bus = settings.bus
    try:
        return can.Bus(interface=bus.interface, channel=bus.channel, bitrate=bus.bitrate)
    except (can.CanError, OSError, ValueError, ImportError, TypeError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            why = reason(error.errno, bus.channel)
        else:
            why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(
            f"bus.interface = {bus.interface!r}, bus.channel = {bus.channel!r}: {why}"
        ) from None


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
    bus = settings.bus
    return simdrive.make_drive(
        settings.drive, settings.simulation, bus.cycle_s, bus.bitrate, report
    )


def serve_drive(
    settings: Settings,
    stop: Callable[[], bool],
    joined: Callable[[], None],
    report: Callable[[str], None] = lambda line: None,
) -> None:
    """Run a simulated drive on its bus until stopped (`canwall drive`).

    Args:
        settings: Configuration of the drive.
        stop: Called every millisecond or more often; True ends the drive.
        joined: Called once the drive receives from the bus.
        report: Called with a line when a fault begins or ends, or the bus goes or comes back.
    """
    drive = make_simulated_drive(settings, report)
    with open_bus(settings) as bus:
        # A real controller generates error frames itself; given one, it sends it as data.
        virtual = settings.bus.interface == "unixcan" or settings.bus.channel.startswith("vcan")
        runner = simdrive.BusRunner(drive, bus, error_frames=virtual, report=report)
        joined()
        runner.run(stop)


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
    if not many[0].embedded:
        with open_bus(many[0]) as bus:
            link = Link(bus)
            nodes = [settings.drive.node_id for settings in many]
            refuse_second_master(link, many[0].bus, nodes)
            yield link
        return
    drives = [make_simulated_drive(settings) for settings in many]
    with ExitStack() as stack:
        if len(many) == 1 and _is_alone(many[0]):
            bus, drive_bus = (stack.enter_context(end) for end in socket_pair(many[0].bus.channel))
            compile_beside("canwall.cycle.sockets", "compile_run")  # the drive is compiled here
            runner = simdrive.SocketRunner(drives[0], drive_bus)
            yield Link(bus, runner.poll, runner.compiled)
            return
        bus = stack.enter_context(open_bus(many[0]))
        polls = [
            simdrive.BusRunner(drive, stack.enter_context(open_bus(settings))).poll
            for drive, settings in zip(drives, many, strict=True)
        ]
        yield Link(bus, idle=polls[0] if len(polls) == 1 else partial(_call_all, polls))


def _is_alone(settings: Settings) -> bool:
    """Return True if only master and drive are on the bus, without another producer of SYNC."""
    bus = settings.bus
    if bus.exchange == "auto":
        return bus.sync == "produce"
    return bus.exchange != "python-can"


def _call_all(functions: Sequence[Callable[[], None]]) -> None:
    for function in functions:
        function()
