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
        ConfigError: there is none.
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
        settings: of the run.
        report: called with a line when one of its faults begins or ends.

    Raises:
        ConfigError: there is no `[simulation]`.
        DictionaryError: the dictionary is of no use.
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
    """Serve a simulated drive alone on its bus, until stopped (`canwall drive`).

    Args:
        settings: of the drive.
        stop: asked every millisecond or more often.
        joined: called when the drive hears what is on the bus.
        report: called with a line when a fault begins or ends, or the bus goes or comes back.
    """
    drive = make_simulated_drive(settings, report)
    with open_bus(settings) as bus:
        # A controller makes its own error frames; given one, it sends it as data.
        virtual = settings.bus.interface == "unixcan" or settings.bus.channel.startswith("vcan")
        runner = simdrive.BusRunner(drive, bus, error_frames=virtual, report=report)
        joined()
        runner.run(stop)


@contextmanager
def on_the_bus(*many: Settings) -> Iterator[Link]:
    """Open a link to the bus; embedded drives live on the same bus, in the master's idle time.

    One embedded drive is at the other end of a socket pair, where compiled code exchanges its
    frames (`bus.exchange`); several, and others that python-can's virtual bus is to carry, on that.

    Raises:
        ConfigError: there is no such bus.
        DictionaryError: a drive's dictionary is of no use.
        DriveError: another master is on the bus.
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
            compile_beside("canwall.cycle.sockets", "compile_run")  # here it is the drive's turn
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
    """True if nobody but master and drive takes part: another producer of the SYNC would."""
    bus = settings.bus
    return bus.exchange == "native" or (bus.exchange == "auto" and bus.sync == "produce")


def _call_all(functions: Sequence[Callable[[], None]]) -> None:
    for function in functions:
        function()
