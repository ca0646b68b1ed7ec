"""Settings of a run: one TOML file, validated, immutable, in SI units.

Every key carries its unit in its name. What is unknown, misspelt, of the wrong type or impossible
is a `ConfigError` of one line: file, key, what is wrong, what to do.
"""

import difflib
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import tomli_w
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from canwall.errors import InputError


class ConfigError(InputError):
    """A configuration that cannot be used."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


# TOML writes a whole number without a point: `cycle_s = 1` is meant as 1.0.
def _number(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int):
        return value
    try:
        return float(value)
    except OverflowError:
        return math.inf


Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]


class Bus(_Section):
    """`[bus]`: where the drive is, and how long one period of the SYNC is."""

    interface: str = "virtual"
    channel: str = "canwall"
    bitrate: int = Field(1_000_000, gt=0)
    cycle_s: Annotated[Positive, Field(le=1.0)] = 0.001
    pace: Literal["auto", "real_time", "simulated"] = "auto"


class Drive(_Section):
    """`[drive]`: which node, described by which EDS or DCF."""

    node_id: int = Field(ge=1, le=127)
    eds: Path
    mode: Literal["auto", "cst"] = "auto"
    rated_torque_nm: Positive | None = None
    counts_per_rev: Positive | None = None
    gear_ratio: Positive | None = None
    wait_s: NonNegative = 5.0

    @field_validator("eds", mode="before")
    @classmethod
    def _path(cls, value: object) -> object:
        return Path(value) if isinstance(value, str) else value


class Mechanics(_Section):
    """`[mechanics]`: the model of everything that moves, as the laws use it."""

    inertia_kg_m2: Positive
    viscous_nm_s_per_rad: NonNegative = 0.0
    coulomb_nm: NonNegative = 0.0
    spring_nm_per_rad: NonNegative = 0.0
    handle_radius_m: Positive | None = None


class Wall(_Section):
    """`[wall]`: where it is, how stiff, and by which law it is rendered."""

    law: str = "half_sample"
    position_rad: Number = 0.0
    side: Literal["below", "above"] = "below"
    stiffness_nm_per_rad: NonNegative = 50.0
    damping_nm_s_per_rad: NonNegative = 0.0
    deadbeat: bool = False
    velocity: Literal["difference", "estimated"] = "difference"
    options: dict[str, Number] = Field(default_factory=dict)
    tension: Literal["allow", "clamp", "budget"] = "allow"
    passivity_nm_s_per_rad: NonNegative = 0.0


class Estimator(_Section):
    """`[estimator]`: how fast the operator's force may change, for the Kalman filter."""

    force_walk_nm_per_sqrt_s: Annotated[Positive, Field(ge=1e-4, le=100.0)] = 0.2


class Limits(_Section):
    """`[limits]`: torque is held to its limit; speed and position beyond theirs end the run."""

    torque_nm: Positive
    speed_rad_s: Positive = 60.0
    position_rad: tuple[Number, Number] = (-3.0, 3.0)
    hold_cycles: int = Field(2, ge=0, le=100)
    ramp_cycles: int = Field(10, ge=1, le=1000)

    @field_validator("position_rad", mode="before")
    @classmethod
    def _pair(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @field_validator("position_rad")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not value[0] < value[1]:
            raise ValueError("the lower limit has to come first and lie below the upper one")
        return value


class Hand(_Section):
    """`[simulation.hand]`: a mass, spring and damper about a hand that strikes by script."""

    inertia_kg_m2: NonNegative = 6.4e-5
    damping_nm_s_per_rad: NonNegative = 0.0256
    stiffness_nm_per_rad: NonNegative = 3.2
    strikes: int = Field(4, ge=0)
    first_strike_s: NonNegative = 0.2
    interval_s: Positive = 1.0
    rest_rad: Number = 0.1
    press_rad: Number = -0.1
    press_torque_nm: Number = 0.0
    approach_s: Positive = 0.1
    press_s: NonNegative = 0.5
    withdraw_s: Positive = 0.1

    @model_validator(mode="after")
    def _strikes_fit(self) -> Self:
        lasts = self.approach_s + self.press_s + self.withdraw_s
        # Strikes may follow one another without a rest: 0.1 + 0.1 + 0.1 fits into 0.3.
        if self.strikes > 1 and lasts > self.interval_s * (1.0 + 1e-9):
            raise ValueError(
                f"a strike lasts {lasts:g} s (approach_s + press_s + withdraw_s) and does not fit "
                f"into interval_s = {self.interval_s:g}"
            )
        return self


class Simulation(_Section):
    """`[simulation]`: the mechanics of the simulated drive, and the hand on its handle.

    Rated torque and encoder are those of the dictionary (0x6076, 0x608F) where it has them. What
    is stored over 0x1010 outlives the drive in the file `store`, if there is one.
    """

    rated_torque_nm: Annotated[Positive, Field(ge=0.001)] = 0.637
    counts_per_rev: int = Field(131072, gt=0, lt=2**31)
    inertia_kg_m2: Positive = 1.0e-4
    viscous_nm_s_per_rad: NonNegative = 5.0e-4
    coulomb_nm: NonNegative = 0.01
    store: Path | None = None
    hand: Hand = Hand()

    @field_validator("store", mode="before")
    @classmethod
    def _path(cls, value: object) -> object:
        return Path(value) if isinstance(value, str) else value


class Run(_Section):
    """`[run]`: how long, and in which format the bus log is kept."""

    duration_s: Positive | None = None
    bus_log: Literal["bus.log", "bus.asc", "bus.blf", "bus.csv", "bus.trc", "bus.db"] = "bus.log"


class Change(_Section):
    """`[[schedule]]`: from at_s on, these keys of `[wall]` have these values."""

    at_s: NonNegative
    law: str | None = None
    position_rad: Number | None = None
    stiffness_nm_per_rad: NonNegative | None = None
    damping_nm_s_per_rad: NonNegative | None = None
    deadbeat: bool | None = None
    velocity: Literal["difference", "estimated"] | None = None
    options: dict[str, Number] | None = None
    tension: Literal["allow", "clamp", "budget"] | None = None
    passivity_nm_s_per_rad: NonNegative | None = None


class Settings(_Section):
    """Everything that one run needs to know."""

    bus: Bus = Bus()
    drive: Drive
    mechanics: Mechanics
    wall: Wall = Wall()
    estimator: Estimator = Estimator()
    limits: Limits
    run: Run = Run()
    simulation: Simulation | None = None
    schedule: tuple[Change, ...] = ()

    @field_validator("schedule", mode="before")
    @classmethod
    def _changes(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if [c.at_s for c in self.schedule] != sorted(c.at_s for c in self.schedule):
            raise ValueError("schedule: the entries have to be in the order of at_s")
        low, high = self.limits.position_rad
        sections = ("wall", *(f"schedule.{i}" for i in range(len(self.schedule))))
        for section, (_, wall) in zip(sections, self.walls, strict=True):
            if not low < wall.position_rad < high:
                raise ValueError(
                    f"{section}.position_rad = {wall.position_rad:g} lies outside "
                    f"limits.position_rad = [{low:g}, {high:g}]"
                )
        return self

    @property
    def walls(self) -> list[tuple[float, Wall]]:
        """The wall in force from each instant on: (at_s, wall), the first at 0."""
        timeline = [(0.0, self.wall)]
        for change in self.schedule:
            update = change.model_dump(exclude={"at_s"}, exclude_none=True)
            if change.law is not None:
                update.setdefault("options", {})  # they were the other law's
            timeline.append((change.at_s, timeline[-1][1].model_copy(update=update)))
        return timeline

    @property
    def embedded(self) -> bool:
        """Whether the simulated drive lives in the same process as the master.

        python-can's virtual bus ends at the process; on every other bus the simulated drive is a
        process of its own (`canwall drive`).
        """
        return self.simulation is not None and self.bus.interface == "virtual"

    @property
    def real_time(self) -> bool:
        """Whether SYNCs keep to the wall clock, or go out as fast as the simulation answers."""
        if self.bus.pace == "auto":
            return self.simulation is None
        return self.bus.pace == "real_time"

    def to_toml(self) -> str:
        """The settings as a TOML file that `load` reads back to the same settings."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))


# Lengths and forces at a handle of radius r are angles and torques at its shaft: [wall] may be
# written in either. The exponent of r takes the metric value to the angular one.
_AT_THE_HANDLE = {
    "position_m": ("position_rad", -1),
    "stiffness_n_per_m": ("stiffness_nm_per_rad", 2),
    "damping_n_s_per_m": ("damping_nm_s_per_rad", 2),
}


def _at_the_shaft(raw: dict[str, Any]) -> None:
    """Turn what is written at the handle; what is of the wrong type is left to the validation."""
    mechanics, schedule = raw.get("mechanics"), raw.get("schedule")
    radius = mechanics.get("handle_radius_m") if isinstance(mechanics, dict) else None
    if not isinstance(radius, int | float) or not radius > 0:
        return
    changes = schedule if isinstance(schedule, list) else []
    sections = {"wall": raw.get("wall")} | {f"schedule.{i}": c for i, c in enumerate(changes)}
    for name, section in sections.items():
        if not isinstance(section, dict):
            continue
        for metric, (angular, exponent) in _AT_THE_HANDLE.items():
            if metric not in section:
                continue
            if angular in section:
                raise ConfigError(f"{name}.{metric}: {angular} is given as well; keep one of them")
            value = section.pop(metric)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ConfigError(f"{name}.{metric}: has to be a valid number, not {_shown(value)}")
            section[angular] = value * float(radius) ** exponent


def load(path: Path, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Read and validate a TOML file; `overrides` maps dotted keys to values that go first.

    Paths in the file are relative to the file. Raises ConfigError.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the path of a configuration") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    try:
        raw = tomllib.loads(text)
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    try:
        _at_the_shaft(raw)
        for dotted, value in (overrides or {}).items():
            section, key = dotted.split(".")
            table = raw.setdefault(section, {})
            if isinstance(table, dict):
                table[key] = value
        settings = Settings.model_validate(raw)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except ValidationError as error:
        raise ConfigError(f"{path}: {_first_error(error, raw)}") from None
    return _with_absolute_paths(settings, path.parent)


def _with_absolute_paths(settings: Settings, base: Path) -> Settings:
    """The files that a configuration names, independent of where it lies."""
    drive = settings.drive.model_copy(update={"eds": (base / settings.drive.eds).resolve()})
    wall = settings.wall.model_copy(update={"law": absolute_law(settings.wall.law, base)})
    schedule = tuple(
        change.model_copy(update={"law": change.law and absolute_law(change.law, base)})
        for change in settings.schedule
    )
    simulation = settings.simulation
    if simulation is not None and simulation.store is not None:
        store = (base / simulation.store).resolve()
        simulation = simulation.model_copy(update={"store": store})
    return settings.model_copy(
        update={"drive": drive, "wall": wall, "schedule": schedule, "simulation": simulation}
    )


def absolute_law(law: str, base: Path) -> str:
    """A law's name; where it names a user's file, that file's path no longer relative to base."""
    path, colon, function = law.rpartition(":")
    return f"{(base / path).resolve()}:{function}" if colon else law


# What the validation calls by the names of Python, in those of TOML.
_IN_TOML = {
    "model_type": "a table",
    "dict_type": "a table",
    "tuple_type": "an array",
    "too_long": "a pair",
    "is_instance_of": "a path in quotes",
}


def _first_error(error: ValidationError, raw: Mapping[str, Any]) -> str:
    """One line for the first thing that is wrong: key, what, what to do."""
    first = error.errors()[0]
    where = [str(part) for part in first["loc"]]
    key = ".".join(where)
    given = first["input"]
    if first["type"] == "extra_forbidden":
        return f"{key}: unknown key{_suggestion(where)}"
    if first["type"] == "missing":
        return f"{key}: is missing; add it"
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    if not key:
        return message
    if first["type"] == "value_error":
        return f"{key}: {message}"
    return f"{key}: has to be {_IN_TOML.get(first['type'], message)}, not {_shown(given)}"


def _shown(value: object) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return repr(value) if isinstance(value, str | int | float | bool) else type(value).__name__


def _suggestion(where: list[str]) -> str:
    model: Any = Settings
    for part in where[:-1]:
        if part.isdigit():
            continue
        annotation = model.model_fields[part].annotation
        candidates = [annotation, *get_args(annotation)]
        model = next(c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel))
    known = list(model.model_fields)
    if where[-1] in _AT_THE_HANDLE:
        return "; lengths and forces at the handle need mechanics.handle_radius_m"
    close = difflib.get_close_matches(where[-1], known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else f"; known here: {', '.join(known)}"


def shipped(relative: str) -> Path:
    """A file that comes with the project, e.g. `config/sim.toml`, in a checkout or installed."""
    package = Path(__file__).resolve().parent
    installed = package / "data" / relative
    return installed if installed.exists() else package.parent / relative
