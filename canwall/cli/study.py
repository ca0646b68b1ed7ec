"""Commands in which a person at the handle judges walls: `study staircase` and others."""

import contextlib
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from canwall.cli.completion import complete_law
from canwall.cli.ending import failed_if
from canwall.cli.options import ConfigFile, JsonOption, folder_path, settings_from
from canwall.cli.output import console, print_json
from canwall.cli.program import make_program
from canwall.errors import InputError
from canwall.extras import need
from canwall.stopping import INTERRUPTED

if TYPE_CHECKING:
    from canwall.study import Session, Terminal

study = make_program(
    add_completion=False,  # of the program that it is a part of
    no_args_is_help=True,
    help="Let a person at the handle judge walls, free of chatter or not.",
)

_Output = Annotated[
    Path, typer.Option(metavar="DIR", parser=folder_path, help="Folder of the session.")
]
_Laws = Annotated[
    list[str] | None,
    typer.Option(
        "--law",
        help="A law; may be repeated. Without: the file's.",
        autocompletion=complete_law,
    ),
]
#: Options, by what errors call their values.
_OPTIONS = {
    "factors": "--factor",
    "question": "--question",
    "repeats": "--repeats",
    "seed": "--seed",
    "sweep axis stiffness": "--stiffness",
    "walls": "--law",
}
#: First wall of a staircase, unless that of the file is softer [N·m/rad].
_SOFT = 5.0
_Seconds = Annotated[
    float, typer.Option(min=0.5, max=1e6, help="Seconds for which a wall is rendered.")
]


@study.command()
def staircase(
    config_file: ConfigFile,
    output: _Output,
    law: _Laws = None,
    start: Annotated[
        float | None,
        typer.Option(help="The first wall [N·m/rad]. Without: 5, or the file's if it is softer."),
    ] = None,
    ceiling: Annotated[float, typer.Option(help="No wall is stiffer [N·m/rad].")] = 500.0,
    finest: Annotated[float, typer.Option(help="Factor of the last steps.")] = 1.1,
    seconds: _Seconds = 8.0,
    as_json: JsonOption = False,
) -> int:
    """Find the stiffest wall without chatter, law by law, going up and down in ever smaller steps.

    Each wall is a run with a folder of its own in DIR; verdicts.csv has what the person said.
    """
    from canwall.study import Staircase, run_staircases

    if start is None:
        start = min(_SOFT, settings_from(config_file).wall.stiffness_nm_per_rad, ceiling)
    steps = Staircase(start, ceiling, finest)
    return _run_session(
        config_file, law, output, seconds, as_json, lambda session: run_staircases(session, steps)
    )


@study.command()
def alternating(
    config_file: ConfigFile,
    output: _Output,
    law: _Laws = None,
    stiffness: Annotated[
        str, typer.Option(metavar="LO:HI:N", help="The walls [N·m/rad]; or A,B,C.")
    ] = "5:500:9",
    seconds: _Seconds = 12.0,
    as_json: JsonOption = False,
) -> int:
    """Compare laws that take turns from strike to strike, on stiffer and stiffer walls.

    The person is not told which strike had which law. Each wall is a run with a folder of its own
    in DIR; verdicts.csv has what the person said.
    """
    need("sweep")
    from canwall.study import run_alternating
    from canwall.sweep.axes import parse_axis  # "LO:HI:N" as in a sweep

    with _naming_options():
        walls = [float(value) for value in parse_axis("stiffness", stiffness).values]
    return _run_session(
        config_file, law, output, seconds, as_json, lambda session: run_alternating(session, walls)
    )


@study.command()
def comparison(
    config_file: ConfigFile,
    output: _Output,
    law: _Laws = None,
    factor: Annotated[
        list[float] | None,
        typer.Option(
            "--factor",
            help="Stiffness of another wall over the file's; may be repeated. Without, and "
            "without laws: six from 0.5 to 2.",
        ),
    ] = None,
    question: Annotated[
        str, typer.Option(help="stiffer or free_of_chatter: what is asked of two walls.")
    ] = "stiffer",
    repeats: Annotated[int, typer.Option(help="Trials of each pair.")] = 4,
    seed: Annotated[int | None, typer.Option(help="Of the random order.")] = None,
    as_json: JsonOption = False,
) -> int:
    """Compare the wall of the file with others, two by two, in one run; which is which is hidden.

    Enter switches between the two walls of a trial, and 1 or 2 is the answer. DIR has the run, with
    comparison.csv; at the end the table has the share of the trials in which each wall was chosen,
    and the psychometric function.
    """
    if law and factor:
        raise InputError("--law and --factor: keep one of them")
    settings = settings_from(config_file)
    from canwall.config import absolute_law
    from canwall.cycle import law_of, with_law
    from canwall.panel.at_the_terminal import compare_at_terminal
    from canwall.record import RunFolder

    laws = tuple(absolute_law(name, Path()) for name in law or [])
    for name in laws:
        law_of(with_law(settings, name).wall)
    asked: dict[str, Any] = {"procedure": "comparison", "question": question, "repeats": repeats}
    asked |= {"seed": seed, "walls": [{"law": name} for name in laws]}
    asked |= {"factors": factor} if factor else {}
    more = {"duration_s": None, "more_laws": (*settings.run.more_laws, *laws)}
    settings = settings.model_copy(
        update={"schedule": (), "run": settings.run.model_copy(update=more)}
    )
    with _naming_options():
        compared = compare_at_terminal(settings, RunFolder(output), asked, _terminal(as_json))
    if as_json:
        print_json({"record": compared.result.folder.path} | compared.found)
    else:
        _print_comparison(compared.found)
    result = compared.result
    failed = failed_if([*result.outcome.trips, *result.not_restored, *result.notes])
    return failed or (INTERRUPTED if compared.interrupted else 0)


@contextlib.contextmanager
def _naming_options() -> Iterator[None]:
    """Have errors name the options of a value instead of what it becomes."""
    try:
        yield
    except InputError as error:
        key, _, what = str(error).partition(":")
        if option := _OPTIONS.get(key.partition(".")[0]):
            raise InputError(f"{option}:{what}") from None
        raise


def _run_session(
    config_file: Path,
    laws: list[str] | None,
    output: Path,
    seconds: float,
    as_json: bool,
    procedure: Callable[["Session"], None],
) -> int:
    settings = settings_from(config_file)
    from canwall.config import absolute_law
    from canwall.study import Session, SessionEndedError

    paths = [absolute_law(name, Path()) for name in laws or []]
    session = Session(settings, paths, output, seconds, _terminal(as_json))
    code = 0
    try:
        procedure(session)
    except SessionEndedError:
        pass
    except KeyboardInterrupt:
        code = INTERRUPTED
    finally:
        # However the session ends, the verdicts so far are what it has found.
        _print_verdicts(session, as_json)
        failed = failed_if(session.troubles)
    return failed or code


def _terminal(as_json: bool) -> "Terminal":
    """Return the person's terminal; standard output is left to the result if that is JSON."""
    from canwall.study import Terminal

    return Terminal(words=sys.stderr if as_json else None)


def _print_comparison(found: dict[str, Any]) -> None:
    console.print()
    if not found.get("rows"):
        console.print("no answers")
        return
    table = Table(title=found["question"], title_justify="left")
    for column in found["columns"]:
        table.add_column(column, justify="left" if column == "wall" else "right")
    for row in found["rows"]:
        table.add_row(*map(_shown, row))
    console.print(table)
    console.print(found["result"], soft_wrap=True)
    console.print(f"answers: {found['file']}", soft_wrap=True)


def _shown(cell: object) -> str:
    return "–" if cell is None else f"{cell:.3g}" if isinstance(cell, float) else str(cell)


def _print_verdicts(session: "Session", as_json: bool) -> None:
    from canwall.study import stiffness_limits

    limits = stiffness_limits(session.verdicts)
    if as_json:
        by_name = {
            name: {"free_of_chatter_up_to": free or None, "chatters_from": chatters}
            for name, (free, chatters) in limits.items()
        }
        print_json({"table": session.table, "limits": by_name, "verdicts": session.verdicts})
        return
    table = Table(title="What the person said", title_justify="left")
    for column in ("law", "free of chatter up to", "chatters from"):
        table.add_column(column, justify="left" if column == "law" else "right")
    for name, found in limits.items():
        shown = ("–" if k in (0.0, math.inf) else f"{k:.4g} N·m/rad" for k in found)
        table.add_row(name, *shown)
    console.print()
    if session.verdicts:
        console.print(table)
    console.print(f"{len(session.verdicts)} verdicts: {session.table}", soft_wrap=True)
