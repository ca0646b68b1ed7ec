"""Assembly of a run: the axes on a link, their exchange, their monitor."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import can
from canopen.objectdictionary import ObjectDictionary

from canwall.config import ConfigError, Settings
from canwall.cycle import (
    BusMonitor,
    Exchange,
    Experiment,
    Grant,
    Loop,
    Outcome,
    SocketTransport,
    WallAxis,
    WallStage,
    real_time_machine,
    run_loop,
)
from canwall.drive import REQUIRED_OBJECTS, DriveError, DriveNode, Link, set_up
from canwall.eds import load_eds
from canwall.errors import first_of
from canwall.record import Ring
from canwall.walls import Law

#: Time for which compiled code runs cycles before the loop handles signals, messages and changes,
#: in real and in simulated time [s of bus time].
_NATIVE_SPAN_S, _SIMULATED_NATIVE_SPAN_S = 0.02, 1.0


def drive_dictionary(settings: Settings) -> ObjectDictionary:
    """Load the object dictionary of `[drive]`. Raises DictionaryError if it lacks an object."""
    return load_eds(settings.drive.eds, settings.drive.node_id, REQUIRED_OBJECTS)


def make_axis(
    link: Link,
    settings: Settings,
    dictionary: ObjectDictionary,
    laws: Sequence[Law],
    ring: Ring,
) -> WallAxis:
    """Set a drive up for its wall, without enabling it.

    Args:
        link: The bus.
        settings: Configuration of drive and wall.
        dictionary: Object dictionary of the drive, from `drive_dictionary`.
        laws: Laws of the run, from `run_laws`.
        ring: Ring for the rows of its cycles.

    Raises:
        DriveError: If the drive cannot be set up. With `[drive] restore` its changes are undone;
            notes of the error name those that could not be.
    """
    node = DriveNode(link, settings.drive.node_id, dictionary, settings.drive.sdo_timeout_s)
    try:
        setup = set_up(
            node, settings.drive, settings.bus, settings.limits.torque_nm, settings.real_time
        )
        period = settings.bus.cycle_s
        changes = [WallStage(round(stage[0] / period), *stage[1:]) for stage in settings.stages[1:]]
        # Within, as it loads compiled code for a second, in which Ctrl-C may come.
        return WallAxis(node, setup, settings, laws, ring, changes)
    except BaseException as error:
        if settings.drive.restore:
            _tell(error, _restored(node))
        raise


def make_exchange(link: Link, axes: Sequence[WallAxis]) -> Exchange:
    """Make the exchange of frames for all axes, as `[bus]` says.

    Raises:
        DriveError: If the drives need different SYNCs.
        ConfigError: If the bus does not support the exchange.
    """
    settings, setup = axes[0].settings, axes[0].setup
    for axis in axes[1:]:
        other = axis.setup
        if (other.sync_cob_id, other.sync_counter_overflow) != (
            setup.sync_cob_id,
            setup.sync_counter_overflow,
        ):
            raise DriveError(
                f"{axis.name} needs another SYNC than {axes[0].name}: make 0x1005 and 0x1019 equal"
            )
    external = settings.bus.sync == "external"
    if settings.bus.exchange != "python-can":
        try:
            exchange = Exchange(link, axes, settings.real_time, external, SocketTransport)
            span_s = _NATIVE_SPAN_S if settings.real_time else _SIMULATED_NATIVE_SPAN_S
            exchange.ahead = max(1, round(span_s / settings.bus.cycle_s))
            return exchange
        except can.CanInitializationError as error:
            if settings.bus.exchange == "native":
                raise ConfigError(f"bus.exchange = 'native': {error}") from None
    return Exchange(link, axes, settings.real_time, external)


def make_monitor(link: Link, axes: Sequence[WallAxis]) -> BusMonitor:
    """Make the monitor of the bus; it watches for a second SYNC if the master produces SYNC."""
    external = axes[0].settings.bus.sync == "external"
    return BusMonitor(link, axes, None if external else axes[0].setup.sync_cob_id)


def render(
    exchange: Exchange,
    stop: Callable[[], bool],
    progress: Callable[[float], None] = lambda now_s: None,
    outcome: Outcome | None = None,
    experiments: Sequence[Experiment] = (),
) -> Outcome:
    """Enable the drives, render the walls for `[run] duration_s` or until stopped, disable them.

    Args:
        exchange: Exchange of frames with the drives.
        stop: Asked in the thread of the loop whether to end the walls.
        progress: Called there with the bus time [s] about every 100 ms of it.
        outcome: Filled with the outcome, which is there even if an exception is raised.
        experiments: Made in place of the walls.
    """
    settings = exchange.axes[0].settings
    period, end_s = settings.bus.cycle_s, settings.run.duration_s
    cycles = None if end_s is None else round(end_s / period)

    def work(loop: Loop) -> bool:
        return loop.measure(experiments) if experiments else loop.render(cycles)

    return run_loop(
        exchange,
        work,
        stop,
        lambda j: progress(j * period),
        _prepared_machine(settings),
        outcome,
    )


@contextmanager
def restoring_drives() -> Iterator[tuple[list[WallAxis], dict[str, list[str]]]]:
    """Undo the changes in the drives at the end, for each with `[drive] restore`.

    Yields a list to fill with the axes, and a dictionary that will hold, by name of the axis, a
    line if changes could not be undone. An error on the way has it as a note; Ctrl-C becomes a
    DriveError.
    """
    axes: list[WallAxis] = []
    failures: dict[str, list[str]] = {}
    try:
        yield axes, failures
    except BaseException as error:
        failures.update(_restore(axes))
        _tell(error, [line for lines in failures.values() for line in lines])
        raise
    failures.update(_restore(axes))


def _restore(axes: Sequence[WallAxis]) -> dict[str, list[str]]:
    return {axis.name: _restored(axis.node) for axis in axes if axis.settings.drive.restore}


def _restored(node: DriveNode) -> list[str]:
    """Undo the changes in a drive; return one line if any could not be undone."""
    failures = node.restore()
    if not failures:
        return []
    name = f"node {node.node_id}: "
    what = first_of(failures).removeprefix(name)
    return [f"{name}not restored: {what}; switch the drive off and on"]


def _tell(error: BaseException, not_restored: Sequence[str]) -> None:
    """Add what was not restored to an error as notes; Ctrl-C has none, and becomes an error."""
    if not_restored and isinstance(error, KeyboardInterrupt):
        raise DriveError("; ".join(["interrupted", *not_restored])) from None
    for line in not_restored:
        error.add_note(line)


def _prepared_machine(settings: Settings) -> AbstractContextManager[dict[str, Grant]]:
    """Prepare the machine for a run in real time; the context yields what was granted."""
    if settings.real_time:
        return real_time_machine(settings.bus.processor)
    return nullcontext({"scheduling": Grant("simulated time")})
