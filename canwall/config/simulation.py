"""`[simulation]`: the mechanics of the simulated drive, and the hand on its handle."""

from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from canwall.config.drive import Objects, by_index
from canwall.config.fault import Fault
from canwall.config.hand import Hand
from canwall.config.section import (
    Array,
    FilePath,
    Interval,
    NonNegative,
    Number,
    Positive,
    Section,
    Torque,
)

#: What `ideal = true` stands for, whatever the keys themselves say.
_IDEAL: dict[str, Any] = {
    "ideal": True,
    "stiction_nm": None,
    "cogging_nm": 0.0,
    "torque_step_nm": 0.0,
    "current_bandwidth_hz": 0.0,
    "torque_constant_error": 0.0,
    "drive_cycle_s": 0.0,
    "shaft_hz": 0.0,
}

#: Stiction over Coulomb friction, where it is not given.
BREAKAWAY = 1.5


class Simulation(Section):
    """`[simulation]`: the mechanics of the simulated drive, and the hand on its handle.

    `objects` are power-on values that override those of the dictionary. Rated torque and encoder
    come from the dictionary (0x6076, 0x608F); the keys are for a dictionary without them, and are
    those of `[drive]` if only those are given. The motor's torque is limited to `peak_torque_nm`
    (by default three times the rated torque), and falls back to the rated torque after `overload_s`
    at the peak, or longer below it (I²t). The limit switches are closed outside
    `limit_switches_rad`, the home switch within `home_switch_rad`. Parameters stored through 0x1010
    are kept in the file `store`, if given.

    Friction is `coulomb_nm` in motion; at rest it holds up to `stiction_nm`, at least as much and
    by default 1.5 times that. The motor's cogging torque is a triangle wave of amplitude
    `cogging_nm`, with `cogs_per_rev` periods per revolution. The current loop is a first-order lag
    of `current_bandwidth_hz` (0: no lag) with a resolution of `torque_step_nm` (0: exact). The
    motor delivers 1 + `torque_constant_error` of the torque that the drive believes and shows
    (0x6077). The velocity (0x606C) is the difference of the encoder over one period, low-pass
    filtered with `velocity_filter_hz` (0: unfiltered).

    The drive has a control cycle of its own, `drive_cycle_s` (0: none), whose clock is fast by
    `clock_ppm` against the SYNC. At its ticks it latches position and torque for the next TPDO,
    and puts into force the torque that has come. At the start, `clock_phase` of a cycle is left
    until the next tick.

    `ideal` makes motor and drive ideal, whatever these keys say: no cogging, no torque steps, no
    lag, no error of the torque constant, no drive cycle, no stiction beyond Coulomb friction, and a
    rigid shaft.

    With `shaft_hz` (0: rigid) an elastic shaft joins the motor's rotor, `rotor_inertia_kg_m2` of
    `inertia_kg_m2`, to the handle. Rotor and handle without a hand resonate against each other at
    `shaft_hz`, damped by `shaft_damping_ratio`. Encoder, friction and cogging are on the rotor.

    Time advances by one `[bus] cycle_s` per SYNC or, with `real_time`, by the clock. The torque of
    an RPDO acts `torque_delay_cycles` periods after the SYNC (synchronous types) or after its
    arrival (254, 255). `seed` seeds the random numbers of the faults.
    """

    objects: Objects = Field(default_factory=dict)
    rated_torque_nm: Annotated[Positive, Field(ge=0.001, le=1e6)] = 0.637
    counts_per_rev: int = Field(131072, gt=0, lt=2**31)
    inertia_kg_m2: Positive = 1.0e-4
    viscous_nm_s_per_rad: NonNegative = 5.0e-4
    coulomb_nm: NonNegative = 0.01
    stiction_nm: NonNegative | None = None
    cogging_nm: NonNegative = 0.003
    cogs_per_rev: int = Field(24, ge=1, le=10_000)
    current_bandwidth_hz: Annotated[NonNegative, Field(le=1e6)] = 1600.0
    shaft_hz: Annotated[NonNegative, Field(le=1e5)] = 0.0
    shaft_damping_ratio: Annotated[NonNegative, Field(lt=1.0)] = 0.02
    rotor_inertia_kg_m2: Positive = 1.06e-5
    torque_step_nm: NonNegative = 0.0003
    torque_constant_error: Annotated[Number, Field(gt=-1.0, le=1.0)] = 0.0
    drive_cycle_s: Annotated[NonNegative, Field(le=0.1)] = 0.00025
    clock_ppm: Annotated[Number, Field(ge=-1e4, le=1e4)] = 50.0
    clock_phase: Annotated[NonNegative, Field(le=1.0)] = 0.5
    velocity_filter_hz: NonNegative = 200.0
    peak_torque_nm: Torque | None = None
    overload_s: NonNegative = 3.0
    dc_link_v: Annotated[Positive, Field(le=1000.0)] = 48.0
    limit_switches_rad: Interval | None = None
    home_switch_rad: Interval | None = None
    store: FilePath | None = None
    real_time: bool = False
    torque_delay_cycles: Annotated[NonNegative, Field(le=1000.0)] = 0.0
    ideal: bool = False
    seed: int = Field(0, ge=0)
    hand: Hand = Hand()
    fault: Array[tuple[Fault, ...]] = ()

    @property
    def objects_by_index(self) -> dict[tuple[int, int], int]:
        """`objects` by index and sub-index."""
        return by_index(self.objects)

    @property
    def handle_inertia_kg_m2(self) -> float:
        """Inertia of what the hand moves without the shaft: all, or the part beyond it."""
        beyond = self.inertia_kg_m2 - self.rotor_inertia_kg_m2
        return beyond if self.shaft_hz else self.inertia_kg_m2

    @property
    def breakaway_nm(self) -> float:
        """Torque that sets the handle in motion from rest."""
        if self.stiction_nm is not None:
            return self.stiction_nm
        return self.coulomb_nm if self.ideal else BREAKAWAY * self.coulomb_nm

    def with_ideal_servo(self) -> Self:
        """Return the same mechanics with an ideal motor and drive, as `ideal` makes them."""
        return self.model_copy(update=_IDEAL)

    @model_validator(mode="before")
    @classmethod
    def _idealise(cls, values: Any) -> Any:
        ideal = isinstance(values, dict) and values.get("ideal") is True
        return values | _IDEAL if ideal else values

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.breakaway_nm < self.coulomb_nm:
            raise ValueError(
                f"stiction_nm: has to be at least coulomb_nm, {self.coulomb_nm}, "
                f"not {self.stiction_nm}"
            )
        if self.shaft_hz and self.rotor_inertia_kg_m2 >= self.inertia_kg_m2:
            raise ValueError(
                "rotor_inertia_kg_m2: has to be less than inertia_kg_m2, of which it is a part, "
                f"not {self.rotor_inertia_kg_m2}"
            )
        if self.shaft_hz and not self.hand.grip:
            raise ValueError(
                "hand.grip: a hand that can lose the handle needs a rigid shaft, shaft_hz = 0"
            )
        return self
