"""`[simulation.hand]`: the hand on the simulated drive's handle, and what it does there."""

from typing import Literal, Self

from pydantic import Field, model_validator

from canwall.config.section import Array, NonNegative, Number, Positive, Section

#: Required and optional keys of each move of a script, besides duration_s.
_KEYS = {
    "rest": ((), ()),
    "approach": (("position_rad",), ()),
    "press": (("torque_nm",), ("position_rad",)),
    "tap": (("position_rad",), ()),
    "release": ((), ("position_rad",)),
}


class Move(Section):
    """`[[simulation.hand.script]]`: one move, from the end of the move before.

    rest: the hand stays as it is. approach: it moves to position_rad. press: its muscle torque goes
    to torque_nm, and the hand to position_rad if given. tap: to position_rad and back, in half the
    time each. release: the muscle torque goes to zero, and the hand to position_rad, by default
    rest_rad.
    """

    move: Literal["rest", "approach", "press", "tap", "release"]
    duration_s: Positive
    position_rad: Number | None = None
    torque_nm: Number | None = None

    @model_validator(mode="after")
    def _has_its_keys(self) -> Self:
        needed, allowed = _KEYS[self.move]
        for key in ("position_rad", "torque_nm"):
            given = getattr(self, key) is not None
            if key in needed and not given:
                raise ValueError(f"{self.move} needs {key}; add it")
            if given and key not in (*needed, *allowed):
                raise ValueError(f"{self.move} has no {key}; remove it")
        return self


class RandomStrikes(Section):
    """`[simulation.hand.random]`: random strikes, each quantity uniformly from its range.

    Before each strike the hand rests for pause_s. The same seed gives the same strikes.
    """

    seed: int = Field(0, ge=0)
    strikes: int = Field(10, ge=1, le=100_000)
    pause_s: Array[tuple[Positive, Positive]] = (0.2, 0.6)
    approach_s: Array[tuple[Positive, Positive]] = (0.05, 0.2)
    press_s: Array[tuple[Positive, Positive]] = (0.2, 0.5)
    withdraw_s: Array[tuple[Positive, Positive]] = (0.05, 0.2)
    press_rad: Array[tuple[Number, Number]] = (-0.15, -0.05)
    press_torque_nm: Array[tuple[Number, Number]] = (0.0, 0.0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for key in type(self).model_fields:
            value = getattr(self, key)
            if isinstance(value, tuple) and value[0] > value[1]:
                raise ValueError(f"{key}: the lower bound has to come first")
        return self


class Hand(Section):
    """`[simulation.hand]`: a mass, spring and damper about a hand that moves by script.

    Without `script` and `random` it makes `strikes` identical strikes, the first one by default
    0.2 s after the start, or after the delay is measured where the run does so. With `grip` it
    holds the handle; without, it only presses, from rest_rad towards press_rad, and can lose the
    handle.
    """

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
    grip: bool = True
    script: Array[tuple[Move, ...]] = ()
    random: RandomStrikes | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        lasts = self.approach_s + self.press_s + self.withdraw_s
        # The tolerance is for rounding: 0.1 + 0.1 + 0.1 has to fit into 0.3.
        if self.strikes > 1 and lasts > self.interval_s * (1.0 + 1e-9):
            raise ValueError(
                f"a strike lasts {lasts:g} s (approach_s + press_s + withdraw_s) and does not fit "
                f"into interval_s = {self.interval_s:g}"
            )
        if self.script and self.random is not None:
            raise ValueError("script and random are given; keep one of them")
        if not self.grip and self.press_rad == self.rest_rad:
            raise ValueError(
                "grip = false: press_rad has to differ from rest_rad, to give the hand a side"
            )
        if not self.grip and self.inertia_kg_m2 == 0.0:
            raise ValueError("grip = false: inertia_kg_m2 has to be greater than 0")
        return self

    @property
    def side(self) -> float:
        """Direction in which the hand presses, 1.0 or -1.0."""
        return 1.0 if self.press_rad > self.rest_rad else -1.0
