"""Tables that are read from the code while the site is built, so that they cannot go stale."""

import inspect
import itertools
import json
import types
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

import tomli_w
import typer
from docutils import nodes
from pydantic import BaseModel
from sphinx.util.docutils import SphinxDirective

from canwall.analysis import MEASURE_DESCRIPTIONS
from canwall.cli import app as commands
from canwall.config import Settings
from canwall.record import column_table

if TYPE_CHECKING:
    from sphinx.application import Sphinx


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


class _Generated(SphinxDirective, ABC):
    """A directive whose text is made here."""

    def run(self) -> list[nodes.Node]:
        text = "\n".join(self.lines())
        return self.parse_text_to_nodes(text, allow_section_headings=True)

    @abstractmethod
    def lines(self) -> Iterator[str]:
        """Markdown."""


class Commands(_Generated):
    """Every command of `canwall` with its arguments and options: `{canwall-commands}`."""

    def lines(self) -> Iterator[str]:
        """Sections of the second level."""
        yield from self._group("canwall", typer.main.get_command(commands))

    def _group(self, path: str, group: Any) -> Iterator[str]:
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                yield from self._group(f"{path} {name}", command)
            else:
                yield from self._command(f"{path} {name}", command)

    def _command(self, name: str, command: Any) -> Iterator[str]:
        usage = " ".join(self._usage(command))
        yield from ("", f"## {name}", "", f"`{name} {usage}`", "")
        yield inspect.cleandoc(command.help)
        rows = [self._row(parameter) for parameter in command.params if parameter.help]
        yield from ("", *_table(("", "", "default"), rows), "")

    @staticmethod
    def _usage(command: Any) -> Iterator[str]:
        for parameter in command.params:
            text = parameter.metavar or parameter.name.upper()
            if parameter.param_type_name == "option":
                if not parameter.required:
                    continue
                text = f"{parameter.opts[0]} {text}"
            text += "..." if parameter.nargs < 0 else ""
            yield text if parameter.required else f"[{text}]"
        yield "[OPTIONS]"

    @staticmethod
    def _row(parameter: Any) -> tuple[str, str, str]:
        if parameter.param_type_name == "argument":
            return f"`{parameter.metavar or parameter.name.upper()}`", parameter.help, ""
        shown = parameter.opts[0] + (f" {parameter.metavar}" if parameter.metavar else "")
        given = parameter.default if parameter.default is not None else ""
        default = "" if parameter.is_flag or given == "" else f"`{given}`"
        return f"`{shown}`", parameter.help, default


#: Names of the types in TOML, and words for the bounds of a number.
_IN_TOML = {
    float: "number",
    int: "integer",
    bool: "boolean",
    str: "string",
    Path: "path",
    dict: "table",
    tuple: "array",
}
_BOUNDS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}


class ConfigurationKeys(_Generated):
    """Every section of the configuration with its keys: `{configuration-keys}`."""

    def lines(self) -> Iterator[str]:
        """Sections of the third level."""
        yield from self._section("", Settings)

    def _section(self, path: str, section: type[BaseModel]) -> Iterator[str]:
        rows, inner = [], []
        for key, field in section.model_fields.items():
            nested = _sections_in(field.annotation)
            if nested:
                name = f"{path}{key}"
                is_array = get_origin(field.annotation) is tuple
                inner.append((f"[[{name}]]" if is_array else f"[{name}]", f"{name}.", nested[0]))
            elif path:
                values = _values(field.annotation, field.metadata)
                default = "required"
                if not field.is_required():
                    default = _default(field.get_default(call_default_factory=True))
                rows.append((f"`{key}`", values, default))
        if rows:
            yield from ("", *_table(("key", "value", "default"), rows), "")
        for heading, below, model in inner:
            yield from ("", f"### `{heading}`", "")
            yield from self._section(below, model)


def _sections_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _sections_in(part)]


def _values(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """Return the values that a key may have, in TOML's terms."""
    if hasattr(annotation, "__metadata__"):
        return _values(annotation.__origin__, [*metadata, *annotation.__metadata__])
    for inner in metadata:  # pydantic keeps the bounds of an optional number in a field of its own
        if hasattr(inner, "metadata"):
            return _values(annotation, [m for m in metadata if m is not inner] + inner.metadata)
    origin = get_origin(annotation)
    if origin in (Union, types.UnionType):
        parts = [part for part in get_args(annotation) if part is not type(None)]
        return " or ".join(dict.fromkeys(_values(part, metadata) for part in parts))
    if origin is Literal:
        return ", ".join(f'`"{value}"`' for value in get_args(annotation))
    bounds = [
        f"{sign} {getattr(item, name):g}"
        for item in metadata
        for name, sign in _BOUNDS.items()
        if getattr(item, name, None) is not None
    ]
    return " ".join([_IN_TOML[origin or annotation], ", ".join(bounds)]).strip()


def _default(value: Any) -> str:
    if value is None:
        return ""
    value = list(value) if isinstance(value, tuple) else value
    return f"`{tomli_w.dumps({'key': value}).partition(' = ')[2].strip()}`" if value != {} else ""


class RecordedColumns(_Generated):
    """The columns of `signals.parquet`: `{recorded-columns}`."""

    def lines(self) -> Iterator[str]:
        """The table of their declarations."""
        yield column_table()


class SweepMeasures(_Generated):
    """Measures of each strike in a sweep: `{sweep-measures}`."""

    def lines(self) -> Iterator[str]:
        """A table of name, unit and meaning."""
        rows = [
            (f"`{name}`", unit, meaning) for name, (unit, meaning) in MEASURE_DESCRIPTIONS.items()
        ]
        yield from _table(("variable", "unit", "meaning"), rows)


_PROMISES = Path(__file__).parents[1] / "promises.json"


class Promises(_Generated):
    """What the last search has tried, and its figures: `{promises}`, from promises.json."""

    def lines(self) -> Iterator[str]:
        """A table of the parts, then of the times to zero torque, then of the pairs."""
        parts = json.loads(_PROMISES.read_text())
        played = parts.pop("cases", {"figures": {}})
        rows = [
            (promise, case["figure"], f"`scripts/test {case['tests']}`")
            for promise, case in played["figures"].items()
        ]
        rows += [self._row(name, part) for name, part in parts.items()]
        yield from _table(("promise", "last figures", "command"), rows)
        yield from self._times(parts.get("kills", {}).get("figures", {}))
        yield from self._pairs(parts.get("belief", {}).get("figures", {}))

    @staticmethod
    def _row(name: str, part: dict[str, Any]) -> tuple[str, str, str]:
        figures = [
            f"{key.replace('_', ' ')} {_figure(value)}"
            for key, value in part["figures"].items()
            if not isinstance(value, dict) and key != "bins_ms"
        ]
        searched = f"{part['date']}, seed {part['seed']}"
        quoted = f'"{name}"' if " " in name else name
        command = f"`scripts/search {quoted} --seed {part['seed']}`"
        return part["promise"], f"{'; '.join(figures)} ({searched})", command

    @staticmethod
    def _times(kills: dict[str, Any]) -> Iterator[str]:
        if not kills.get("in contact"):
            return
        bins = kills["bins_ms"]
        head = [f"{low:g}–{high:g}" for low, high in itertools.pairwise(bins)]
        yield from ("", "## Time to zero torque", "")
        yield from (
            "Milliseconds from the signal in contact to the drive's end, as the witness saw it;",
            "the watchdogs wait for 500 ms since the last frame of the master that counts.",
            "",
        )
        rows = []
        for name, times in kills["in contact"].items():
            counts = [str(count or "") for count in times["histogram"]]
            rows.append((name, f"{times['median_ms']:g}", f"{times['longest_ms']:g}", *counts))
        yield from _table(("signal, watchdog", "median", "longest", *head), rows)

    @staticmethod
    def _pairs(belief: dict[str, Any]) -> Iterator[str]:
        if not belief:
            return
        yield from ("", "## Pairs of drive and master", "")
        yield from (
            "What the drive was, what its master took it for, and how often the search saw it. At",
            "the end of each the drive is left alone for longer than its watchdog waits; no torque",
            "was left.",
            "",
        )
        rows = []
        for pair, count in belief["pairs"].items():
            drive, _, master = pair.partition("; master: ")
            rows.append((drive, master, str(count)))
        yield from _table(("drive", "master", "seen"), rows)


_TIMES = Path(__file__).parents[1] / "ways_out.json"
_WAYS_OUT = {"ctrl_c": "Ctrl-C", "sigterm": "SIGTERM"}


class TimesOfWaysOut(_Generated):
    """What `scripts/bench ways_out` has measured: `{times-of-ways-out}`, from ways_out.json."""

    def lines(self) -> Iterator[str]:
        """A table of the signals, for each watchdog."""
        head = (
            "way out",
            "last RPDO with torque, ms (longest)",
            "drive without torque, ms (longest)",
        )
        rows = []
        for way, times in json.loads(_TIMES.read_text())["ways_out"].items():
            if way == "repeats":
                continue
            number, _, watchdog = way.partition(", ")
            shown = watchdog.replace("_", " ").replace("rpdo", "RPDO")
            name = _WAYS_OUT.get(way, f"{number.upper()}, {shown}")
            measured = (times["last_rpdo_with_torque_ms"], times["drive_without_torque_ms"])
            rows.append((name, *(f"{t['median']:.3g} ({t['longest']:.3g})" for t in measured)))
        yield from _table(head, rows)


def _figure(value: Any) -> str:
    if isinstance(value, list):
        return " to ".join(map(_figure, value))
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else f"{value:g}"


def setup(app: "Sphinx") -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("canwall-commands", Commands)
    app.add_directive("configuration-keys", ConfigurationKeys)
    app.add_directive("recorded-columns", RecordedColumns)
    app.add_directive("sweep-measures", SweepMeasures)
    app.add_directive("promises", Promises)
    app.add_directive("times-of-ways-out", TimesOfWaysOut)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
