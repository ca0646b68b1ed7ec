"""Plan of a sweep, divided into pieces of work that each depend on their number alone."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from canwall.analysis.k_limit import K_LIMIT, k_limits
from canwall.analysis.strike import MEASURES
from canwall.config import Settings
from canwall.cycle import named_law
from canwall.errors import InputError, RunFailedError
from canwall.supervised import Call
from canwall.sweep.axes import (
    DAMPING,
    DEFAULTS,
    INSTEAD,
    STIFFNESS,
    STRIKES,
    SweepAxis,
    Value,
    parse_axis,
    settings_at,
)
from canwall.sweep.strike import PreparedStrike, StrikeMotion

_T = TypeVar("_T")

#: Number of a piece of work, and its result as `compute_piece` returns it.
PieceResult = tuple[int, NDArray[np.void]]
#: Walls of a map in one piece of work, for which the strike is prepared once; by frames, which take
#: some 300 times as long. What Ctrl-C keeps are whole pieces.
_PIECE, _PIECE_BY_FRAMES = 120, 4
#: Processor time in a single evaluation after which a law counts as one that does not return [s].
_LAW_S = 0.5
#: The largest result: some 2 GB.
_MOST_POINTS = 10_000_000


@dataclass(frozen=True)
class Plan:
    """A sweep: the configuration and its axes.

    Attributes:
        base: Configuration that the axes change.
        conditions: Axes other than those below, the law first.
        stiffness: Stiffness axis of a map; None: the K-limits are searched.
        damping: Damping axis.
        speed: Approach speeds of the hand.
        phase: Phases of the contact relative to the SYNC.
        through: "sim": strikes in memory; "bus": by frames.
    """

    base: Settings
    conditions: tuple[SweepAxis, ...]
    stiffness: SweepAxis | None
    damping: SweepAxis
    speed: SweepAxis
    phase: SweepAxis
    through: str = "sim"

    @property
    def axes(self) -> list[SweepAxis]:
        """All axes, in the order of the result's dimensions."""
        wall = [self.damping] if self.stiffness is None else [self.damping, self.stiffness]
        return [*self.conditions, *wall, self.speed, self.phase]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the result, i.e. the number of values on each axis."""
        return tuple(len(axis.values) for axis in self.axes)

    @property
    def point_count(self) -> int:
        """Number of points of the result, each a strike with its wall."""
        return math.prod(self.shape)

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Dtype of the result, MEASURES for a map and K_LIMIT for a search."""
        return MEASURES if self.stiffness is not None else K_LIMIT

    @cached_property
    def points(self) -> list[dict[str, Value]]:
        """Points of the condition axes, in order."""
        names = [axis.name for axis in self.conditions]
        values = (axis.values for axis in self.conditions)
        return [dict(zip(names, chosen, strict=True)) for chosen in itertools.product(*values)]

    @property
    def strikes(self) -> list[dict[str, Value]]:
        """Points of the strike axes, speed and phase, in order."""
        chosen = itertools.product(self.speed.values, self.phase.values)
        return [{"speed": speed, "phase": phase} for speed, phase in chosen]

    @property
    def walls(self) -> list[tuple[Value, Value]]:
        """Damping and stiffness of a map's points, in order."""
        assert self.stiffness is not None
        return list(itertools.product(self.damping.values, self.stiffness.values))

    @property
    def _per_strike(self) -> int:
        return math.ceil(len(self.walls) / self._per_piece)

    @property
    def _per_piece(self) -> int:
        return _PIECE_BY_FRAMES if self.through == "bus" else _PIECE

    @property
    def pieces(self) -> int:
        """Number of pieces of work."""
        if self.stiffness is None:
            return len(self.points) * len(self.damping.values)
        return len(self.points) * len(self.strikes) * self._per_strike

    def slices(self, piece: int) -> tuple[int, slice, slice]:
        """Return what a piece computes: condition, strikes, and walls (dampings in a search)."""
        if self.stiffness is None:
            condition, damping = divmod(piece, len(self.damping.values))
            return condition, slice(0, len(self.strikes)), slice(damping, damping + 1)
        rest, part = divmod(piece, self._per_strike)
        condition, strike = divmod(rest, len(self.strikes))
        first = part * self._per_piece
        walls = slice(first, min(first + self._per_piece, len(self.walls)))
        return condition, slice(strike, strike + 1), walls

    def settings(self, point: Mapping[str, Value], strike: Mapping[str, Value]) -> Settings:
        """Return the settings of one strike. Raises ConfigError."""
        return settings_at(self.base, {**point, **strike})

    def prepare(self, point: Mapping[str, Value], strike: Mapping[str, Value]) -> PreparedStrike:
        """Prepare one strike. Raises ConfigError, or InputError if it cannot be by frames."""
        (still,) = DEFAULTS["sync_jitter"]
        jitter = float(point.get("sync_jitter", still))
        return PreparedStrike(self.settings(point, strike), self.through, jitter)


def make_plan(base: Settings, given: Mapping[str, object], through: str = "sim") -> Plan:
    """Make a plan from the axes in `[sweep]` and those given, which take precedence.

    Args:
        base: Configuration with `[simulation]`.
        given: Values of axes by name, as `parse_axis` takes them.
        through: "sim": strikes in memory; "bus": by frames.

    Raises:
        InputError: For an axis that does not exist or has an impossible value.
        ConfigError: Likewise, for a key of the configuration.
    """
    if base.simulation is None:
        raise InputError("[simulation] is missing: there is no drive to simulate")
    if through not in ("sim", "bus"):
        raise InputError(f"--through {through}: has to be sim or bus")
    axes = {name: parse_axis(name, v) for name, v in {**base.sweep, **given}.items()}
    # A stiffness or a damping has two forms; one that is given replaces either in the file.
    for pair in (STIFFNESS, DAMPING):
        both = [name for name in pair if name in axes]
        if len(both) == 2 and all(name in given for name in both):
            raise InputError(f"sweep axes {both[0]} and {both[1]}: keep one of them")
        if len(both) == 2:
            axes = {n: a for n, a in axes.items() if n not in both or n in given}
    for key, instead in INSTEAD.items():
        if key in axes:
            do = f"use {instead} instead" if instead else "it changes nothing; leave it out"
            raise InputError(f"sweep axis {key}: {do}")
    defaults: dict[str, Any] = {"law": (named_law(base),)}
    defaults |= {name: DEFAULTS[name] for name in STRIKES}
    given_damping = next((axes[name] for name in DAMPING if name in axes), None)
    if given_damping is None:
        defaults["damping"] = (base.wall.damping_nm_s_per_rad,)
    axes = {n: SweepAxis(n, tuple(v)) for n, v in defaults.items() if n not in axes} | axes

    def pop(names: Sequence[str]) -> SweepAxis | None:
        axis = next((axes.pop(name) for name in names if name in axes), None)
        # Tables and figures take the walls as they rise.
        return axis and SweepAxis(axis.name, tuple(sorted(axis.values, key=float)))

    stiffness, damping = pop(STIFFNESS), pop(DAMPING)
    speed, phase = axes.pop("speed"), axes.pop("phase")
    assert damping is not None
    ratio = axes.get("wall.damping_ratio")
    if ratio is not None and any(ratio.values) and any(damping.values):
        raise InputError(f"sweep axes {damping.name} and {ratio.name}: keep one of them")
    base = _without_what_is_swept(base, stiffness, given_damping)
    law = axes.pop("law")
    plan = Plan(base, (law, *axes.values()), stiffness, damping, speed, phase, through)
    if plan.point_count > _MOST_POINTS:
        raise InputError(f"sweep axes: {plan.point_count} points; {_MOST_POINTS} at most")
    _check_values(plan)
    return plan


def _without_what_is_swept(
    base: Settings, stiffness: SweepAxis | None, damping: SweepAxis | None
) -> Settings:
    """Return the settings without what would take the place of the swept values.

    That is a damping ratio where dampings are given, be it a single 0, and a cap where the largest
    stiffness is searched.
    """
    update: dict[str, float] = {}
    if damping is not None:
        update["damping_ratio"] = 0.0
    if stiffness is None:
        update["cap"] = 0.0
    return base.model_copy(update={"wall": base.wall.model_copy(update=update)})


def _check_values(plan: Plan) -> None:
    """Prepare a strike for each value of each axis, with the first value of the others."""
    first, strike = plan.points[0], plan.strikes[0]
    plan.prepare(first, strike)
    for axis in plan.conditions:
        for value in axis.values[1:]:
            plan.prepare({**first, axis.name: value}, strike)
    for other in plan.strikes[1:]:
        plan.settings(first, other)


def compute_piece(
    plan: Plan, piece: int, is_abandoned: Callable[[], bool] = lambda: False
) -> NDArray[np.void]:
    """Compute a piece of work; shape (strikes, walls), dtype of the plan.

    Raises RunFailedError if a law does not return, and CancelledError once nobody waits for the
    piece; the thread that computes it is left behind.
    """
    condition, strikes, walls = plan.slices(piece)
    point, chosen = plan.points[condition], plan.strikes[strikes]
    prepared = [plan.prepare(point, strike) for strike in chosen]
    return _supervised(
        lambda: _strike(plan, prepared, walls), prepared, point, chosen, is_abandoned
    )


def repeat_strike(
    plan: Plan, indices: Mapping[str, int], stiffness: float | None = None
) -> tuple[float, float, StrikeMotion]:
    """Simulate the strike of one point again, in memory.

    Args:
        plan: The sweep.
        indices: Index of the point on each axis.
        stiffness: Stiffness of the wall where no axis has it, in a search [N·m/rad].

    Returns:
        Stiffness [N·m/rad] and damping [N·m·s/rad] of the wall, and the strike.

    Raises:
        ConfigError: If the configuration cannot be used here, for example for its dictionary.
        RunFailedError: If the law does not return.
    """
    values = {axis.name: axis.values[indices[axis.name]] for axis in plan.axes}
    point = {axis.name: values[axis.name] for axis in plan.conditions}
    strike = {name: values[name] for name in STRIKES}
    prepared = plan.prepare(point, strike)
    stiffness_unit, damping_unit = _wall_units(plan, prepared)
    damping = float(values[plan.damping.name]) * damping_unit
    if stiffness is None:
        assert plan.stiffness is not None
        stiffness = float(values[plan.stiffness.name]) * stiffness_unit
    wall = stiffness, damping
    motion = _supervised(lambda: prepared.motion(*wall), [prepared], point, [strike])
    return *wall, motion


def _supervised(
    compute: Callable[[], _T],
    prepared: Sequence[PreparedStrike],
    point: Mapping[str, Value],
    strikes: Sequence[Mapping[str, Value]],
    is_abandoned: Callable[[], bool] = lambda: False,
) -> _T:
    """Return what a computation with these strikes does.

    Raises RunFailedError if a law does not return, and CancelledError once it is abandoned; the
    thread that computes is left behind.
    """
    computed: list[_T] = []
    call = Call(
        lambda: computed.append(compute()),
        lambda: [(strike.progress, strike.evaluating) for strike in prepared],
    )
    while not call.has_ended():
        if is_abandoned():
            call.give_up()
            raise CancelledError
        if call.computed_s < _LAW_S:
            continue
        # What was computed before an evaluation, as code that was compiled, is no law's.
        for (_, evaluating), at in zip(call.seen, strikes, strict=True):
            if evaluating:
                call.give_up()
                text = f"{evaluating} has not returned for {call.computed_s:.2g} s"
                raise RunFailedError(_at({**point, **at}, text))
    if isinstance(call.error, RunFailedError):
        raise RunFailedError(_at(point, str(call.error)))
    if call.error is not None:
        raise call.error
    return computed[0]


def _at(point: Mapping[str, Value], text: str) -> str:
    """Return the text of an error at a point; its law is in the text."""
    return ", ".join([*(f"{name} {value}" for name, value in point.items() if name != "law"), text])


def _wall_units(plan: Plan, prepared: PreparedStrike) -> tuple[float, float]:
    """Return stiffness [N·m/rad] and damping [N·m·s/rad] of a 1 on their axes."""
    mass, period = prepared.mass, prepared.period
    normalised = plan.stiffness is not None and plan.stiffness.name == "stiffness_normalised"
    stiffness_unit = mass / period**2 if normalised else 1.0
    return stiffness_unit, mass / period if plan.damping.name == "damping_normalised" else 1.0


def _strike(plan: Plan, prepared: Sequence[PreparedStrike], walls: slice) -> NDArray[np.void]:
    stiffness_unit, damping_unit = _wall_units(plan, prepared[0])
    if plan.stiffness is None:
        (damping,) = plan.damping.values[walls]
        return k_limits(prepared, float(damping) * damping_unit)[:, None]
    chosen = [(float(k) * stiffness_unit, float(b) * damping_unit) for b, k in plan.walls[walls]]
    return prepared[0].on_all(np.array(chosen))[None, :]
