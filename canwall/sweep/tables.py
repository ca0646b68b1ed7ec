"""Result of a sweep as a table on the terminal."""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from rich.table import Table

from canwall.sweep.axes import DAMPING, STIFFNESS, STRIKES
from canwall.sweep.labels import LABELS, axis_name, value_text


def sweep_table(dataset: xr.Dataset) -> Table:
    """Return a table with a row per condition: its K-limit, or the free part of its map."""
    strikes = math.prod(dataset.sizes[name] for name in STRIKES)
    title = "K-limits" if "worst" in dataset else "Free of chatter"
    rows = _limit_rows(dataset) if "worst" in dataset else _map_rows(dataset)
    table = Table(title=f"{title} (the worst of {strikes})", title_justify="left")
    for number, row in enumerate(rows):
        if number == 0:
            for name in row:
                table.add_column(
                    name,
                    justify="left" if name == "law" else "right",
                    no_wrap=name != "law",
                    overflow="fold",
                )
        table.add_row(*row.values())
    return table


def ineffective_axis_notes(dataset: xr.Dataset) -> list[str]:
    """Return a line for each axis of the wall that changes nothing for some of the laws.

    A law without a damper ignores the damping, one without a spring the stiffness.
    """
    notes = []
    for axis in (*STIFFNESS, *DAMPING):
        if dataset.sizes.get(axis, 1) > 1:
            rendered = dataset[["peak_torque", "penetration", "energy_out"]]
            first = rendered.isel({axis: 0})
            same = ((rendered == first) | (rendered.isnull() & first.isnull())).to_dataarray()
            without = same.all([dim for dim in same.dims if dim != "law"])
            laws = [str(law) for law in without["law"].values[without.values]]
            if laws:
                notes.append(f"{axis} changes nothing for {', '.join(laws)}")
    return notes


def _limit_rows(dataset: xr.Dataset) -> Iterator[dict[str, str]]:
    worst = dataset["worst"]
    lowered = _is_lowered(dataset["stiffness_in_force"], worst)
    # Motion and ripple are not judged in them.
    unsettled = ~dataset["settled"].astype(bool) & (worst > 0.0)
    for labels, index in _conditions(dataset, [str(d) for d in worst.dims]):
        limit = worst.isel(index).item()
        best = dataset["limit"].isel(index).max().item()
        # If no strike chatters, the limit is where the search ended.
        at_least = "≥ " if dataset["open_ended"].isel(index).all().item() else ""
        normalised = dataset["worst_normalised"].isel(index).item()
        yield labels | {
            "K\n[N·m/rad]": at_least + f"{limit:.3g}",
            "K·T²/m": at_least + f"{normalised:.3g}",
            **(
                {"K in force\n[N·m/rad]": _least(dataset["stiffness_in_force"].isel(index))}
                if lowered
                else {}
            ),
            **(
                {"strikes not\nsettled": str(unsettled.isel(index).sum().item())}
                if unsettled.any()
                else {}
            ),
            "best strike\n÷ worst": f"{best / limit:.3g}" if limit > 0.0 else "–",
            "ripple\n[N]": _worst(dataset["ripple"].isel(index)),
            "first depth\n÷ referent": _worst(
                (dataset["first_depth"] / dataset["referent_first_depth"]).isel(index)
            ),
        }


def _is_lowered(in_force: xr.DataArray, asked: xr.DataArray) -> bool:
    """Return True if a stiffness in force is below the one that was asked for, by a cap."""
    return bool((in_force < asked * (1.0 - 1e-9)).any())


def _least(values: xr.DataArray) -> str:
    """Return the least known value of all strikes."""
    known = values.values[np.isfinite(values.values)]
    return f"{known.min():.3g}" if known.size else "–"


def _worst(values: xr.DataArray) -> str:
    """Return the largest known value of all strikes."""
    known = values.values[np.isfinite(values.values)]
    return f"{known.max():.2g}" if known.size else "–"


def _map_rows(dataset: xr.Dataset) -> Iterator[dict[str, str]]:
    wall = [axis_name(dataset, DAMPING), axis_name(dataset, STIFFNESS)]
    chatters = dataset["chatters"].any(STRIKES).transpose(..., *wall)
    asked = dataset[wall[1]]
    if wall[1] != "stiffness":
        asked = asked * dataset["inertia"] / dataset["period"] ** 2
    share = dataset["stiffness_in_force"] / asked
    lowered = _is_lowered(share, xr.ones_like(share))
    for labels, index in _conditions(dataset, [str(d) for d in chatters.dims if d not in wall]):
        map_chatters = chatters.isel(index).values
        stiffness = dataset[wall[1]].values
        # Up to the first wall that chatters, at the damping with the most walls before it.
        free = max(next((i for i, c in enumerate(row) if c), len(row)) for row in map_chatters)
        energy_out = dataset["energy_out"].isel(index).max().item()
        yield labels | {
            "walls": str(map_chatters.size),
            "free": str(int((~map_chatters).sum())),
            f"free up to\n{LABELS[wall[1]]}": f"{stiffness[free - 1]:.3g}" if free else "none",
            **({"K in force\n÷ asked": _least(share.isel(index))} if lowered else {}),
            "energy out\n[mJ], at most": f"{energy_out * 1e3:.3g}",
        }


def _conditions(
    dataset: xr.Dataset, dims: Sequence[str]
) -> Iterator[tuple[dict[str, str], dict[str, int]]]:
    """Yield the labels that identify each condition, and its index on each axis."""
    for point in itertools.product(*(range(dataset.sizes[d]) for d in dims)):
        index = dict(zip(dims, point, strict=True))
        labels = {}
        for name, i in index.items():
            if dataset.sizes[name] > 1 or name == "law":
                value = dataset[name].values[i]
                labels[name] = value_text(value)
        yield labels, index
