"""Session of a study: walls rendered one after another, each judged by the person at the handle.

Each step is a run with a folder of its own; between two steps the drive is disabled. The person
says whether the wall was free of chatter; the table of verdicts has the answer next to the
measured quantities.
"""

import csv
import errno
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from canwall.config import Settings
from canwall.cycle import named_law, run_laws, with_law
from canwall.errors import InputError, RunFailedError
from canwall.run import RunResult, run
from canwall.study.terminal import SessionEndedError, Terminal

#: Name of the table of verdicts in the folder of a session.
TABLE = "verdicts.csv"


@dataclass(frozen=True)
class Verdict:
    """Answer of the person for the strikes of one law in one run, and the measured quantities."""

    step: int
    run: str
    law: str
    stiffness_nm_per_rad: float
    strikes: int
    free_of_chatter: bool
    measured_chatter: bool
    chatter_reason: str
    energy_out_j: float
    peak_force_nm: float
    felt_ripple_n: float | None
    ended_by: str


class Session:
    """Runs of one person in a folder, with a table of verdicts that is written as they come."""

    def __init__(
        self,
        base: Settings,
        laws: Sequence[str],
        folder: Path,
        seconds: float,
        terminal: Terminal,
    ) -> None:
        """Create the folder and its table.

        Args:
            base: Configuration of the runs; its schedule is not used.
            laws: Names of the laws to judge; empty: the law of `base`.
            folder: Folder of the session.
            seconds: Time for which each wall is rendered [s].
            terminal: Terminal of the person.

        Raises:
            InputError: If the folder holds a session or cannot be written.
            ConfigError: If a law does not exist.
        """
        self._base = base.model_copy(
            update={
                "schedule": (),
                "run": base.run.model_copy(update={"duration_s": seconds}),
            }
        )
        named = (named_law(with_law(base, law)) for law in laws or [named_law(base)])
        self.laws = list(dict.fromkeys(named))
        run_laws(self._settings(self.laws, base.wall.stiffness_nm_per_rad))
        self._folder, self._terminal = folder, terminal
        self._steps = 0
        self.verdicts: list[Verdict] = []
        #: What runs could not put back in the drive, and what their records lack.
        self.troubles: list[str] = []
        self.table = folder / TABLE
        try:
            if os.path.lexists(folder) and not folder.is_dir():
                raise NotADirectoryError(errno.EEXIST, "it is a file")
            folder.mkdir(parents=True, exist_ok=True)
            with self.table.open("x", newline="", encoding="utf-8") as file:
                csv.writer(file).writerow(field.name for field in fields(Verdict))
        except FileExistsError:
            raise InputError(
                f"{folder}: holds a session already; choose another --output"
            ) from None
        except OSError as error:
            raise InputError(f"{folder}: cannot be written: {error.strerror}") from None

    def step(self, laws: Sequence[str], stiffness: float) -> dict[str, bool]:
        """Render one wall, the laws taking turns from strike to strike, and ask for the verdicts.

        Questions refer to strikes by number, so that the person does not learn the law.

        Args:
            laws: Laws that take turns.
            stiffness: Stiffness of the wall [N·m/rad].

        Returns:
            True for each law whose strikes were free of chatter. A law without a strike, because
            the run tripped before its turn, is missing.

        Raises:
            SessionEndedError: If the person ended the session.
            KeyboardInterrupt: On Ctrl-C.
            RunFailedError: If the drive could not be disabled, or as `run` does.
        """
        while True:
            settings = self._settings(laws, stiffness)
            self._steps += 1
            strikes = "Strike and press" if len(laws) == 1 else f"Strike {len(laws)} times or more"
            self._terminal.say(
                f"\nStep {self._steps}: K = {stiffness:.4g} N·m/rad, for "
                f"{settings.run.duration_s:g} s. {strikes}; Enter stops the wall, q and Enter "
                "or Ctrl-C end the session."
            )
            self._terminal.ask("Hand off the handle. Enter begins, q ends:", ("",))
            result = self._run(settings, stiffness)
            answers: dict[str, bool] = {}
            once_more = False
            try:
                once_more = not self._ask_for_verdicts(result, laws, answers)
            finally:
                # Whoever ends the session meanwhile has given the answers before that.
                if not once_more:
                    for law, free in answers.items():
                        self._record_verdict(result, law, stiffness, free)
            if not once_more:
                return answers

    def _settings(self, laws: Sequence[str], stiffness: float) -> Settings:
        settings = with_law(self._base, laws[0])
        wall = {"stiffness_nm_per_rad": stiffness, "alternate": tuple(laws[1:])}
        return settings.model_copy(update={"wall": settings.wall.model_copy(update=wall)})

    def _run(self, settings: Settings, stiffness: float) -> RunResult:
        """Render one wall.

        Raises SessionEndedError or KeyboardInterrupt if not only the wall was ended.
        """
        typed: list[str | None] = []

        def stopped() -> bool:
            line = self._terminal.poll_line()
            if line in ("", "q"):
                typed.append(line)
            return bool(typed)

        self._terminal.discard_input()
        result = run(
            settings, self._folder / f"{self._steps:02d}-K{stiffness:.4g}", stopped=stopped
        )
        outcome = result.outcome
        troubles = (*result.not_restored, *result.notes)
        self.troubles += [trouble for trouble in troubles if trouble not in self.troubles]
        if not outcome.disabled:
            raise RunFailedError("; ".join(outcome.trips))
        if outcome.interrupted:
            self._terminal.say("The drive is disabled.")
            if not typed:
                raise KeyboardInterrupt
            if typed[0] == "q":
                raise SessionEndedError
        for trip in outcome.trips:
            self._terminal.say(f"The run tripped: {trip}")
        return result

    def _ask_for_verdicts(
        self, result: RunResult, laws: Sequence[str], answers: dict[str, bool]
    ) -> bool:
        """Ask if each law was free of chatter, into `answers`; False to render the wall again."""
        strikes = result.summary["strikes"]
        numbers = {law: _strike_numbers(strikes, law) for law in laws}
        struck = [law for law in laws if numbers[law]]
        if not struck or (len(struck) < len(laws) and not result.outcome.trips):
            self._terminal.say("Not every law had a strike (--seconds is how long): once more.")
            return False
        for law in struck:
            listed = ", ".join(map(str, numbers[law]))
            which = "The wall" if len(laws) == 1 else f"Strikes {listed}"
            answer = self._terminal.ask(
                f"{which}: free of chatter? y, n, again:", ("y", "n", "again")
            )
            if answer == "again":
                return False
            answers[law] = answer == "y"
        return True

    def _record_verdict(self, result: RunResult, law: str, stiffness: float, free: bool) -> None:
        strikes = [strike for strike in result.summary["strikes"] if strike["law"] == law]
        chattering = [strike for strike in strikes if strike["chatter"]]
        verdict = Verdict(
            self._steps,
            result.folder.path.name,
            law,
            stiffness,
            len(strikes),
            free,
            bool(chattering),
            chattering[0]["chatter_reason"] if chattering else "",
            max(s["energy_out_max_j"] for s in strikes),
            max(s["peak_force_nm"] for s in strikes),
            max(
                (s["felt_ripple_n"] for s in strikes if s["felt_ripple_n"] is not None),
                default=None,
            ),
            "; ".join(result.outcome.trips),
        )
        self.verdicts.append(verdict)
        with self.table.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(asdict(verdict).values())


def _strike_numbers(strikes: Sequence[dict[str, Any]], law: str) -> list[int]:
    return [number for number, strike in enumerate(strikes, start=1) if strike["law"] == law]
