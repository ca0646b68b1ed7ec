"""`[simulation]`: the mechanics of the simulated drive, and the hand on its handle."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from canwall.config.fault import Fault
from canwall.config.section import NonNegative, Number, Positive, Section


class Hand(Section):
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


class Simulation(Section):
    """`[simulation]`: the mechanics of the simulated drive, and the hand on its handle.

    Rated torque and encoder are those of the dictionary (0x6076, 0x608F) where it has them. The
    motor's torque has its limit at `peak_torque_nm` (three times the rated torque, unless given),
    and falls back to the rated torque when the peak has lasted for `overload_s`, or less of it for
    longer (I²t). The limit switches are closed outside `limit_switches_rad`, the home switch
    within `home_switch_rad`. What is stored over 0x1010 outlives the drive in the file `store`, if
    there is one.

    Time is one `[bus] cycle_s` per SYNC or, with `real_time`, what is measured. The torque of an
    RPDO acts `torque_delay_cycles` periods after the SYNC (synchronous) or the arrival (254, 255).
    The faults are those of one `seed`.
    """

    rated_torque_nm: Annotated[Positive, Field(ge=0.001)] = 0.637
    counts_per_rev: int = Field(131072, gt=0, lt=2**31)
    inertia_kg_m2: Positive = 1.0e-4
    viscous_nm_s_per_rad: NonNegative = 5.0e-4
    coulomb_nm: NonNegative = 0.01
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
