"""Commands in which a person at the handle judges walls: `study staircase`, `study alternating`."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from canwall.cli.ending import INTERRUPTED, failed_if
from canwall.cli.options import settings_from
from canwall.cli.output import console
from canwall.cli.program import make_program
from canwall.config import absolute_law

if TYPE_CHECKING:
    from canwall.study import Session

study = make_program(
    no_args_is_help=True, help="Let a person at the handle judge walls, free of chatter or not."
)

_Config = Annotated[Path, typer.Argument(metavar="CONFIG", help="A TOML file.")]
_Output = Annotated[Path, typer.Option(metavar="DIR", help="Folder of the session.")]
_Laws = Annotated[
    list[str] | None, typer.Option("--law", help="A law; may be repeated. Without: the file's.")
]
_Seconds = Annotated[float, typer.Option(min=0.5, help="Seconds for which a wall is rendered.")]


@study.command()
def staircase(
    config_file: _Config,
    output: _Output,
    law: _Laws = None,
    start: Annotated[float, typer.Option(help="The first wall [N·m/rad].")] = 5.0,
    ceiling: Annotated[float, typer.Option(help="No wall is stiffer [N·m/rad].")] = 500.0,
    finest: Annotated[float, typer.Option(help="Factor of the last steps.")] = 1.1,
    seconds: _Seconds = 8.0,
) -> int:
    """Find the stiffest wall without chatter, law by law, going up and down in ever smaller steps.

    Each wall is a run with a folder of its own in DIR; verdicts.csv has what the person said.
    """
    from canwall.study import Staircase, run_staircases

    steps = Staircase(start, ceiling, finest)
    return _run_session(
        config_file, law, output, seconds, lambda session: run_staircases(session, steps)
    )


@study.command()
def alternating(
    config_file: _Config,
    output: _Output,
    law: _Laws = None,
    stiffness: Annotated[
        str, typer.Option(metavar="LO:HI:N", help="The walls [N·m/rad]; or A,B,C.")
    ] = "5:500:9",
    seconds: _Seconds = 12.0,
) -> int:
    """Compare laws that take turns from strike to strike, on stiffer and stiffer walls.

    The person is not told which strike had which law. Each wall is a run with a folder of its own
    in DIR; verdicts.csv has what the person said.
    """
    from canwall.study import run_alternating
    from canwall.sweep.axes import parse_axis  # "LO:HI:N" as in a sweep

    walls = [float(value) for value in parse_axis("stiffness", stiffness).values]
    return _run_session(
        config_file, law, output, seconds, lambda session: run_alternating(session, walls)
    )


def _run_session(
    config_file: Path,
    laws: list[str] | None,
    output: Path,
    seconds: float,
    procedure: Callable[["Session"], None],
) -> int:
    settings = settings_from(config_file)
    from canwall.study import Session, SessionEndedError, Terminal

    paths = [absolute_law(name, Path()) for name in laws or []]
    session = Session(settings, paths, output, seconds, Terminal())
    code = 0
    try:
        procedure(session)
    except SessionEndedError:
        pass
    except KeyboardInterrupt:
        code = INTERRUPTED
    finally:
        # However the session ends, the verdicts so far are what it has found.
        _print_verdicts(session)
        failed = failed_if(session.troubles)
    return failed or code


def _print_verdicts(session: "Session") -> None:
    from canwall.study import stiffness_limits

    table = Table(title="What the person said", title_justify="left")
    for column in ("law", "free of chatter up to", "chatters from"):
        table.add_column(column, justify="left" if column == "law" else "right")
    for name, (free, chatters) in stiffness_limits(session.verdicts).items():
        table.add_row(name, f"{free:.4g} N·m/rad", f"{chatters:.4g} N·m/rad")
    console.print()
    if session.verdicts:
        console.print(table)
    console.print(f"{len(session.verdicts)} verdicts: {session.table}", soft_wrap=True)
