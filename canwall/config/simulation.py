"""`[simulation]`: the mechanics of the simulated drive, and the hand on its handle."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, field_validator

from canwall.config.drive import Objects, by_index
from canwall.config.fault import Fault
from canwall.config.hand import Hand
from canwall.config.section import NonNegative, Number, Positive, Section


class Simulation(Section):
    """`[simulation]`: the mechanics of the simulated drive, and the hand on its handle.

    `objects` are power-on values that go before those of the dictionary's file. Rated torque and
    encoder are those of the dictionary (0x6076, 0x608F) where it has them. The
    motor's torque has its limit at `peak_torque_nm` (three times the rated torque, unless given),
    and falls back to the rated torque when the peak has lasted for `overload_s`, or less of it for
    longer (I²t). The limit switches are closed outside `limit_switches_rad`, the home switch
    within `home_switch_rad`. What is stored over 0x1010 outlives the drive in the file `store`, if
    there is one.

    The motor cogs with a triangle wave of `cogging_nm` over each of `cogs_per_rev`. Its current
    loop is a first-order lag of `current_bandwidth_hz` (0: it follows at once) and knows torques
    in steps of `torque_step_nm` (0: any). The velocity (0x606C) is the difference of the encoder
    over one period, through a low-pass filter of first order (`velocity_filter_hz`; 0: as it is).

    Time is one `[bus] cycle_s` per SYNC or, with `real_time`, what is measured. The torque of an
    RPDO acts `torque_delay_cycles` periods after the SYNC (synchronous) or the arrival (254, 255).
    The faults are those of one `seed`.
    """

    objects: Objects = Field(default_factory=dict)
    rated_torque_nm: Annotated[Positive, Field(ge=0.001)] = 0.637
    counts_per_rev: int = Field(131072, gt=0, lt=2**31)
    inertia_kg_m2: Positive = 1.0e-4
    viscous_nm_s_per_rad: NonNegative = 5.0e-4
    coulomb_nm: NonNegative = 0.01
    cogging_nm: NonNegative = 0.003
    cogs_per_rev: int = Field(24, ge=1, le=10_000)
    current_bandwidth_hz: Annotated[NonNegative, Field(le=1e6)] = 0.0
    torque_step_nm: NonNegative = 0.0003
    velocity_filter_hz: NonNegative = 200.0
    peak_torque_nm: Positive | None = None
    overload_s: NonNegative = 3.0
    dc_link_v: Annotated[Positive, Field(le=1000.0)] = 48.0
    limit_switches_rad: tuple[Number, Number] | None = None
    home_switch_rad: tuple[Number, Number] | None = None
    store: Path | None = None
    real_time: bool = False
    torque_delay_cycles: Annotated[NonNegative, Field(le=1000.0)] = 0.0
    seed: int = Field(0, ge=0)
    hand: Hand = Hand()
    fault: tuple[Fault, ...] = ()

    @field_validator("fault", mode="before")
    @classmethod
    def _faults(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @field_validator("limit_switches_rad", "home_switch_rad", mode="before")
    @classmethod
    def _pair(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @field_validator("limit_switches_rad", "home_switch_rad")
    @classmethod
    def _ordered(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and not value[0] < value[1]:
            raise ValueError("the lower position has to come first and lie below the upper one")
        return value

    @field_validator("store", mode="before")
    @classmethod
    def _path(cls, value: object) -> object:
        return Path(value) if isinstance(value, str) else value

    @property
    def written(self) -> dict[tuple[int, int], int]:
        """`objects` by index and sub-index."""
        return by_index(self.objects)

    def with_ideal_servo(self) -> Self:
        """The same mechanics behind a motor without cogging that gives any torque at once."""
        ideal = {"cogging_nm": 0.0, "torque_step_nm": 0.0, "current_bandwidth_hz": 0.0}
        return self.model_copy(update=ideal)
