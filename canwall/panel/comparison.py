"""Blind comparison in a run in progress: which wall is which stays hidden until the end."""

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from canwall.config import ConfigError, Wall, first_error
from canwall.panel.answers import AnswerTable
from canwall.panel.procedures import (
    ComparisonRequest,
    Procedure,
    StaircaseRequest,
    Staircases,
    Table,
    TwoAlternatives,
)

_NONE = "no blind comparison is in progress; begin one"


class Comparison:
    """A person's blind comparison of walls, trial by trial, in one run.

    Answers are on the disk as soon as they are given. Which wall is which goes into the record of
    the run as a mark for each trial, before the first of its walls is in force. Several threads may
    call it.
    """

    def __init__(
        self,
        request: Callable[[dict[str, Any]], int],
        note: Callable[[dict[str, Any]], None],
        folder: Path | None,
    ) -> None:
        """Begin nothing yet.

        Args:
            request: Makes a request of the run and returns the cycle from which on it is in force.
            note: Writes a mark into the record of the run.
            folder: Folder for the tables, that of the run; None: there are none.
        """
        self._request, self._note, self._folder = request, note, folder
        self._lock = threading.RLock()
        self._procedure: Procedure | None = None
        self._answers: AnswerTable | None = None
        self._found: dict[str, Any] = {}
        self._seed = 0
        self._answered = 0
        self._shown: str | None = None
        self._cycles: dict[str, int] = {}

    @property
    def active(self) -> bool:
        """True while law, stiffness and marks have to be hidden."""
        return self._procedure is not None

    def begin(self, given: Mapping[str, Any], wall: Wall) -> None:
        """Begin, and put the first wall into force.

        Args:
            given: Keys of `ComparisonRequest` or `StaircaseRequest`.
            wall: The wall in force; it is put back in the end.

        Raises:
            InputError: If a key is wrong, a comparison is in progress, or its table cannot be
                written.
            ConfigError: If the run refuses the wall.
        """
        with self._lock:
            if self.active:
                raise ConfigError("a blind comparison is in progress; end it first")
            asked = _parse(given)
            by_chance = int(np.random.default_rng().integers(2**32))
            self._seed = by_chance if asked.seed is None else asked.seed
            procedure = _procedure(asked, wall, np.random.default_rng(self._seed))
            if self._folder is not None:
                self._answers = AnswerTable.create(self._folder, procedure.name, procedure.columns)
            self._procedure, self._found, self._answered = procedure, {}, 0
            try:
                self._note({"blind": procedure.name, "seed": self._seed})
                # No other law takes its turn within a trial.
                one = {"law": wall.law, "options": wall.options}
                self._request({"do": "take_turns", "walls": [one]})
                self._present()
            except BaseException:
                self._finish("it could not begin")
                raise

    def show(self, which: str | int) -> int:
        """Put the first or the second wall of the trial into force; return the cycle.

        Raises ConfigError if there is none, or the run refuses it.
        """
        with self._lock:
            walls = self._in_progress().intervals()
            name = str(which)
            if name not in walls:
                raise ConfigError(f"which: has to be {' or '.join(walls)}, not {name}")
            cycle = self._request({"do": "change", **walls[name]})
            self._shown, self._cycles[name] = name, cycle
            return cycle

    def strike_ended(self, began: int) -> None:
        """Show the other wall, if each strike is to do so. Raises ConfigError as `show`.

        Args:
            began: SYNC count at which the strike began; one that began on another wall, as that of
                the trial before, which may end after its answer, does not count.
        """
        with self._lock:
            if self._procedure is None or not self._procedure.switches or not self._shown:
                return
            if began > self._cycles[self._shown]:
                self.show("2" if self._shown == "1" else "1")

    def answer(self, answer: str | int) -> None:
        """Take the answer of a trial and put the next wall into force.

        Raises:
            ConfigError: If it is none of the answers, or not every wall of the trial was in force;
                or, with the answer kept, if the run refuses the next wall: `show` tries it again.
            InputError: If the answer cannot be written; it may be given again.
        """
        with self._lock:
            procedure, given = self._in_progress(), str(answer)
            if given not in procedure.answers:
                known = ", ".join(procedure.answers)
                raise ConfigError(f"answer: has to be one of {known}, not {given}")
            if missing := [name for name in procedure.intervals() if name not in self._cycles]:
                raise ConfigError(f"feel wall {missing[0]} before you answer")
            if self._answers is not None:
                self._answers.add(procedure.row(given, self._cycles))
            procedure.take(given)
            self._answered += 1
            self._shown, self._cycles = None, {}
            self._note({"blind": procedure.name, "trial": self._answered, "answer": given})
            if procedure.intervals():
                self._present()
            else:
                self.end("all trials were answered")

    def end(self, reason: str = "it was ended", *, restore: bool = True) -> None:
        """End the comparison: write the table, and put back the wall that was in force.

        Args:
            reason: Reason, for the record.
            restore: False if the run has ended.

        Raises:
            InputError: If the table cannot be written.
            ConfigError: If the run refuses the wall.
        """
        with self._lock:
            procedure = self._in_progress()
            columns, rows = self._finish(reason)
            try:
                if restore:
                    self._note({"blind": "end", "reason": reason, "answers": self._answered})
                    self._request({"do": "change", **procedure.restoring})
            finally:
                self._write_table(columns, rows)

    def _write_table(self, columns: list[str], rows: list[list[Any]]) -> None:
        if self._answers is not None and rows:
            name = f"{self._answers.path.stem}-table"
            table = AnswerTable.create(self._answers.path.parent, name, columns)
            for row in rows:
                table.add(row)

    def state(self) -> dict[str, Any]:
        """Return what a page may know, as JSON: before the end nothing of the walls."""
        with self._lock:
            procedure = self._procedure
            if procedure is None:
                return {"running": False, **self._found}
            unfelt = [name for name in procedure.intervals() if name not in self._cycles]
            return {
                "running": True,
                "procedure": procedure.name,
                "question": procedure.question,
                "trial": self._answered + 1,
                "trials": procedure.trials,
                "phase": "feel" if unfelt else "answer",
                "text": f"Feel wall {unfelt[0]}." if unfelt else procedure.question,
                "answers": [{"value": v, "text": t} for v, t in procedure.answers.items()],
                "intervals": list(procedure.intervals()),
                "wall": self._shown,
            }

    def _present(self) -> None:
        """Show the first wall of the next trial."""
        procedure = self._in_progress()
        trial = {"blind": procedure.name, "trial": self._answered + 1}
        self._note({**trial, **procedure.assignment()})
        self.show("1")

    def _finish(self, reason: str) -> Table:
        procedure = self._in_progress()
        columns, rows = procedure.table()
        self._found = {
            "phase": "ended",
            "procedure": procedure.name,
            "question": procedure.question,
            "text": reason,
            "columns": columns,
            "rows": rows,
            "result": procedure.result(),
            "seed": self._seed,
            "file": None if self._answers is None else str(self._answers.path),
        }
        self._procedure, self._shown, self._cycles = None, None, {}
        return columns, rows

    def _in_progress(self) -> Procedure:
        if self._procedure is None:
            raise ConfigError(_NONE)
        return self._procedure


def check_comparison(given: Mapping[str, Any], wall: Wall) -> None:
    """Raise InputError if `Comparison.begin` would, whatever the run says."""
    _procedure(_parse(given), wall, np.random.default_rng(0))


def _parse(given: Mapping[str, Any]) -> ComparisonRequest | StaircaseRequest:
    models = {"comparison": ComparisonRequest, "staircase": StaircaseRequest}
    name = given.get("procedure")
    if not isinstance(name, str) or name not in models:
        raise ConfigError(f"procedure: has to be {' or '.join(models)}, not {name!r}")
    model: type[ComparisonRequest] | type[StaircaseRequest] = models[name]  # type: ignore[assignment]
    try:
        return model.model_validate(dict(given))
    except ValidationError as error:
        raise ConfigError(first_error(error, model)) from None


def _procedure(
    asked: ComparisonRequest | StaircaseRequest, wall: Wall, random: np.random.Generator
) -> Procedure:
    if isinstance(asked, ComparisonRequest):
        return TwoAlternatives(asked, wall, random)
    return Staircases(asked, wall, random)
