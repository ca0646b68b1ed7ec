"""Sweeps on a drive with a person at the handle: `scripts/staircase`, `scripts/alternating`."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from canwall import config
from canwall.cli import INTERRUPTED, make_program, run_program

app = make_program()

Config = Annotated[Path, typer.Argument(metavar="CONFIG", help="A TOML file.")]
Output = Annotated[Path, typer.Option(metavar="DIR", help="Folder of the session.")]
Laws = Annotated[
    list[str] | None, typer.Option("--law", help="A law; may be repeated. Without: the file's.")
]
Seconds = Annotated[float, typer.Option(min=0.5, help="Seconds for which a wall is rendered.")]


@app.command()
def staircase(
    config_file: Config,
    output: Output,
    law: Laws = None,
    start: Annotated[float, typer.Option(help="The first wall [N·m/rad].")] = 5.0,
    ceiling: Annotated[float, typer.Option(help="No wall is stiffer [N·m/rad].")] = 500.0,
    finest: Annotated[float, typer.Option(help="Factor of the last steps.")] = 1.1,
    seconds: Seconds = 8.0,
) -> int:
    """A person finds the stiffest wall without chatter, law by law: up and down in smaller steps.

    Each wall is a run with a folder of its own in DIR; verdicts.csv has what the person said.
    """
    from canwall.study.staircase import Staircase, staircases

    steps = Staircase(start, ceiling, finest)
    return _session(
        config_file, law or [], output, seconds, lambda session: staircases(session, steps)
    )


@app.command()
def alternating(
    config_file: Config,
    output: Output,
    law: Laws = None,
    stiffness: Annotated[
        str, typer.Option(metavar="LO:HI:N", help="The walls [N·m/rad]; or A,B,C.")
    ] = "5:500:9",
    seconds: Seconds = 12.0,
) -> int:
    """A person compares laws that take turns from strike to strike, on ever stiffer walls.

    The person is not told which strike had which law. Each wall is a run with a folder of its own
    in DIR; verdicts.csv has what the person said.
    """
    from canwall.study.staircase import alternating
    from canwall.sweep.axes import parsed

    walls = [float(value) for value in parsed("stiffness", stiffness).values]
    return _session(
        config_file, law or [], output, seconds, lambda session: alternating(session, walls)
    )


def _session(
    config_file: Path,
    laws: list[str],
    output: Path,
    seconds: float,
    ask: Callable[..., None],
) -> int:
    from canwall.config import absolute_law
    from canwall.study.session import Session
    from canwall.study.staircase import limits
    from canwall.study.terminal import SessionEndedError, Terminal

    settings = config.load(config_file)
    laws = [absolute_law(name, Path()) for name in laws]
    session = Session(settings, laws, output, seconds, Terminal())
    try:
        ask(session)
    except SessionEndedError:
        return 0
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        table = Table(title="What the person said", title_justify="left")
        for column in ("law", "free of chatter up to", "chatters from"):
            table.add_column(column, justify="left" if column == "law" else "right")
        for name, (free, chatters) in limits(session.verdicts).items():
            table.add_row(name, f"{free:.4g} N·m/rad", f"{chatters:.4g} N·m/rad")
        console = Console()
        console.print()
        if session.verdicts:
            console.print(table)
        console.print(f"{len(session.verdicts)} verdicts: {session.table}", soft_wrap=True)
    return 0


if __name__ == "__main__":
    run_program(app)
