"""Result of a sweep as an xarray Dataset with everything its figures need, and its NetCDF file."""

import functools
import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from canwall.analysis.strike import MEASURE_DESCRIPTIONS
from canwall.config import parse
from canwall.errors import InputError
from canwall.run.closed_loop import loop_delay, simulated_units
from canwall.sweep.axes import DAMPING, NAMED, STIFFNESS, STRIKES, SweepAxis
from canwall.sweep.plan import Plan

#: (unit, description) of what a search finds besides MEASURES.
_LIMIT_DESCRIPTIONS = {
    "limit": ("N*m/rad", "K-limit of this strike alone"),
    "open_ended": ("1", "no chatter up to the end of the scan: the limit is that end"),
    "worst": ("N*m/rad", "K-limit: no wall of the scan up to it chatters, at any speed and phase"),
}
#: (unit, description) of the parameters at each condition, for the analytic limits.
_PARAMETER_DESCRIPTIONS = {
    "inertia": ("kg*m^2", "inertia of drive, handle and hand together"),
    "viscous": ("N*m*s/rad", "damping of drive, handle and hand together"),
    "device_viscous": ("N*m*s/rad", "damping of drive and handle alone"),
    "coulomb": ("N*m", "Coulomb friction"),
    "period": ("s", "T"),
    "loop_delay": ("1", "D in cycles"),
    "count": ("rad", "one encoder count"),
    "force_step": ("N*m", "one step of torque"),
    "model_inertia": ("kg*m^2", "inertia in the laws' model"),
}
#: Packages whose versions may change the numbers.
_PACKAGES = ("canwall", "numpy", "scipy", "numba", "xarray")

_NETCDF_ENGINE: Literal["h5netcdf"] = "h5netcdf"


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that the numbers depend on."""
    found = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return found | {"python": platform.python_version()}


def plan_json(plan: Plan) -> str:
    """Return everything that the numbers of a sweep depend on, as JSON."""
    return json.dumps(
        {
            "axes": [[axis.name, *axis.values] for axis in plan.axes],
            "through": plan.through,
            "configuration": plan.base.to_toml(),
            "files": digests(plan),
            "versions": versions(),
        }
    )


def digests(plan: Plan) -> dict[str, str]:
    """Return the digests of the files that plan and configuration name: laws and dictionary."""
    named = [str(plan.base.drive.eds), plan.base.wall.law]
    named += [value for axis in plan.axes for value in axis.values if isinstance(value, str)]
    paths = {path for name in named if (path := Path(name.rpartition(":")[0] or name)).is_file()}
    return {str(path): digest(str(path)) for path in sorted(paths)}


def digest(path: str) -> str:
    """Return the SHA-256 of a file. Raises OSError."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def assemble_dataset(plan: Plan, pieces: Mapping[int, NDArray[np.void]]) -> xr.Dataset:
    """Assemble the Dataset from all pieces of work, with a dimension per axis.

    Units and descriptions are in the attributes `units` and `long_name`.
    """
    searched = plan.stiffness is None
    walls = len(plan.damping.values) if searched else len(plan.walls)
    table = np.zeros((len(plan.points), walls, len(plan.strikes)), plan.dtype)
    for number in range(plan.pieces):
        condition, strikes, chosen = plan.slices(number)
        found = pieces[number].reshape(strikes.stop - strikes.start, -1)
        table[condition, chosen, strikes] = found.T
    table = table.reshape(plan.shape)
    names = tuple(axis.name for axis in plan.axes)
    data: dict[str, Any] = {}
    for name, (unit, description) in (_LIMIT_DESCRIPTIONS | MEASURE_DESCRIPTIONS).items():
        if name not in (plan.dtype.names or ()):
            continue
        # The worst is that of all strikes: it has no dimension for their speed and phase.
        dims = names[:-2] if name == "worst" else names
        values = table[name][..., 0, 0] if name == "worst" else table[name]
        attributes = {"units": unit, "long_name": description}
        data[name] = (dims, np.ascontiguousarray(values), attributes)
    conditions = names[: len(plan.conditions)]
    parameters = [_parameters(plan, point) for point in plan.points]
    shape = plan.shape[: len(conditions)]
    for i, (name, (unit, description)) in enumerate(_PARAMETER_DESCRIPTIONS.items()):
        values = np.array([of_point[i] for of_point in parameters]).reshape(shape)
        data[name] = (conditions, values, {"units": unit, "long_name": description})
    if searched:
        unit_of = data["inertia"][1] / data["period"][1] ** 2
        data["worst_normalised"] = (
            names[:-2],
            data["worst"][1] / unit_of[..., None],
            {"units": "1", "long_name": "K-limit as K*T^2/m, m of drive, handle and hand"},
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


def check_name(output: Path) -> None:
    """Raise InputError for a name by which nobody would know the result as that of a sweep."""
    if output.suffix != ".nc":
        raise InputError(f"{output}: has to end in .nc, by which the result of a sweep is known")


def write_sweep(dataset: xr.Dataset, output: Path) -> None:
    """Write the Dataset as NetCDF, completely or not at all. Raises InputError."""
    new = output.with_name(output.name + ".new")
    try:
        dataset.to_netcdf(new, engine=_NETCDF_ENGINE)
        new.replace(output)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise InputError(f"{output}: cannot be written: {error.strerror or error}") from None


def read_sweep(path: Path) -> xr.Dataset:
    """Read the result of a sweep. Raises InputError if the file is not one."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the result of a sweep")
    try:
        with xr.open_dataset(path, engine=_NETCDF_ENGINE) as stored:
            dataset = stored.load()
    except (OSError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: not the result of a sweep: {reason}") from None
    if "configuration" not in dataset.attrs or "through" not in dataset.attrs:
        raise InputError(f"{path}: not the result of a sweep")
    return dataset


def plan_of(dataset: xr.Dataset) -> Plan:
    """Return the plan of a sweep from its result.

    Raises:
        InputError: If the result lacks what a sweep writes.
        ConfigError: If this version cannot read its configuration.
    """
    base = parse(dataset.attrs["configuration"], Path("configuration of the sweep"))
    found = dataset.get("limit", dataset.get("chatters"))
    axes = [] if found is None else [str(name) for name in found.dims]
    known = [next((n for n in axes if n in pair), None) for pair in (STIFFNESS, DAMPING)]
    if found is None or known[1] is None or not set(STRIKES) <= set(axes):
        raise InputError("not the result of a sweep: lacks its axes")

    def axis(name: str) -> SweepAxis:
        return SweepAxis(name, tuple(dataset[name].values.tolist()))

    conditions = tuple(axis(n) for n in axes if n not in (*STRIKES, *known))
    stiffness = known[0] and axis(known[0])
    speed, phase = (axis(name) for name in STRIKES)
    through = str(dataset.attrs["through"])
    return Plan(base, conditions, stiffness or None, axis(known[1]), speed, phase, through)


def _parameters(plan: Plan, point: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the values of _PARAMETER_DESCRIPTIONS at one condition."""
    settings = plan.settings(point, plan.strikes[0])
    simulation = settings.simulation
    assert simulation is not None
    hand, units = simulation.hand, simulated_units(settings)
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
