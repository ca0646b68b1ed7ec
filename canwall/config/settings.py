"""The sections of a configuration, and the checks that span several of them."""

from typing import Annotated, Any, Literal, NamedTuple, Self

import tomli_w
from pydantic import Field, field_validator, model_validator

from canwall.config.drive import Drive
from canwall.config.section import (
    Change,
    Damping,
    Duration,
    Inertia,
    Names,
    NonNegative,
    Number,
    Positive,
    Section,
    Stiffness,
    changed,
    changing,
)
from canwall.config.simulation import Simulation
from canwall.config.sweep import AxisValues

#: What the model knows of an ideal servo, in [drive] and in [mechanics].
_IDEAL_DRIVE = {"drive_cycle_s": 0.0, "current_bandwidth_hz": 0.0}
_IDEAL_MECHANICS = {"shaft_hz": 0.0}

#: Rest between the two parts of the measurement of the delay [cycles].
_REST_CYCLES = 50

#: Time in which a drive is set up [s], which passes for a hand that goes by the clock.
_SET_UP_S = 2.0

#: Largest radius of a handle [m].
HANDLE_MAX_M = 10.0

#: Inertia of the heaviest hand: an arm of 0.69 kg at a handle of 80 mm.
_HEAVIEST_HAND_KG_M2 = 4.4e-3


class Bus(Section):
    """`[bus]`: the interface to the drive, and the period and the producer of the SYNC."""

    interface: str = "virtual"
    channel: str = "canwall"
    bitrate: int = Field(1_000_000, gt=0)
    cycle_s: Annotated[Positive, Field(ge=1e-5, le=1.0)] = 0.001
    pace: Literal["auto", "real_time", "simulated"] = "auto"
    sync: Literal["produce", "external"] = "produce"
    exchange: Literal["auto", "python-can", "native"] = "auto"
    processor: Annotated[int, Field(ge=0, le=4095)] | None = None
    master_id: int = Field(127, ge=1, le=127)

    @property
    def has_wire(self) -> bool:
        """True if a real drive may be on the bus, as far as the names of `[bus]` tell."""
        return has_wire(self.interface, self.channel)


def has_wire(interface: str, channel: str) -> bool:
    """Return False for a bus that exists in this machine alone."""
    return interface not in ("virtual", "unixcan") and not channel.startswith("vcan")


class Mechanics(Section):
    """`[mechanics]`: the model of everything that moves, as the laws use it.

    Attributes:
        shaft_hz: Resonance of the rotor against the rest of inertia_kg_m2; 0: a rigid shaft.
        shaft_damping_ratio: Damping ratio of that resonance.
        rotor_inertia_kg_m2: With shaft_hz, the rotor's part of inertia_kg_m2.
    """

    inertia_kg_m2: Inertia
    viscous_nm_s_per_rad: Damping = 0.0
    coulomb_nm: NonNegative = 0.0
    spring_nm_per_rad: Stiffness = 0.0
    handle_radius_m: Annotated[Positive, Field(ge=1e-4, le=HANDLE_MAX_M)] | None = None
    shaft_hz: Annotated[NonNegative, Field(le=1e5)] = 0.0
    shaft_damping_ratio: Annotated[NonNegative, Field(lt=1.0)] = 0.02
    rotor_inertia_kg_m2: Positive | None = None

    @model_validator(mode="after")
    def _has_a_rotor(self) -> Self:
        rotor = self.rotor_inertia_kg_m2
        if self.shaft_hz and (rotor is None or rotor >= self.inertia_kg_m2):
            given = "it is missing" if rotor is None else f"not {rotor:g}"
            raise ValueError(
                "rotor_inertia_kg_m2: with shaft_hz it has to be less than inertia_kg_m2, of which "
                f"it is a part; {given}"
            )
        return self


class Wall(Section):
    """`[wall]`: position, stiffness and damping, and the law that renders it.

    Attributes:
        damping_ratio: ζ of B = 2·ζ·√(K·m) with stiffness and mass in force; 0: B as given.
            Default: 0.5, and 0 beside a damping that is given.
        cap: c of the largest stiffness in force, c·m/T² with the mass in force, and no more than
            delay and encoder bear, or an elastic shaft without its resonance; 0: as asked.
    """

    law: str = "mean_force"
    position_rad: Number = 0.0
    side: Literal["below", "above"] = "below"
    stiffness_nm_per_rad: NonNegative = 50.0
    damping_nm_s_per_rad: NonNegative = 0.0
    damping_ratio: Annotated[NonNegative, Field(le=100.0)] = 0.5
    cap: NonNegative = 0.8
    deadbeat: bool = False
    velocity: Literal["difference", "estimated"] = "difference"
    options: dict[str, Number] = Field(default_factory=dict)
    tension: Literal["allow", "clamp", "budget"] = "clamp"
    passivity_nm_s_per_rad: NonNegative = 0.0
    divider: int = Field(1, ge=1, le=1000)
    alternate: Names = ()

    @model_validator(mode="before")
    @classmethod
    def _damping_as_given(cls, given: object) -> object:
        if isinstance(given, dict) and "damping_nm_s_per_rad" in given:
            return {"damping_ratio": 0.0} | given
        return given

    @property
    def orientation(self) -> float:
        """Direction out of the wall on the drive's axis: 1 of one below, −1 of one above."""
        return 1.0 if self.side == "below" else -1.0


class Estimator(Section):
    """`[estimator]`: the Kalman filter.

    Attributes:
        force_walk_nm_per_sqrt_s: Random walk of the operator's force in a plain Kalman filter, for
            a hand that is known, in place of a filter that is as quick as delay, encoder, wall and
            friction let it. Without operator.adapt only.
        delay_cycles: Delay D from the sampling of a position until the torque computed from it
            takes effect, in cycles. Default: 1 with synchronous PDOs; measured with others.
        delay_margin_cycles: What the model of the laws has more than that: too little delay costs
            far more stiffness than too much. Default: 0.1, and 0 for a plain filter.
        measure_delay: Measure the delay before the wall is rendered. False: where nothing tells
            it, neither delay_cycles nor synchronous PDOs. "auto": also where the lag of the
            drive's current loop is not known and a law has a model. True: always.
        measure_torque_nm: Amplitude of the small torques of the measurement.
        measure_cycles: Duration of each of its two parts.
    """

    force_walk_nm_per_sqrt_s: Annotated[Positive, Field(ge=1e-4, le=100.0)] | None = None
    delay_cycles: Annotated[Number, Field(ge=0, le=3)] | None = None
    delay_margin_cycles: Annotated[Number, Field(ge=0, le=1)] | None = None
    measure_delay: bool | Literal["auto"] = "auto"
    measure_torque_nm: Positive = 0.15
    measure_cycles: int = Field(400, ge=100, le=10_000)

    @property
    def measurements(self) -> list[slice]:
        """Cycles of the two parts of the measurement of the delay, with a rest in between."""
        starts = (0, self.measure_cycles + _REST_CYCLES)
        return [slice(start, start + self.measure_cycles) for start in starts]


class Operator(Section):
    """`[operator]`: the hand at the handle, identified in the cycle from the wall's own torques.

    Attributes:
        adapt: Identify it. [mechanics] is then the drive with its handle, without a hand. False:
            it is with the hand, and one filter holds its mass.
        lightest_kg_m2: Inertia of drive, handle and hand to begin with. Default: that of
            [mechanics].
        heaviest_kg_m2: Largest inertia of drive, handle and hand. Default: 4.4e-3 more than the
            lightest, an arm at a handle of 80 mm.
        damping_nm_s_per_rad: Damping of a heavy hand; a light one has less. On a shaft that makes
            the filters slow all hands have none.
        filters: Number of hands, in geometric progression, that are compared in each cycle.
    """

    adapt: bool = True
    lightest_kg_m2: Inertia | None = None
    heaviest_kg_m2: Inertia | None = None
    damping_nm_s_per_rad: Damping = 0.04
    filters: int = Field(16, ge=3, le=24)


class Limits(Section):
    """`[limits]`: torque and torque rate are clipped; any other limit, if exceeded, ends the run.

    Attributes:
        jump_rad: Largest distance of a position from the expected one. Default: the travel in
            one cycle at speed_rad_s.
        stuck_rad: Travel that the model predicts within stuck_cycles while the position does not
            change by a single count; 0: not monitored.
        torque_error_nm: Largest deviation of 0x6077, for torque_error_cycles, from all recently
            commanded torques. Default: a tenth of torque_nm, but at least 5 % of the rated
            torque; 0: not monitored.
        late_cycles: Consecutive RPDOs sent after the next SYNC, in real time; 0: only counted.
    """

    torque_nm: Positive
    torque_rate_nm_per_s: Positive | None = None
    speed_rad_s: Positive = 60.0
    position_rad: tuple[Number, Number] = (-3.0, 3.0)
    energy_j: Positive | None = None
    jump_rad: Positive | None = None
    stuck_rad: NonNegative = 0.0006
    stuck_cycles: int = Field(5, ge=3, le=100)
    torque_error_nm: NonNegative | None = None
    torque_error_cycles: int = Field(20, ge=5, le=1000)
    late_cycles: int = Field(50, ge=0, le=10_000)
    emergency: Literal["trip", "note"] = "trip"
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


class Guard(Section):
    """`[guard]`: what becomes of a wall that buzzes: nothing, a word, or less force for a while."""

    action: Literal["off", "warn", "act"] = "warn"


class Run(Section):
    """`[run]`: duration, times over which walls fade in and change, format of the bus log."""

    duration_s: Positive | None = None
    ramp_in_s: Duration = 0.5
    blend_s: Duration = 0.05
    more_laws: Names = ()
    bus_log: Literal["bus.log", "bus.asc", "bus.blf", "bus.csv", "bus.trc", "bus.db"] = "bus.log"


@changing(Limits, ("torque_nm", "torque_rate_nm_per_s", "speed_rad_s", "energy_j"))
class LimitsChange(Change):
    """Changes of `[limits]` while the wall is rendered."""


@changing(Guard, ("action",))
class GuardChange(Change):
    """Changes of `[guard]` while the wall is rendered."""


@changing(Operator, ("adapt",))
class OperatorChange(Change):
    """Changes of `[operator]` while the wall is rendered."""


def check_divider(wall: Wall, mechanics: Mechanics) -> None:
    """Raise ValueError for a divider with which the bound of a cap is not that of the shaft."""
    if wall.divider > 1 and wall.cap and mechanics.shaft_hz:
        raise ValueError(
            "wall.divider: has to be 1 with mechanics.shaft_hz and wall.cap, whose bound is "
            "that of a law in every cycle; or wall.cap 0"
        )


@changing(Wall, (key for key in Wall.model_fields if key not in ("side", "alternate")))
class _WallKeys(Change):
    """Changes of `[wall]`: all keys except the side and the alternating laws."""


class WallChange(_WallKeys):
    """Changes of `[wall]` and, under their names, of other sections while the wall is rendered."""

    limits: LimitsChange | None = None
    guard: GuardChange | None = None
    operator: OperatorChange | None = None

    @model_validator(mode="after")
    def _one_damping(self) -> Self:
        if self.damping_ratio and self.damping_nm_s_per_rad:
            raise ValueError(
                "damping_ratio: damping_nm_s_per_rad is given as well; keep one of them"
            )
        return self

    def applied_to(self, wall: Wall, limits: Limits) -> tuple[Wall, Limits]:
        """Return wall and limits after the change."""
        keys = set(_WallKeys.model_fields)
        update = self.model_dump(include=keys, exclude_none=True)
        if self.law is not None:
            update.setdefault("options", {})  # options belong to the previous law
        if self.damping_nm_s_per_rad is not None:
            update.setdefault("damping_ratio", 0.0)  # a damping that is given takes its place
        return wall.model_copy(update=update), changed(limits, self.limits)


class Scheduled(WallChange):
    """`[[schedule]]`: a change and its time."""

    at_s: NonNegative


class Stage(NamedTuple):
    """Wall, limits, guard and operator in force from at_s on."""

    at_s: float
    wall: Wall
    limits: Limits
    guard: Guard
    operator: Operator


class Settings(Section):
    """Complete settings of one run."""

    bus: Bus = Bus()
    drive: Drive
    mechanics: Mechanics
    wall: Wall = Wall()
    estimator: Estimator = Estimator()
    operator: Operator = Operator()
    limits: Limits
    guard: Guard = Guard()
    run: Run = Run()
    simulation: Simulation | None = None
    schedule: tuple[Scheduled, ...] = ()
    sweep: dict[str, AxisValues] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _scale_alike(cls, values: Any) -> Any:
        """Give the simulated drive the scales that its master was given, unless it has its own."""
        if not isinstance(values, dict):
            return values
        drive, simulation = values.get("drive"), values.get("simulation")
        if not (isinstance(drive, dict) and isinstance(simulation, dict)):
            return values
        given: dict[str, Any] = {}
        counts, rated_nm = drive.get("counts_per_rev"), drive.get("rated_torque_nm")
        if isinstance(counts, int | float) and float(counts).is_integer():
            given["counts_per_rev"] = int(counts)
        if rated_nm is not None:
            given["rated_torque_nm"] = rated_nm
        return values | {"simulation": given | simulation}

    @model_validator(mode="before")
    @classmethod
    def _idealise(cls, values: Any) -> Any:
        """Let the model know of an ideal servo (`[simulation] ideal`)."""
        if not isinstance(values, dict):
            return values
        drive, simulation = values.get("drive"), values.get("simulation")
        ideal = isinstance(simulation, dict) and simulation.get("ideal") is True
        if not (ideal and isinstance(drive, dict)):
            return values
        values = values | {"drive": drive | _IDEAL_DRIVE}
        if isinstance(mechanics := values.get("mechanics"), dict):
            values["mechanics"] = mechanics | _IDEAL_MECHANICS
        estimator = values.get("estimator", {})
        if isinstance(estimator, dict) and estimator.get("measure_delay", "auto") == "auto":
            values["estimator"] = estimator | {"measure_delay": False}
        return values

    @field_validator("schedule", mode="before")
    @classmethod
    def _changes(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.drive.node_id == self.bus.master_id:
            raise ValueError(
                f"bus.master_id = {self.bus.master_id} is the drive's own node-ID: no two nodes of "
                f"a bus may share one"
            )
        lightest, heaviest = self.masses
        if self.operator.adapt and not lightest < heaviest:
            raise ValueError(
                f"operator.heaviest_kg_m2 = {heaviest:g}: has to be more than the lightest "
                f"inertia, {lightest:g}; raise it, or lower operator.lightest_kg_m2"
            )
        rotor = self.mechanics.rotor_inertia_kg_m2
        if self.operator.adapt and self.mechanics.shaft_hz and rotor and lightest <= rotor:
            raise ValueError(
                f"operator.lightest_kg_m2 = {lightest:g}: has to be more than the rotor's part, "
                f"mechanics.rotor_inertia_kg_m2 = {rotor:g}"
            )
        if [c.at_s for c in self.schedule] != sorted(c.at_s for c in self.schedule):
            raise ValueError("schedule: the entries have to be in the order of at_s")
        if self.wall.alternate and any(change.law for change in self.schedule):
            raise ValueError("schedule: changes the law, and so does wall.alternate; keep one")
        if not self.operator.adapt and any(stage.operator.adapt for stage in self.stages):
            raise ValueError(
                "schedule: operator.adapt: [mechanics] is with the hand where a run begins without "
                "adapting; begin with operator.adapt = true"
            )
        for stage in self.stages:
            check_divider(stage.wall, self.mechanics)
        low, high = self.limits.position_rad
        sections = ("wall", *(f"schedule.{i}" for i in range(len(self.schedule))))
        for section, stage in zip(sections, self.stages, strict=True):
            if not low < stage.wall.position_rad < high:
                raise ValueError(
                    f"{section}.position_rad = {stage.wall.position_rad:g} lies outside "
                    f"limits.position_rad = [{low:g}, {high:g}]"
                )
        return self

    @model_validator(mode="after")
    def _strike_after_the_measurement(self) -> Self:
        """Let a simulated hand without first_strike_s rest while the delay may be measured."""
        simulation, estimator, drive = self.simulation, self.estimator, self.drive
        if simulation is None or "first_strike_s" in simulation.hand.model_fields_set:
            return self
        lags = drive.current_bandwidth_hz == 0.0 and estimator.measure_delay == "auto"
        unknown = estimator.delay_cycles is None and (drive.torque_pdo == "immediate" or lags)
        if not (estimator.measure_delay is True or unknown):
            return self
        measured_s = estimator.measurements[-1].stop * self.bus.cycle_s
        if simulation.real_time:
            measured_s += _SET_UP_S
        update = {"first_strike_s": measured_s + simulation.hand.first_strike_s}
        hand = simulation.hand.model_copy(update=update)
        simulation = simulation.model_copy(update={"hand": hand})
        return self.model_copy(update={"simulation": simulation})

    @property
    def stages(self) -> list[Stage]:
        """Walls, limits and so on with the times from which they are in force, the first one 0."""
        timeline = [Stage(0.0, self.wall, self.limits, self.guard, self.operator)]
        for change in self.schedule:
            _, wall, limits, guard, operator = timeline[-1]
            timeline.append(
                Stage(
                    change.at_s,
                    *change.applied_to(wall, limits),
                    changed(guard, change.guard),
                    changed(operator, change.operator),
                )
            )
        return timeline

    def laws_in_turn(self, wall: Wall) -> list[Wall]:
        """Return the walls that alternate from strike to strike, `wall` first.

        Options and deadbeat compensation belong to the law of `wall`; the laws in `alternate` have
        their defaults, and the compensation if `+deadbeat` is in their names.
        """
        own = {"options": {}, "deadbeat": False}
        return [wall, *(wall.model_copy(update=own | {"law": law}) for law in wall.alternate)]

    def with_ideal_servo(self) -> Self:
        """Return the same with an ideal simulated servo, of which the model of the laws knows."""
        update = {
            "drive": self.drive.model_copy(update=_IDEAL_DRIVE),
            "mechanics": self.mechanics.model_copy(update=_IDEAL_MECHANICS),
            "simulation": self.simulation and self.simulation.with_ideal_servo(),
        }
        return self.model_copy(update=update)

    def without_replacements(self, *, law: bool) -> Self:
        """Return the same without the changes in `[[schedule]]` that would replace a given law."""
        if not law:
            return self
        changes = (change.model_copy(update={"law": None}) for change in self.schedule)
        return self.model_copy(update={"schedule": tuple(changes)})

    @property
    def masses(self) -> tuple[float, float]:
        """Least and largest inertia of drive, handle and hand that is reckoned with [kg·m²]."""
        lightest = self.operator.lightest_kg_m2 or self.mechanics.inertia_kg_m2
        return lightest, self.operator.heaviest_kg_m2 or lightest + _HEAVIEST_HAND_KG_M2

    @property
    def embedded(self) -> bool:
        """True if the simulated drive runs in the process of the master.

        python-can's virtual bus does not leave the process; on every other bus the simulated drive
        is a process of its own (`canwall drive`).
        """
        return self.simulation is not None and self.bus.interface == "virtual"

    @property
    def real_time(self) -> bool:
        """True if SYNCs follow the clock, False if they go as fast as the simulation answers.

        A wall in memory without an end is one to be watched: as fast as possible, its record would
        grow by megabytes a second. On a wire the drive may be a real one, also if the file has a
        simulated one for its sweeps.
        """
        if self.bus.pace == "auto":
            endless = self.embedded and self.run.duration_s is None
            simulated = self.simulation is not None and not self.simulation.real_time
            return not simulated or endless or self.bus.has_wire
        return self.bus.pace == "real_time"

    def to_toml(self) -> str:
        """Return the settings as TOML that `load` reads back to the same settings."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))
