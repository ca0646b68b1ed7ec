"""The bus of a run: a real one, or one with the simulated drives of the configuration on it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

import can

from canwall import simdrive
from canwall.bus import reason, socket_pair
from canwall.config import ConfigError, Settings
from canwall.drive import Link, refuse_second_master


def open_bus(settings: Settings) -> can.BusABC:
    """The bus of `[bus]`. Raises ConfigError where there is none."""
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
    """The drive of `[simulation]`, from the dictionary of `[drive]`.

    report is told in a line when one of its faults begins or ends. Raises
    ConfigError, DictionaryError.
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
    """A simulated drive alone on its bus, until stopped (`canwall drive`).

    `joined` is called when it hears what is on the bus, report is told of its faults, and of the
    bus being gone.
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
    """A link to the bus; embedded drives live on the same bus, in the master's idle time.

    Raises ConfigError and DictionaryError, DriveError where another master is on it.
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
        if len(many) == 1 and many[0].bus.exchange == "native":
            bus, drive_bus = (stack.enter_context(end) for end in socket_pair(many[0].bus.channel))
            runner = simdrive.SocketRunner(drives[0], drive_bus)
            yield Link(bus, runner.poll, runner.compiled)
            return
        bus = stack.enter_context(open_bus(many[0]))
        polls = [
            simdrive.BusRunner(drive, stack.enter_context(open_bus(settings))).poll
            for drive, settings in zip(drives, many, strict=True)
        ]
        yield Link(bus, idle=polls[0] if len(polls) == 1 else partial(_call_all, polls))


def _call_all(functions: Sequence[Callable[[], None]]) -> None:
    for function in functions:
        function()
