"""The parts of a run put together: axes on a link, their exchange, what watches them."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import can
from canopen.objectdictionary import ObjectDictionary

from canwall.config import ConfigError, Settings
from canwall.cycle import (
    BusMonitor,
    Exchange,
    Grant,
    Outcome,
    SocketTransport,
    WallAxis,
    WallStage,
    real_time_machine,
    run_loop,
)
from canwall.drive import REQUIRED_OBJECTS, DriveError, DriveNode, Link, set_up
from canwall.eds import load_eds
from canwall.record import Ring
from canwall.walls import Law

#: How long compiled code keeps the cycle before the loop looks after signals, messages and changes
#: [s of bus time].
_LOOKS_S, _SIMULATED_LOOKS_S = 0.02, 1.0


def drive_dictionary(settings: Settings) -> ObjectDictionary:
    """The object dictionary of `[drive]`, with all that a wall needs. Raises DictionaryError."""
    return load_eds(settings.drive.eds, settings.drive.node_id, REQUIRED_OBJECTS)


def make_axis(
    link: Link,
    settings: Settings,
    dictionary: ObjectDictionary,
    laws: Sequence[Law],
    ring: Ring,
) -> WallAxis:
    """Set the drive up for its wall, the rows of its cycles going into the ring.

    `dictionary` is what `[drive] eds` describes. Nothing is enabled yet. Raises DriveError.
    """
    node = DriveNode(link, settings.drive.node_id, dictionary)
    try:
        setup = set_up(node, settings.drive, settings.bus, settings.real_time)
    except BaseException:
        if settings.drive.restore:
            node.restore()
        raise
    period = settings.bus.cycle_s
    changes = [
        WallStage(round(at_s / period), wall, limits) for at_s, wall, limits in settings.stages[1:]
    ]
    return WallAxis(node, setup, settings, laws, ring, changes)


def make_exchange(link: Link, axes: Sequence[WallAxis]) -> Exchange:
    """The cycle of all axes, on the SYNC and by the exchange that `[bus]` says.

    Raises DriveError, and ConfigError for an exchange that the bus does not have.
    """
    settings, setup = axes[0].settings, axes[0].setup
    for axis in axes[1:]:
        other = axis.setup
        if (other.sync_cob_id, other.sync_counter_overflow) != (
            setup.sync_cob_id,
            setup.sync_counter_overflow,
        ):
            raise DriveError(
                f"{axis.name} wants another SYNC than {axes[0].name}: make 0x1005 and 0x1019 equal"
            )
    external = settings.bus.sync == "external"
    if settings.bus.exchange != "python-can":
        try:
            exchange = Exchange(link, axes, settings.real_time, external, SocketTransport)
            looks_s = _LOOKS_S if settings.real_time else _SIMULATED_LOOKS_S
            exchange.ahead = max(1, round(looks_s / settings.bus.cycle_s))
            return exchange
        except can.CanInitializationError as error:
            if settings.bus.exchange == "native":
                raise ConfigError(f"bus.exchange = 'native': {error}") from None
    return Exchange(link, axes, settings.real_time, external)


def make_monitor(link: Link, axes: Sequence[WallAxis]) -> BusMonitor:
    """What ends the walls beside the cycle; a second SYNC as well, where the master sends it."""
    external = axes[0].settings.bus.sync == "external"
    return BusMonitor(link, axes, None if external else axes[0].setup.sync_cob_id)


def render(
    exchange: Exchange,
    stop: Callable[[], bool],
    progress: Callable[[float], None] = lambda now_s: None,
) -> Outcome:
    """Enable the drives, render the walls for `[run] duration_s` or until stopped, disable them.

    progress is told the seconds of bus time about every 100 ms of them.
    """
    settings = exchange.axes[0].settings
    period, end_s = settings.bus.cycle_s, settings.run.duration_s
    cycles = None if end_s is None else round(end_s / period)
    return run_loop(exchange, cycles, stop, lambda j: progress(j * period))


@contextmanager
def restored() -> Iterator[tuple[list[WallAxis], dict[str, list[str]]]]:
    """Axes whose drives are put back at the end, where `[drive] restore` asks for it.

    Yields the list to fill with them, and what will be left by their names: that which could not
    be put back.
    """
    axes: list[WallAxis] = []
    left: dict[str, list[str]] = {}
    try:
        yield axes, left
    finally:
        for axis in axes:
            if axis.settings.drive.restore:
                left[axis.name] = axis.node.restore()


def scheduled(settings: Settings) -> AbstractContextManager[dict[str, Grant]]:
    """The machine's set-up for a run that keeps to the clock; tells what was granted."""
    if settings.real_time:
        return real_time_machine(settings.bus.processor)
    return nullcontext({"scheduling": Grant("simulated time")})
