"""The result of a sweep as one xarray Dataset, from which every figure can be drawn again."""

import functools
import importlib.metadata
import json
import platform
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from canwall.analysis.strike import DESCRIBED
from canwall.run.closed_loop import known_scales, loop_delay
from canwall.sweep.axes import NAMED
from canwall.sweep.plan import Plan
from canwall.units import DriveUnits

_LIMITS = {
    "limit": ("N*m/rad", "K-limit of this strike alone"),
    "open_ended": ("1", "no chatter up to the end of the search: the limit is that end"),
    "worst": ("N*m/rad", "K-limit: free of chatter at all speeds and phases"),
}
#: What holds under a condition: the numbers that analytic limits need.
_CIRCUMSTANCES = {
    "inertia": ("kg*m^2", "of what really moves"),
    "viscous": ("N*m*s/rad", "damping of what really moves"),
    "device_viscous": ("N*m*s/rad", "damping of the drive and the handle alone"),
    "coulomb": ("N*m", "Coulomb friction"),
    "period": ("s", "T"),
    "loop_delay": ("1", "D in cycles"),
    "count": ("rad", "one encoder count"),
    "force_step": ("N*m", "one step of torque"),
    "model_inertia": ("kg*m^2", "inertia that the laws' model knows"),
}
_PACKAGES = ("canwall", "numpy", "scipy", "numba", "xarray")


@functools.cache
def versions() -> dict[str, str]:
    """Of what has made the numbers."""
    found = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return found | {"python": platform.python_version()}


def described(plan: Plan) -> str:
    """All that decides the numbers of a sweep, as JSON."""
    return json.dumps(
        {
            "axes": [[axis.name, *axis.values] for axis in plan.axes],
            "through": plan.through,
            "configuration": plan.base.to_toml(),
            "versions": versions(),
        }
    )


def gathered(plan: Plan, pieces: Mapping[int, NDArray[np.void]]) -> xr.Dataset:
    """Dataset of all pieces, one dimension per axis, units in attributes."""
    searched = plan.stiffness is None
    walls = len(plan.damping.values) if searched else len(plan.walls)
    table = np.zeros((len(plan.points), walls, len(plan.strikes)), plan.dtype)
    for number in range(plan.pieces):
        condition, strikes, chosen = plan.where(number)
        found = pieces[number].reshape(strikes.stop - strikes.start, -1)
        table[condition, chosen, strikes] = found.T
    table = table.reshape(plan.shape)
    names = tuple(axis.name for axis in plan.axes)
    data: dict[str, Any] = {}
    for name, (unit, what) in (_LIMITS | DESCRIBED).items():
        if name not in (plan.dtype.names or ()):
            continue
        # The worst is that of all strikes.
        over = names[:-2] if name == "worst" else names
        values = table[name][..., 0, 0] if name == "worst" else table[name]
        data[name] = (over, np.ascontiguousarray(values), {"units": unit, "long_name": what})
    conditions = names[: len(plan.conditions)]
    known = [_circumstances(plan, point) for point in plan.points]
    shape = plan.shape[: len(conditions)]
    for i, (name, (unit, what)) in enumerate(_CIRCUMSTANCES.items()):
        values = np.array([k[i] for k in known]).reshape(shape)
        data[name] = (conditions, values, {"units": unit, "long_name": what})
    if searched:
        unit_of = data["inertia"][1] / data["period"][1] ** 2
        data["worst_normalised"] = (
            names[:-2],
            data["worst"][1] / unit_of[..., None],
            {"units": "1", "long_name": "K-limit as K*T^2/m, m what really moves"},
        )
    coordinates = {
        axis.name: (
            axis.name,
            np.array(axis.values),
            {"units": axis.unit, "long_name": NAMED.get(axis.name, ("", axis.name))[1]},
        )
        for axis in plan.axes
    }
    return xr.Dataset(
        data,
        coordinates,
        {
            "title": "K-limits" if searched else "Stiffness sweep",
            "configuration": plan.base.to_toml(),
            "versions": json.dumps(versions()),
            "through": plan.through,
        },
    )


def _circumstances(plan: Plan, point: Mapping[str, Any]) -> tuple[float, ...]:
    settings = plan.settings(point, plan.strikes[0])
    simulation = settings.simulation
    assert simulation is not None
    hand, scales = simulation.hand, known_scales(settings)
    units = DriveUnits.behind_gear(
        scales.counts_per_rev / scales.gear_ratio,
        scales.rated_torque_mnm / 1000.0,
        scales.gear_ratio,
    )
    return (
        simulation.inertia_kg_m2 + hand.inertia_kg_m2,
        simulation.viscous_nm_s_per_rad + hand.damping_nm_s_per_rad,
        simulation.viscous_nm_s_per_rad,
        simulation.coulomb_nm,
        settings.bus.cycle_s,
        loop_delay(settings),
        units.rad_per_count,
        units.nm_per_mille,
        settings.mechanics.inertia_kg_m2,
    )
