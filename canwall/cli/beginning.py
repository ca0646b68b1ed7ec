"""Commands with which a bench begins: `scan`, `init`, `config`."""

import dataclasses
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich import box
from rich.table import Table

from canwall.cli.options import JsonOption, absolute_path, settings_from
from canwall.cli.output import console, print_json, print_text, say
from canwall.errors import InputError

if TYPE_CHECKING:
    from canwall.bench import BusNode
    from canwall.config import Bus
    from canwall.drive import Link

_T = TypeVar("_T")

InterfaceOption = Annotated[
    str | None, typer.Option(help="python-can's name of the adapter: socketcan, pcan, unixcan.")
]
ChannelOption = Annotated[
    str | None, typer.Option(help="Its channel: can0, PCAN_USBBUS1; of unixcan a path.")
]
BitrateOption = Annotated[
    int | None, typer.Option(min=1, help="Bit rate [bit/s], for adapters that set it.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Overwrite the file.")]


def scan(
    config_file: Annotated[
        Path | None,
        typer.Argument(metavar="CONFIG", help="A TOML file or a name, in place of the options."),
    ] = None,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    bitrate: BitrateOption = None,
    as_json: JsonOption = False,
) -> int:
    """List the nodes on a bus: identity, profile, states, and which of them are drives.

    Nothing is written to them.
    """
    from canwall.bench import scan_nodes

    if config_file is None:
        with closing(_link(_bus(interface, channel, bitrate))) as link:
            nodes = scan_nodes(link)
    else:
        overrides = {"bus__interface": interface, "bus__channel": channel, "bus__bitrate": bitrate}
        settings = settings_from(config_file, **overrides)
        if settings.embedded:
            from canwall.run import on_the_bus

            with on_the_bus(settings) as link:
                nodes = scan_nodes(link)
        else:
            with closing(_link(settings.bus)) as link:
                nodes = scan_nodes(link)
    if as_json:
        print_json([dataclasses.asdict(node) | {"drive": node.is_drive} for node in nodes])
    elif nodes:
        console.print(_node_table(nodes))
    else:
        say("no node answers: is the bus terminated, are all at this bit rate, are they on?")
    return 0


def init(
    drive: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|EDS", help="A name of `canwall config`, or the drive's EDS or DCF."
        ),
    ] = None,
    node: Annotated[
        int | None, typer.Option(min=1, max=127, help="Node-ID; without: that of the only drive.")
    ] = None,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    bitrate: BitrateOption = None,
    eds: Annotated[
        Path | None, typer.Option(metavar="PATH", help="With a name: the drive's EDS or DCF.")
    ] = None,
    cycle: Annotated[float, typer.Option(min=1e-4, max=0.1, help="Period of the SYNC [s].")] = 1e-3,
    rated_torque: Annotated[
        float | None, typer.Option(min=1e-6, max=1e6, help="Rated torque of the motor [N·m].")
    ] = None,
    counts: Annotated[
        float | None,
        typer.Option(min=1.0, max=2.0**32, help="Increments of 0x6064 per turn of the motor."),
    ] = None,
    gear: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1e6, help="Turns of the motor per turn of the shaft."),
    ] = None,
    inertia: Annotated[
        float, typer.Option(min=1e-9, max=1e3, help="Inertia of drive and handle [kg·m²], roughly.")
    ] = 1e-4,
    output: Annotated[Path, typer.Option(metavar="FILE", help="File to write.")] = Path(
        "bench.toml"
    ),
    force: ForceOption = False,
) -> int:
    """Write a configuration for a drive on the bus: commented, and soft to begin with.

    On a terminal it asks for what no option has. The drive is read, and nothing is written to it.
    """
    from canwall import config
    from canwall.bench import draft, read_drive, scan_nodes
    from canwall.drive import DriveError

    _refuse_to_overwrite(output, force)
    title, keys = _kind_of(_given(drive, "--drive", _DRIVE), eds)
    bus = _bus(interface, channel, bitrate).model_copy(update={"cycle_s": cycle})
    with closing(_link(bus)) as link:
        nodes = scan_nodes(link)
        if sys.stdin.isatty() and nodes:
            console.print(_node_table(nodes))
        node_id = _chosen_node(nodes, node)
        given = {
            "rated_torque_nm": rated_torque,
            "counts_per_rev": counts,
            "gear_ratio": gear,
        }
        while True:
            drive_keys = keys | {key: value for key, value in given.items() if value is not None}
            settings = config.Drive(node_id=node_id, **drive_keys)
            try:
                facts = read_drive(link, settings)
                break
            except DriveError as error:
                lacking = [key for key in _TOLD if f"give drive.{key}" in str(error)]
                if not lacking or any(given[key] is not None for key in lacking):
                    raise
                for key in lacking:
                    given[key] = _given(None, *_TOLD[key], kind=float)
    name = next((n.name for n in nodes if n.node_id == node_id and n.name), None)
    title = title or name or f"Node {node_id}"
    text = draft(bus, settings, facts, title, inertia, output)
    written = config.parse(text, output)
    _write(output, text)
    console.print(
        f"{output}: node {node_id}, {title}: K = {written.wall.stiffness_nm_per_rad:g} N·m/rad, "
        f"at most {written.limits.torque_nm:g} N·m; next: canwall doctor {output}",
        soft_wrap=True,
        highlight=False,
    )
    return 0


def config(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="One of the list; without: the list.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write it to a file instead.")
    ] = None,
    force: ForceOption = False,
) -> int:
    """List the configurations that come with canwall, or print one of them."""
    from canwall import config

    known = config.catalogue()
    if name is None:
        if output is not None:
            raise InputError("--output needs the NAME of a configuration; `canwall config` lists")
        table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        for each, path in known.items():
            table.add_row(each, config.title_of(path))
        console.print(table, highlight=False)
        return 0
    text = config.portable_text(config.named(name))
    if output is None:
        print_text(text, end="")
        return 0
    _refuse_to_overwrite(output, force)
    _write(output, text)
    console.print(str(output), soft_wrap=True, highlight=False)
    return 0


_DRIVE = "drive (a name of `canwall config`, or the path of its EDS or DCF)"
#: Keys that only the user can tell of some drives: option and question.
_TOLD = {
    "rated_torque_nm": ("--rated-torque", "rated torque of the motor [N·m]"),
    "counts_per_rev": ("--counts", "increments of 0x6064 per turn of the motor"),
    "gear_ratio": ("--gear", "turns of the motor per turn of the shaft"),
}


def _given(value: _T | None, option: str, what: str, kind: Any = str) -> _T:
    """Return the value of an option, else what is answered on a terminal. Raises InputError."""
    if value is not None:
        return value
    if not sys.stdin.isatty():
        raise InputError(f"{option} is missing: {what}")
    answer: _T = typer.prompt(what, type=kind, err=True)
    return answer


def _bus(interface: str | None, channel: str | None, bitrate: int | None) -> "Bus":
    from canwall.config import Bus

    interface = _given(interface, "--interface", "interface (socketcan, pcan, kvaser, unixcan)")
    channel = _given(channel, "--channel", "channel (can0; of unixcan a path)")
    bus = Bus(interface=interface, channel=channel)
    return bus if bitrate is None else bus.model_copy(update={"bitrate": bitrate})


def _link(bus: "Bus") -> "Link":
    from canwall.bus import open_bus
    from canwall.drive import Link

    return Link(open_bus(bus.interface, bus.channel, bus.bitrate))


def _chosen_node(nodes: "list[BusNode]", node: int | None) -> int:
    """Return the given node, or the only drive; on a terminal ask. Raises InputError."""
    drives = [each.node_id for each in nodes if each.is_drive]
    found = ", ".join(str(each.node_id) for each in nodes)
    if not nodes:
        raise InputError("no node answers: are drive and bus on, and at this bit rate?")
    if node is not None:
        if node not in [each.node_id for each in nodes]:
            raise InputError(f"--node {node}: does not answer; nodes on the bus: {found}")
        return node
    if len(drives) == 1:
        return drives[0]
    return _given(None, "--node", f"node-ID of the drive (nodes on the bus: {found})", kind=int)


def _kind_of(drive: str, eds: Path | None) -> tuple[str, dict[str, Any]]:
    """Return a title, and the keys of `[drive]` for a name or an EDS. Raises InputError."""
    from canwall import config
    from canwall.bench import KEYS_OF_A_KIND

    if eds is not None and not eds.is_file():
        raise InputError(f"--eds {eds}: no such EDS or DCF")
    if drive in config.catalogue():
        path = config.catalogue()[drive]
        kind = config.load(path).drive
        file = absolute_path(eds) or kind.eds
        if not file.is_file():
            file = Path(kind.eds.name).resolve()
        if not file.is_file():
            raise InputError(
                f"--drive {drive}: its file {kind.eds.name} is the manufacturer's and is not here; "
                f"get it, and give --eds PATH"
            )
        title = config.title_of(path) if path.parent.name == "drives" else ""
        return title, kind.model_dump(include=set(KEYS_OF_A_KIND)) | {"eds": file}
    file = Path(drive).resolve()
    if not file.is_file():
        raise InputError(
            f"--drive {drive}: neither an EDS nor one of {', '.join(config.catalogue())}"
        )
    assumed = config.load(config.shipped("config/sim.toml")).drive
    lags = assumed.model_dump(include={"drive_cycle_s", "current_bandwidth_hz"})
    return "", lags | {"eds": absolute_path(eds) or file}


def _refuse_to_overwrite(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise InputError(f"{path}: exists; give --force to overwrite it, or another --output")


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path}: cannot be written: {why}; choose another --output") from None


def _node_table(nodes: "list[BusNode]") -> Table:
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("node", justify="right")
    for heading in ("name", "profile"):
        table.add_column(heading)
    table.add_column("vendor, product,\nrevision", no_wrap=True)
    table.add_column("NMT", no_wrap=True)
    table.add_column("state")
    for node in nodes:
        vendor, *others = (
            "–" if number is None else f"{number:#x}"
            for number in (node.vendor_id, node.product_code, node.revision)
        )
        table.add_row(
            str(node.node_id),
            node.name or "–",
            node.profile,
            f"{vendor},\n{', '.join(others)}",
            node.nmt_state or "–",
            node.drive_state or "–",
        )
    return table
