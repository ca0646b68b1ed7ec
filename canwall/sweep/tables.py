"""What a sweep came to, as a table for people."""

import itertools
import math
from collections.abc import Iterator, Sequence

import xarray as xr
from rich.markup import escape
from rich.table import Table

from canwall.sweep.axes import DAMPING, STIFFNESS, STRIKES
from canwall.sweep.labels import named


def sweep_table(dataset: xr.Dataset) -> Table:
    """A row for each condition: its K-limit, or what of its map is free of chatter."""
    strikes = math.prod(dataset.sizes[name] for name in STRIKES)
    title = "K-limits" if "worst" in dataset else "Free of chatter"
    found = _limits(dataset) if "worst" in dataset else _maps(dataset)
    table = Table(title=f"{title} (the worst of {strikes})", title_justify="left")
    for place, row in enumerate(found):
        if place == 0:
            for name in row:
                table.add_column(
                    escape(name), justify="left" if name == "law" else "right", no_wrap=True
                )
        table.add_row(*map(escape, row.values()))
    return table


def without_effect(dataset: xr.Dataset) -> list[str]:
    """A line for stiffness or damping where the walls of some laws are the same at all its values.

    A law without a damper takes any damping, and one without a spring any stiffness.
    """
    lines = []
    for axis in (*STIFFNESS, *DAMPING):
        if dataset.sizes.get(axis, 1) > 1:
            rendered = dataset[["peak_torque", "penetration", "energy_out"]]
            first = rendered.isel({axis: 0})
            same = ((rendered == first) | (rendered.isnull() & first.isnull())).to_dataarray()
            without = same.all([dim for dim in same.dims if dim != "law"])
            laws = [str(law) for law in without["law"].values[without.values]]
            if laws:
                lines.append(f"{axis} changes nothing for {', '.join(laws)}")
    return lines


def _limits(dataset: xr.Dataset) -> Iterator[dict[str, str]]:
    worst = dataset["worst"]
    for shown, at in _conditions(dataset, [str(d) for d in worst.dims]):
        limit = worst.isel(at).item()
        best = dataset["limit"].isel(at).max().item()
        # Where no strike chatters the search ends, not the wall.
        least = "≥ " if dataset["open_ended"].isel(at).all().item() else ""
        yield shown | {
            "K\n[N·m/rad]": least + f"{limit:.3g}",
            "K·T²/m": least + f"{dataset['worst_normalised'].isel(at).item():.3g}",
            "best strike\n÷ worst": f"{best / limit:.3g}" if limit > 0.0 else "–",
        }


def _maps(dataset: xr.Dataset) -> Iterator[dict[str, str]]:
    wall = [named(dataset, DAMPING), named(dataset, STIFFNESS)]
    chatters = dataset["chatters"].any(STRIKES).transpose(..., *wall)
    for shown, at in _conditions(dataset, [str(d) for d in chatters.dims if d not in wall]):
        one = chatters.isel(at).values
        stiffness = dataset[wall[1]].values
        # Up to the first wall that chatters, at the damping where that is farthest.
        free = max(next((i for i, c in enumerate(row) if c), len(row)) for row in one)
        yield shown | {
            "walls": str(one.size),
            "free": str(int((~one).sum())),
            f"free up to\n{wall[1]}": f"{stiffness[free - 1]:.3g}" if free else "none",
            "energy out\n[mJ], at most": f"{dataset['energy_out'].isel(at).max().item() * 1e3:.3g}",
        }


def _conditions(
    dataset: xr.Dataset, dims: Sequence[str]
) -> Iterator[tuple[dict[str, str], dict[str, int]]]:
    """What tells each condition from the others, and its place on each axis."""
    for point in itertools.product(*(range(dataset.sizes[d]) for d in dims)):
        at = dict(zip(dims, point, strict=True))
        shown = {}
        for name, place in at.items():
            if dataset.sizes[name] > 1 or name == "law":
                value = dataset[name].values[place]
                shown[name] = value if isinstance(value, str) else f"{value:g}"
        yield shown, at
