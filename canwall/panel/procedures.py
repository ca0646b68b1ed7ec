"""Procedures of a blind comparison: which walls come when, what is asked, what comes out."""

import json
import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from canwall.config import ConfigError, Wall, WallChange
from canwall.config.section import Array, Names, Number, Positive, Section
from canwall.errors import InputError
from canwall.panel.walls import completed, parse_change
from canwall.study import (
    Share,
    Staircase,
    balanced_trials,
    fit_psychometric,
    next_wall,
    share_of,
    stiffness_limits,
)

#: The most trials of a session.
_MOST_TRIALS = 1000
#: Ratios of the stiffness at which a psychometric function is steep, on either side of 1.
_FACTORS = (0.5, 0.71, 0.84, 1.19, 1.41, 2.0)
#: Ratios that a psychometric function needs at the least.
_FEWEST_RATIOS = 3

Question = Literal["stiffer", "free_of_chatter"]
#: What is asked of two walls, and what is said of the one that is chosen.
_QUESTIONS: dict[Question, tuple[str, str]] = {
    "stiffer": ("Which wall is stiffer?", "is stiffer"),
    "free_of_chatter": ("Which wall chatters less?", "chatters less"),
}
Change = dict[str, Any]
Table = tuple[list[str], list[list[Any]]]


class ComparisonRequest(Section):
    """Walls that are compared with a reference, two by two.

    Attributes:
        question: What is asked.
        reference: Change that leads from the wall in force to the reference.
        walls: Changes that lead to the others.
        factors: Without walls: their stiffness over that of the reference.
        repeats: Trials of each pair; an even number is balanced.
        switch: "key": the person switches between the two walls; "strike": each strike does.
        seed: Seed of the random order; None: by chance.
    """

    procedure: Literal["comparison"]
    question: Question = "stiffer"
    reference: WallChange = WallChange()
    walls: Array[tuple[WallChange, ...]] = ()
    factors: Annotated[Array[tuple[Positive, ...]], Field(min_length=1)] = _FACTORS
    repeats: int = Field(4, ge=1, le=100)
    switch: Literal["key", "strike"] = "key"
    seed: int | None = Field(None, ge=0)

    @model_validator(mode="after")
    def _of_one_kind(self) -> Self:
        if self.walls and "factors" in self.model_fields_set:
            raise ValueError("walls and factors are given; keep one of them")
        return self


class StaircaseRequest(Section):
    """Staircases of laws, a wall of one and a wall of another in random order.

    Attributes:
        laws: The laws; empty: the law in force.
        start: See `Staircase`, as the following.
        ceiling: Largest stiffness [N·m/rad].
        finest: Factor of the last steps.
        seed: Seed of the random order; None: by chance.
    """

    procedure: Literal["staircase"]
    laws: Names = ()
    start: Number = 5.0
    ceiling: Number = 500.0
    finest: Number = 1.1
    seed: int | None = Field(None, ge=0)


class Procedure(Protocol):
    """Questions of a session: one trial after another.

    Attributes:
        name: Its name.
        question: What is asked.
        answers: The answers in words.
        columns: Columns of the table of answers.
        restoring: Change that leads back to the wall that was in force.
        trials: Number of trials; None if that depends on the answers.
        switches: True if each strike switches between two walls.
    """

    name: str
    question: str
    answers: dict[str, str]
    columns: tuple[str, ...]
    restoring: Change
    trials: int | None
    switches: bool

    def intervals(self) -> dict[str, Change]:
        """Return the walls of this trial by the names that the person knows; none at the end."""
        ...

    def assignment(self) -> dict[str, Any]:
        """Return which wall is which, for the record."""
        ...

    def row(self, answer: str, cycles: dict[str, int]) -> list[Any]:
        """Return the row of an answer; cycles are those since which the walls were in force."""
        ...

    def take(self, answer: str) -> None:
        """Take an answer and go on to the next trial."""
        ...

    def table(self) -> Table:
        """Return columns and rows of what has been found."""
        ...

    def result(self) -> str:
        """Return what has been found, in words."""
        ...


@dataclass
class _Pair:
    wall: Change
    chosen: int = 0
    trials: int = 0


class TwoAlternatives:
    """Two-alternative comparison: one of two walls is chosen, of which one is the reference."""

    name = "comparison"
    columns: tuple[str, ...] = (
        *("trial", "pair", "question", "reference", "wall", "reference_was"),
        *("answer", "wall_chosen", "cycle_1", "cycle_2"),
    )

    def __init__(self, asked: ComparisonRequest, wall: Wall, random: np.random.Generator) -> None:
        """Prepare the trials. Raises ConfigError for walls that cannot be compared."""
        self._asked = asked
        changes = [asked.reference, *(asked.walls or _by_factor(asked, wall))]
        self._reference, *walls, self.restoring = completed(changes, wall)
        if any(one in walls[:i] for i, one in enumerate(walls)):
            key = "walls" if asked.walls else "factors"
            raise ConfigError(f"{key}: two of them are the same wall; leave one out")
        self._pairs = [_Pair(one) for one in walls]
        trials = len(walls) * asked.repeats
        if trials > _MOST_TRIALS:
            raise ConfigError(f"repeats: {trials} trials; {_MOST_TRIALS} at most")
        self.trials: int | None = trials
        self._order = balanced_trials(len(walls), asked.repeats, random)
        self._at = 0
        self.question, said = _QUESTIONS[asked.question]
        self.answers = {name: f"wall {name} {said}" for name in ("1", "2")}
        self.switches = asked.switch == "strike"
        stiffness = wall.stiffness_nm_per_rad
        self._ratios = [_ratio(self._reference, one, stiffness) for one in walls]

    def intervals(self) -> dict[str, Change]:
        """See `Procedure`."""
        if self._at == len(self._order):
            return {}
        pair, reference_first = self._order[self._at]
        walls = [self._reference, self._pairs[pair].wall]
        return dict(zip("12", walls if reference_first else walls[::-1], strict=True))

    def assignment(self) -> dict[str, Any]:
        """See `Procedure`."""
        pair, reference_first = self._order[self._at]
        return {"pair": pair + 1, "reference": "1" if reference_first else "2"}

    def row(self, answer: str, cycles: dict[str, int]) -> list[Any]:
        """See `Procedure`."""
        pair, _ = self._order[self._at]
        walls = [json.dumps(one) for one in (self._reference, self._pairs[pair].wall)]
        reference = self.assignment()["reference"]
        trial = [self._at + 1, pair + 1, self._asked.question, *walls, reference]
        return [*trial, answer, answer != reference, cycles.get("1"), cycles.get("2")]

    def take(self, answer: str) -> None:
        """See `Procedure`."""
        pair = self._pairs[self._order[self._at].pair]
        pair.trials += 1
        pair.chosen += answer != self.assignment()["reference"]
        self._at += 1

    def table(self) -> Table:
        """See `Procedure`; `ratio` is that of the stiffness to the reference's."""
        columns = ["wall", "ratio", *Share._fields]
        rows = [
            [_words(pair.wall), ratio, *share_of(pair.chosen, pair.trials)]
            for pair, ratio in zip(self._pairs, self._ratios, strict=True)
            if pair.trials
        ]
        return columns, rows

    def result(self) -> str:
        """See `Procedure`."""
        judged = [
            (ratio, pair.chosen, pair.trials)
            for pair, ratio in zip(self._pairs, self._ratios, strict=True)
            if pair.trials and ratio is not None
        ]
        if len({ratio for ratio, _, _ in judged}) < _FEWEST_RATIOS:
            return f"no psychometric function: it takes {_FEWEST_RATIOS} ratios of stiffness"
        fit = fit_psychometric(*(list(column) for column in zip(*judged, strict=True)))
        if fit is None:
            return (
                "no psychometric function: the answers of soft and stiff walls do not overlap, or "
                "do not depend on the stiffness"
            )
        return (
            f"psychometric function: a half at {fit.equal:.3g} times the reference's stiffness, "
            f"75 % a factor of {fit.noticed:.3g} from there"
        )


@dataclass(frozen=True)
class _Answer:
    law: str
    stiffness_nm_per_rad: float
    free_of_chatter: bool


@dataclass
class _Stairs:
    law: str
    walls: Generator[float, bool, None]
    stiffness: float | None

    @classmethod
    def begin(cls, law: str, stairs: Staircase) -> "_Stairs":
        walls = stairs.walls()
        return cls(law, walls, next(walls))


class Staircases:
    """A staircase per law, each up while its walls are free of chatter and down while not."""

    name, question = "staircase", "Is this wall free of chatter?"
    columns: tuple[str, ...] = ("trial", "law", "stiffness_nm_per_rad", "free_of_chatter", "cycle")
    trials: int | None = None
    switches = False

    def __init__(self, asked: StaircaseRequest, wall: Wall, random: np.random.Generator) -> None:
        """Prepare the first wall. Raises ConfigError for stairs that lead nowhere."""
        try:
            stairs = Staircase(asked.start, asked.ceiling, asked.finest)
        except InputError as error:
            raise ConfigError(str(error).removeprefix("--")) from None
        laws = list(dict.fromkeys(asked.laws or (wall.law,)))
        self.answers = {"1": "it is free of chatter", "2": "it chatters"}
        self._random = random
        self._stairs = [_Stairs.begin(law, stairs) for law in laws]
        first = [
            # The law in force keeps its options.
            {"stiffness_nm_per_rad": asked.start} | ({} if law == wall.law else {"law": law})
            for law in laws
        ]
        *self._walls, self.restoring = completed([parse_change(one) for one in first], wall)
        self._answers: list[_Answer] = []
        self._next()

    def intervals(self) -> dict[str, Change]:
        """See `Procedure`."""
        if self._now is None:
            return {}
        stairs = self._stairs[self._now]
        return {"1": self._walls[self._now] | {"stiffness_nm_per_rad": stairs.stiffness}}

    def assignment(self) -> dict[str, Any]:
        """See `Procedure`."""
        stairs = self._at()
        return {"law": stairs.law, "stiffness_nm_per_rad": stairs.stiffness}

    def row(self, answer: str, cycles: dict[str, int]) -> list[Any]:
        """See `Procedure`."""
        stairs = self._at()
        count = len(self._answers) + 1
        return [count, stairs.law, stairs.stiffness, answer == "1", cycles.get("1")]

    def take(self, answer: str) -> None:
        """See `Procedure`."""
        stairs = self._at()
        assert stairs.stiffness is not None
        free = answer == "1"
        self._answers.append(_Answer(stairs.law, stairs.stiffness, free))
        stairs.stiffness = next_wall(stairs.walls, free)
        self._next()

    def table(self) -> Table:
        """See `Procedure`."""
        columns = ["law", "free of chatter up to [N·m/rad]", "chatters from [N·m/rad]", "answers"]
        counts = [answer.law for answer in self._answers]
        rows = [
            [law, free, chatters if math.isfinite(chatters) else None, counts.count(law)]
            for law, (free, chatters) in stiffness_limits(self._answers).items()
        ]
        return columns, rows

    def result(self) -> str:
        """See `Procedure`."""
        unfinished = [stairs.law for stairs in self._stairs if stairs.stiffness is not None]
        return f"not finished: {', '.join(unfinished)}" if unfinished else "all staircases ended"

    def _next(self) -> None:
        """Choose the staircase that goes on."""
        going = [i for i, stairs in enumerate(self._stairs) if stairs.stiffness is not None]
        self._now = int(self._random.choice(going)) if going else None

    def _at(self) -> _Stairs:
        assert self._now is not None
        return self._stairs[self._now]


def _by_factor(asked: ComparisonRequest, wall: Wall) -> Sequence[WallChange]:
    """Return the reference's wall with other stiffnesses."""
    stiffness = asked.reference.stiffness_nm_per_rad
    if stiffness is None:
        stiffness = wall.stiffness_nm_per_rad
    return [
        asked.reference.model_copy(update={"stiffness_nm_per_rad": stiffness * factor})
        for factor in asked.factors
    ]


def _ratio(reference: Change, wall: Change, in_force: float) -> float | None:
    """Return the ratio of the stiffnesses of two walls; None if they differ in other things too."""
    key = "stiffness_nm_per_rad"
    if {**reference, key: 0.0} != {**wall, key: 0.0}:
        return None
    below = reference.get(key, in_force)
    above = wall.get(key, in_force)
    return above / below if above > 0.0 and below > 0.0 else None


def _words(change: Change) -> str:
    """Return a change in the words of a configuration."""
    said = {key: value for key, value in change.items() if value != {}}
    return ", ".join(f"{key} = {_value(value)}" for key, value in said.items())


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
