"""Tables of what laws reach on a servo in unknown hands: plans with fixed axes, and Markdown.

There is one configuration for all operators. Laws with a model know the drive and the delay of its
loop; `[operator]` says if they find the operator, `[wall]` which damping ratio their referent has.
Laws that use the sampled position alone have none of that.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from scipy.stats import qmc

from canwall.config import Settings
from canwall.cycle import named_law
from canwall.errors import InputError, did_you_mean
from canwall.sweep.axes import STRIKES, SweepAxis
from canwall.sweep.dataset import assemble_dataset
from canwall.sweep.plan import Plan, make_plan
from canwall.sweep.strike import OPERATORS, SERVOS
from canwall.sweep.workers import compute_pieces
from canwall.walls import LAWS

#: Laws with a damper: a table has them at the damping B·T/m with the largest K-limit.
DAMPED = ("damped", "thresholded_damper", "unidirectional_damper", "offset_damper")
#: Laws that use the sampled position alone.
SAMPLED = tuple(name for name, law in LAWS.items() if law.sampled)
DAMPINGS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
#: A rigid stop has no stiffness to find a limit of.
_WITH_STIFFNESS = tuple(name for name in LAWS if name != "rigid")

#: Conditions of the tables: friction [N·m], error of the laws' delay [periods].
FRICTIONS = (0.0, 0.02)
DELAY_ERRORS = (-0.3, 0.0, 0.15)
_FRICTION = 0.01
#: Strikes: mean speeds of approach [rad/s] of the hand's rest position; at the wall they are up to
#: 1.9 times as high, and nobody's handle, which only the press moves, comes with up to 8 rad/s.
#: Phases against the SYNC, and time of the press [s], in which slow estimates of force settle too.
_SPEEDS, _PHASES = (0.3, 0.8, 2.0), (0.0, 0.35, 0.7)
_PRESS_S = 1.2
#: With the cap: c, and the strikes that are drawn, each for all conditions: their number, and the
#: ranges of the wall that is asked for [N·m/rad] and of the mean speed [rad/s]. Walls above the cap
#: are one wall: strikes that differ in nothing else fail together, and tell little.
CAPS = (0.5, 0.8, 1.0)
DRAWS = 144
_ASKED, _DRAWN_SPEEDS = (30.0, 5000.0), (0.2, 2.0)


def _drive_cycle(cycle_s: float) -> dict[str, Sequence[float | str]]:
    """Return the axes of a drive with this cycle of its own, which is known."""
    return {"simulation.drive_cycle_s": (cycle_s,), "drive.drive_cycle_s": (cycle_s,)}


#: Other benches: what is different, by axes, and the strikes that are drawn.
BENCHES: dict[str, dict[str, Sequence[float | str]]] = {
    "as above": {},
    "torque on reception, $D = 0.4$": {"delay": (0.4,)},
    "two cycles to the torque, $D = 2$": {"delay": (2.0,)},
    "drive cycle of 0.45 ms": _drive_cycle(0.00045),
    "drive cycle of 0.6 ms": _drive_cycle(0.0006),
    "10 000 counts": {"counts": (10_000,)},
    "32 768 counts (15 bits)": {"counts": (32_768,)},
    "1 048 576 counts (20 bits)": {"counts": (1_048_576,)},
    "500 Hz": {"rate": (500.0,)},
    "2 kHz": {"rate": (2000.0,)},
    "rotor a quarter as heavy": {"simulation.inertia_kg_m2": (2.5e-5,)},
    "rotor four times as heavy": {"simulation.inertia_kg_m2": (4e-4,)},
    "inertia configured 20 % too small": {"model_error": (-0.2,)},
    "inertia configured 20 % too large": {"model_error": (0.2,)},
    "torque constant 10 % less": {"simulation.torque_constant_error": (-0.1,)},
    "torque constant 10 % more": {"simulation.torque_constant_error": (0.1,)},
    "torque constant 20 % more": {"simulation.torque_constant_error": (0.2,)},
    "inertia 20 % too large, `lightest_kg_m2` 0.8 of it": {
        "model_error": (0.2,),
        "operator.lightest_kg_m2": (0.96e-4,),
    },
    "torque constant 20 % more, `lightest_kg_m2` 0.8 of the inertia": {
        "simulation.torque_constant_error": (0.2,),
        "operator.lightest_kg_m2": (0.8e-4,),
    },
    "stiction twice the Coulomb friction": {"breakaway": (2.0,)},
    "elastic shaft, 600 Hz": {"simulation.shaft_hz": (600.0,)},
    "elastic shaft, 400 Hz": {"simulation.shaft_hz": (400.0,)},
    "elastic shaft, 250 Hz": {"simulation.shaft_hz": (250.0,)},
}
_BENCH_DRAWS = 24
#: First strikes: the wall [N·m/rad] and its caps, the speeds of approach [rad/s], and the phases.
_FIRST_STIFFNESS = 200.0
_FIRST_CAPS = (0.0, 0.8)
_FIRST_SPEEDS = (0.3, 0.5, 0.7, 1.0)
_FIRST_PHASES = tuple(round(n / 6.0, 3) for n in range(6))
#: Resonances of the shafts [Hz].
_SHAFTS = (400.0, 250.0)

_DRAWN = ("stiffness", "speed", "phase")
_LIMITS = ("worst", "worst_normalised", "open_ended")


@dataclass(frozen=True)
class LawTable:
    """One table.

    Attributes:
        title: Its title.
        laws: Its laws unless others are asked for; empty: that of the configuration.
        axes: Axes besides those of every table, by name.
        searches: True if its cells are K-limits.
        capped: True if `wall.cap` stays in force.
        write: Writes the result as Markdown, line by line.
        draws: Number of strikes with stiffness, speed and phase drawn at random; 0: those of the
            axes.
        benches: Axes with one value that make other benches, by name; with draws only.
    """

    title: str
    laws: tuple[str, ...]
    axes: dict[str, Sequence[float | str]]
    searches: bool
    capped: bool
    write: Callable[[xr.Dataset], Iterator[str]]
    draws: int = 0
    benches: Mapping[str, dict[str, Sequence[float | str]]] = field(default_factory=dict)


def compute_law_table(
    name: str,
    base: Settings,
    laws: Sequence[str] = (),
    operators: Sequence[str] = tuple(OPERATORS),
    through: str = "sim",
    workers: int | None = None,
    dask: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> xr.Dataset:
    """Compute a table.

    Args:
        name: Name in LAW_TABLES.
        base: Configuration of drive and wall; the table has its own axes, `[sweep]` is ignored.
        laws: Names of the laws; without: those of the table. Where the table searches K-limits,
            "standard" and "damped" are added, for comparison.
        operators: Names of OPERATORS.
        through: As for `make_plan`.
        workers: As for `sweep`.
        dask: As for `sweep`.
        progress: Called with the pieces of work done and their total.

    Returns:
        The measures that the table shows, with a dimension per axis, or in place of stiffness,
        speed and phase the dimension `strike`; of several benches, with the dimension `bench`.
        K-limits are at the best of DAMPINGS, which is the coordinate `damping_normalised`.

    Raises:
        InputError: For a table, a law or an operator that does not exist.
    """
    if name not in LAW_TABLES:
        hint = did_you_mean(name, LAW_TABLES)
        raise InputError(f"--table {name}: has to be one of {', '.join(LAW_TABLES)}{hint}")
    table = LAW_TABLES[name]
    base = base.model_copy(update={"sweep": {}})
    chosen = list(laws or table.laws or (named_law(base),))
    if table.searches:
        chosen = list(dict.fromkeys(["standard", "damped", *chosen]))
    plans = _make_plans(table, base, chosen, operators, through)
    done, total = 0, sum(plan.pieces for plan in plans)
    found = []
    for plan in plans:
        pieces = {}
        progress(done, total)
        for number, piece in compute_pieces(plan, range(plan.pieces), workers, dask):
            pieces[number] = piece
            done += 1
            progress(done, total)
        dataset = assemble_dataset(plan, pieces)
        found.append(_limits_of(dataset, table) if table.searches else dataset)
    joined = found[0]
    if table.searches:
        joined = xr.concat(found, "law", join="outer").sel(law=chosen)
    elif table.draws:
        benches = [
            xr.concat([each.squeeze(_DRAWN) for each in found[i : i + table.draws]], "strike")
            for i in range(0, len(found), table.draws)
        ]
        joined = _joined_benches(table, benches) if table.benches else benches[0]
    return joined.assign_attrs(found[0].attrs | {"title": table.title, "table": name})


def format_law_table(dataset: xr.Dataset) -> str:
    """Format the result of `compute_law_table` as Markdown."""
    return "\n".join(LAW_TABLES[dataset.attrs["table"]].write(dataset))


def _make_plans(
    table: LawTable, base: Settings, laws: Sequence[str], operators: Sequence[str], through: str
) -> list[Plan]:
    """Return a plan for the laws with a model, for the sampled ones, and for those with a damper.

    The last two know nothing of the delay, nor of the operator.
    """
    shared: dict[str, Sequence[float | str]] = {
        "operator": operators,
        "model": ["drive"],
        "speed": _SPEEDS,
        "phase": _PHASES,
        "press": [_PRESS_S],
        **table.axes,
    }
    if not table.capped:
        base = base.model_copy(update={"wall": base.wall.model_copy(update={"cap": 0.0})})
    if table.draws:
        strikes = list(drawn_strikes(table.draws))
        plans = []
        for bench in table.benches.values() or [{}]:
            # Checked once: the conditions of all its strikes are the same.
            plan = make_plan(base, {"law": laws, **shared, **bench, **strikes[0]}, through)
            plans += [_struck_otherwise(plan, strike) for strike in strikes]
        return plans
    if not table.searches:
        return [make_plan(base, {"law": laws, **shared}, through)]
    plain = {"damping_ratio": 0.0, "damping_nm_s_per_rad": 0.0}
    unknowing = base.model_copy(
        update={
            "wall": base.wall.model_copy(update=plain),
            "operator": base.operator.model_copy(update={"adapt": False}),
        }
    )
    once = shared | ({"delay_error": [0.0]} if "delay_error" in shared else {})
    plans = []
    for settings, axes, dampings, some in (
        (base, shared, None, [law for law in laws if law not in SAMPLED]),
        (unknowing, once, (0.0,), [law for law in laws if law in SAMPLED and law not in DAMPED]),
        (unknowing, once, DAMPINGS, [law for law in laws if law in DAMPED]),
    ):
        if some:
            given = {} if dampings is None else {"damping_normalised": dampings}
            plan = make_plan(settings, {"law": some, **given, **axes}, through)
            if dampings is None:  # the damping ratio stays in force
                plan = replace(plan, damping=SweepAxis("damping_normalised", (0.0,)))
            plans.append(plan)
    return plans


def _struck_otherwise(plan: Plan, strike: Mapping[str, float]) -> Plan:
    axes = {name: SweepAxis(name, (strike[name],)) for name in _DRAWN}
    return replace(plan, stiffness=axes["stiffness"], speed=axes["speed"], phase=axes["phase"])


def _joined_benches(table: LawTable, found: Sequence[xr.Dataset]) -> xr.Dataset:
    alike = [
        each.squeeze(list(axes), drop=True)
        for each, axes in zip(found, table.benches.values(), strict=True)
    ]
    return xr.concat(alike, "bench").assign_coords(bench=list(table.benches))


def drawn_strikes(count: int) -> Iterator[dict[str, float]]:
    """Yield strikes spread evenly over the ranges, always the same, as the axes _DRAWN."""
    low, high = np.log(np.transpose([_ASKED, _DRAWN_SPEEDS]))
    for *of_range, phase in qmc.Halton(3, seed=1).random(count).tolist():
        stiffness, speed = np.exp(low + (high - low) * of_range).tolist()
        yield dict(zip(_DRAWN, (stiffness, speed, phase), strict=True))


def _limits_of(dataset: xr.Dataset, table: LawTable) -> xr.Dataset:
    """Return the K-limits at the best damping, over all axes of the table."""
    limits = dataset[list(_LIMITS)].assign(open_ended=dataset["open_ended"].all(STRIKES))
    limits = limits.drop_vars([*STRIKES], errors="ignore").squeeze(("model", "press"), drop=True)
    best = limits["worst_normalised"].argmax("damping_normalised")
    limits = limits.isel(damping_normalised=best)
    errors = table.axes.get("delay_error", ())
    if errors and limits.sizes["delay_error"] < len(errors):
        limits = limits.squeeze("delay_error", drop=True)
        limits = limits.expand_dims(delay_error=list(errors)).copy()
    return limits


def _number(value: float) -> str:
    return f"{value:.3g}"


def _head(names: Sequence[str]) -> Iterator[str]:
    yield "| | " + " | ".join(names) + " |"
    yield "|---|" + "---|" * len(names)


def _row(name: str, cells: Sequence[str]) -> str:
    return f"| {name} | " + " | ".join(cells) + " |"


def _names(dataset: xr.Dataset, axis: str) -> list[str]:
    return [str(name) for name in dataset[axis].values]


def _limit(at: xr.Dataset) -> str:
    """Return K·T²/m and K, with the damping B·T/m of a law that has one."""
    least = "≥ " if at["open_ended"].item() else ""
    damping = at["damping_normalised"].item()
    with_damping = f" at {damping:g}" if damping > 0.0 else ""
    return (
        f"{least}**{_number(at['worst_normalised'].item())}**{with_damping}; "
        f"{_number(at['worst'].item())}"
    )


def _servo_name(name: str) -> str:
    servo = SERVOS[name]
    return f"{servo.current_bandwidth_hz:g} Hz + {1e3 * servo.drive_cycle_s:g} ms"


def format_worst(limits: xr.Dataset) -> str:
    """Format the worst K·T²/m of all conditions of the table "laws", as Markdown."""
    return "\n".join(_write_worst(limits))


def _write_worst(dataset: xr.Dataset) -> Iterator[str]:
    operators = _names(dataset, "operator")
    conditions = ("servo", "friction", "delay_error")
    normalised = dataset["worst_normalised"].min(conditions)
    stiffness = dataset["worst"].min(conditions)
    damped = normalised.sel(law="damped")
    yield from _head([*operators, "÷ damped"])
    for law in _names(dataset, "law"):
        cells = [
            f"**{_number(normalised.sel(law=law, operator=o).item())}**; "
            f"{_number(stiffness.sel(law=law, operator=o).item())}"
            for o in operators
        ]
        ratio = (normalised.sel(law=law) / damped.where(damped > 0.0)).min().item()
        yield _row(law, [*cells, "—" if np.isnan(ratio) else f"≥ {_number(ratio)}×"])


def _write_laws(dataset: xr.Dataset) -> Iterator[str]:
    """Yield the worst of all conditions, then a table per servo and friction."""
    operators, laws = _names(dataset, "operator"), _names(dataset, "law")
    normalised = dataset["worst_normalised"]
    yield "The worst of all servos, frictions and errors of the delay:"
    yield ""
    yield from _write_worst(dataset)
    for servo in _names(dataset, "servo"):
        for friction in dataset["friction"].values.tolist():
            yield ""
            yield f"{_servo_name(servo)}, friction {friction:g} N·m, delay known:"
            yield ""
            yield from _head(operators)
            there = dataset.sel(servo=servo, friction=friction)
            for law in laws:
                known = there.sel(law=law, delay_error=0.0)
                yield _row(law, [_limit(known.sel(operator=o)) for o in operators])
    errors = [e for e in dataset["delay_error"].values.tolist() if e != 0.0]
    of_model = [law for law in laws if law not in SAMPLED]
    for error in errors if of_model else []:
        yield ""
        yield f"Delay of the model off by {error:+g} T, K·T²/m, the worst of all frictions:"
        yield ""
        yield from _head(operators)
        off = normalised.sel(delay_error=error).min("friction")
        for law in of_model:
            for servo in _names(dataset, "servo"):
                found = [off.sel(law=law, servo=servo, operator=o) for o in operators]
                cells = [_number(value.item()) for value in found]
                yield _row(f"{law}, {_servo_name(servo)}", cells)


def _share_in_force(dataset: xr.Dataset) -> xr.DataArray:
    """Return the stiffness in force over min(K, m/T²)."""
    most = np.minimum(dataset["stiffness"], dataset["inertia"] / dataset["period"] ** 2)
    return dataset["stiffness_in_force"] / most


def _write_cap(dataset: xr.Dataset) -> Iterator[str]:
    """Yield failed strikes by criterion, and stiffness in force over min(K, m/T²), for each cap."""
    operators = _names(dataset, "operator")
    share = _share_in_force(dataset)
    yield from _head(operators)
    for law in _names(dataset, "law"):
        for cap in dataset["wall.cap"].values.tolist():
            some = {"law": law, "wall.cap": cap}
            for criterion, name in (
                ("chatters", f"{law}, cap {cap:g}: failed strikes"),
                ("chatters_ripple", "with a felt ripple"),
                ("chatters_amplitude", "with motion about the settled contact"),
                ("chatters_counts", "with more makes and breaks"),
                ("chatters_kick", "with a kick"),
            ):
                of_kind = dataset[criterion].sel(some)
                each = [of_kind.sel(operator=operator) for operator in operators]
                yield _row(name, [f"{int(these.sum())} of {these.size}" for these in each])
            ripple = dataset["settling_ripple"].sel(some)
            for name, quantile in (("median", 0.5), ("95 % of strikes", 0.95)):
                cells = [_quantile(ripple.sel(operator=o), quantile) for o in operators]
                yield _row(f"felt while it comes to rest [N], {name}", cells)
            for description, quantile in (("least", 0.0), ("median", 0.5)):
                each = [share.sel(some).sel(operator=o) for o in operators]
                name = f"{description} K in force ÷ min(K, m/T²)"
                yield _row(name, [_quantile(these, quantile) for these in each])
            for name, cells in _first_strike(dataset.sel(some)):
                yield _row(f"first strike: {name}", cells)


def _write_benches(dataset: xr.Dataset) -> Iterator[str]:
    """Yield failed strikes, and the median of the stiffness in force over min(K, m/T²)."""
    operators = _names(dataset, "operator")
    yield from _head([*operators, "failed", "of"])
    for name in _names(dataset, "bench"):
        bench = dataset.sel(bench=name)
        share = _share_in_force(bench)
        cells = []
        for operator in operators:
            failed = bench["chatters"].sel(operator=operator)
            median = _quantile(share.sel(operator=operator), 0.5)
            cells.append(f"{100.0 * failed.values.mean():.1f} %; {median}")
        everyone = bench["chatters"].values
        yield _row(name, [*cells, f"**{100.0 * everyone.mean():.1f} %**", str(everyone.size)])


def _write_first_strikes(dataset: xr.Dataset) -> Iterator[str]:
    """Yield depth and exit of the first strikes of each law, for each cap."""
    yield from _head(_names(dataset, "operator"))
    for law in _names(dataset, "law"):
        for cap in dataset["wall.cap"].values.tolist():
            with_cap = f"cap {cap:g}" if cap else "no cap"
            for name, cells in _first_strike(dataset.sel({"law": law, "wall.cap": cap})):
                yield _row(f"{law}, {with_cap}: {name}", cells)


def _first_strike(of_law: xr.Dataset) -> Iterator[tuple[str, list[str]]]:
    """Yield depth over the referent's, and the fastest exit over the speed of approach."""
    operators = _names(of_law, "operator")
    depth = of_law["first_depth"] / of_law["referent_first_depth"]
    for name, values, quantile in (
        ("deepest, 95 % of strikes", depth, 0.95),
        ("deepest", depth, 1.0),
        ("fastest exit", of_law["restitution"], 1.0),
    ):
        yield name, [_quantile(values.sel(operator=o), quantile) for o in operators]


def _quantile(values: xr.DataArray, quantile: float) -> str:
    known = values.values[np.isfinite(values.values)]
    return _number(float(np.quantile(known, quantile))) if known.size else "–"


def _write_shafts(dataset: xr.Dataset) -> Iterator[str]:
    """Yield the K-limits on each shaft."""
    operators = _names(dataset, "operator")
    for shaft in dataset["simulation.shaft_hz"].values.tolist():
        yield f"Shaft of {shaft:g} Hz:"
        yield ""
        yield from _head(operators)
        there = dataset.sel({"simulation.shaft_hz": shaft}).squeeze(("servo", "friction"))
        for law in _names(dataset, "law"):
            yield _row(law, [_limit(there.sel(law=law, operator=o)) for o in operators])
        yield ""


_SERVOS_AND_FRICTIONS: dict[str, Sequence[float | str]] = {
    "servo": tuple(SERVOS),
    "friction": FRICTIONS,
}
LAW_TABLES = {
    "laws": LawTable(
        "K-limits of the laws in unknown hands",
        _WITH_STIFFNESS,
        _SERVOS_AND_FRICTIONS | {"delay_error": DELAY_ERRORS},
        True,
        False,
        _write_laws,
    ),
    "cap": LawTable(
        "Walls with a cap in unknown hands",
        (),
        _SERVOS_AND_FRICTIONS | {"delay_error": DELAY_ERRORS, "wall.cap": CAPS},
        False,
        True,
        _write_cap,
        DRAWS,
    ),
    "bench": LawTable(
        "Walls with the configuration's cap on other benches",
        (),
        _SERVOS_AND_FRICTIONS | {"delay_error": DELAY_ERRORS},
        False,
        True,
        _write_benches,
        _BENCH_DRAWS,
        BENCHES,
    ),
    "first-strike": LawTable(
        "First strike of an unknown hand",
        (),
        _SERVOS_AND_FRICTIONS
        | {
            "wall.cap": _FIRST_CAPS,
            "stiffness": (_FIRST_STIFFNESS,),
            "speed": _FIRST_SPEEDS,
            "phase": _FIRST_PHASES,
        },
        False,
        True,
        _write_first_strikes,
    ),
    "shaft": LawTable(
        "K-limits on an elastic shaft",
        ("standard", "damped", "half_sample", "mean_force"),
        {"servo": ("1600Hz",), "friction": (_FRICTION,), "simulation.shaft_hz": _SHAFTS},
        True,
        False,
        _write_shafts,
    ),
}
