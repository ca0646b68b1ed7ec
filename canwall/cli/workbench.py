"""Commands of the workbench: `ball`, and `figures`, those of the chapter."""

import math
from pathlib import Path
from typing import Annotated

import typer

from canwall.cli.completion import complete_law
from canwall.cli.options import JsonOption, refuse_what_exists
from canwall.cli.output import ProgressDisplay, console, print_json
from canwall.errors import InputError
from canwall.extras import need


def ball(
    law: Annotated[
        str,
        typer.Option(
            help="Law of the floor, or 'continuous' for its referent.", autocompletion=complete_law
        ),
    ],
    output: Annotated[Path, typer.Option(help="CSV file: t, y, v, f.")],
    stiffness: Annotated[float, typer.Option(help="Floor's stiffness K [N/m].")] = 1.0,
    damping: Annotated[float, typer.Option(help="Floor's damping B [N·s/m].")] = 0.0,
    mass: Annotated[float, typer.Option(help="Ball's mass m [kg].")] = 1.0,
    viscous: Annotated[float, typer.Option(help="Ball's viscous damping b [N·s/m].")] = 0.0,
    spring: Annotated[float, typer.Option(help="Spring k_h on the ball [N/m].")] = 0.0,
    gravity: Annotated[float, typer.Option(help="Gravity g [m/s²].")] = 1.0,
    height: Annotated[float, typer.Option(help="Height at the start [m].")] = 1.0,
    speed: Annotated[float, typer.Option(help="Velocity at the start [m/s].")] = 0.0,
    period: Annotated[float, typer.Option(help="Sampling period T [s].")] = 0.1,
    periods: Annotated[int, typer.Option(help="Number of periods.")] = 3000,
    deadbeat: Annotated[bool, typer.Option("--deadbeat", help="Add the compensation.")] = False,
    tension: Annotated[str, typer.Option(help="allow, clamp or budget.")] = "allow",
    passivity: Annotated[float, typer.Option(help="Passivity controller's damping.")] = 0.0,
    option: Annotated[list[str] | None, typer.Option(help="Law's option, NAME=VALUE.")] = None,
    as_json: JsonOption = False,
) -> int:
    """Simulate a ball that bounces on the wall as its floor: exact state, no delay, held force."""
    refuse_what_exists(output)
    from canwall.config import absolute_law
    from canwall.workbench import CONTINUOUS, Ball, simulate_ball, write_ball

    ball = Ball(
        stiffness=stiffness,
        damping=damping,
        mass=mass,
        viscous=viscous,
        spring=spring,
        gravity=gravity,
        height=height,
        speed=speed,
        period=period,
        periods=periods,
        tension=tension,
        passivity=passivity,
    )
    if law == CONTINUOUS and (deadbeat or option or tension != "allow" or passivity):
        raise InputError(
            "--law continuous is the referent: leave out --deadbeat, --tension, --passivity, "
            "--option"
        )
    name = law if law == CONTINUOUS else absolute_law(law, Path())
    y, v, force = simulate_ball(ball, name, deadbeat, _parse_options(option or []))
    write_ball(output, ball, y, v, force)
    energy = ball.energy(y, v)
    outside = (y >= 0.0).nonzero()[0]
    last = int(outside[-1]) if len(outside) else None
    if as_json:
        found = {
            "theta": ball.theta,
            "energy_start_j": energy[0],
            "energy_end_j": None if last is None else energy[last],
            "end_s": None if last is None else last * period,
        }
        print_json(found)
        return 0
    end = "never outside"
    if last is not None:
        end = f"{energy[last]:.9g} J at the last sample outside (t = {last * period:g} s)"
    console.print(
        f"θ = {ball.theta:g}; energy {energy[0]:.9g} J at the start, {end}",
        highlight=False,
        soft_wrap=True,
    )
    return 0


def _parse_options(assignments: list[str]) -> dict[str, float]:
    """Split NAME=NUMBER of --option."""
    options = {}
    for text in assignments:
        name, equals, value = text.partition("=")
        try:
            options[name] = float(value)
        except ValueError:
            equals = ""
        if not equals or not math.isfinite(options[name]):
            raise InputError(f"--option {text}: has to be NAME=NUMBER")
    return options


def figures(
    output: Annotated[Path, typer.Option(help="New folder for pictures, data and index.md.")],
) -> int:
    """Draw the figures of the chapter, each with its data, and a comparison of all laws."""
    need("plot", "sweep")
    refuse_what_exists(output)
    from canwall.workbench.figures import write_figures

    with ProgressDisplay() as display:
        index = write_figures(output, progress=display.count)
    console.print(str(index), soft_wrap=True, highlight=False)
    return 0
