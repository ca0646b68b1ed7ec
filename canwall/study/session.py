"""Stiffness sweeps on a drive with a person at the handle: what is asked, run, and kept of it.

Each step is a run with a folder of its own; between two steps the drive is disabled. The person
says whether the wall was free of chatter, and the verdicts stand in a table beside what was
measured.
"""

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from canwall.config import Settings
from canwall.cycle import named_law, run_laws, with_law
from canwall.errors import InputError, RunFailedError
from canwall.run import RunResult, run
from canwall.study.terminal import SessionEndedError, Terminal

TABLE = "verdicts.csv"


@dataclass(frozen=True)
class Verdict:
    """What the person said of the strikes of one law in one run, and what was measured of them."""

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
    ended_by: str


class Session:
    """A folder with the runs of one person, and the table of the verdicts, written as they come."""

    def __init__(
        self,
        base: Settings,
        laws: Sequence[str],
        folder: Path,
        seconds: float,
        terminal: Terminal,
    ) -> None:
        """seconds: how long a wall is rendered; none of laws: that of base.

        Raises InputError where the folder cannot be used, ConfigError for a law that is not there.
        """
        self._base = base.model_copy(
            update={
                "schedule": (),
                "run": base.run.model_copy(update={"duration_s": seconds}),
            }
        )
        self.laws = [named_law(with_law(base, law)) for law in laws or [named_law(base)]]
        run_laws(self._settings(self.laws, base.wall.stiffness_nm_per_rad))
        self._folder, self._terminal = folder, terminal
        self._steps = 0
        self.verdicts: list[Verdict] = []
        self.table = folder / TABLE
        try:
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
        """Render one wall, the laws taking turns from strike to strike; which of them were free.

        Strikes go by their number, so that the person does not know the law. A law that had no
        strike before the wall ended by itself is left out. Raises SessionEndedError,
        KeyboardInterrupt, and what `run` raises.
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
            heard = self._heard(result, laws)
            if heard is None:
                continue
            for law, free in heard.items():
                self._keep(result, law, stiffness, free)
            return heard

    def _settings(self, laws: Sequence[str], stiffness: float) -> Settings:
        settings = with_law(self._base, laws[0])
        wall = {"stiffness_nm_per_rad": stiffness, "alternate": tuple(laws[1:])}
        return settings.model_copy(update={"wall": settings.wall.model_copy(update=wall)})

    def _run(self, settings: Settings, stiffness: float) -> RunResult:
        """Raises SessionEndedError and KeyboardInterrupt where more than the wall was ended."""
        typed: list[str | None] = []

        def stopped() -> bool:
            line = self._terminal.pressed()
            if line in ("", "q"):
                typed.append(line)
            return bool(typed)

        self._terminal.discard_input()
        result = run(
            settings, self._folder / f"{self._steps:02d}-K{stiffness:.4g}", stopped=stopped
        )
        outcome = result.outcome
        if not outcome.disabled:
            raise RunFailedError("; ".join(outcome.trips))
        if outcome.interrupted:
            self._terminal.say("The drive is disabled.")
            if not typed:
                raise KeyboardInterrupt
            if typed[0] == "q":
                raise SessionEndedError
        for trip in outcome.trips:
            self._terminal.say(f"The wall ended by itself: {trip}")
        return result

    def _heard(self, result: RunResult, laws: Sequence[str]) -> dict[str, bool] | None:
        """What the person says of each law; None: once more."""
        strikes = result.summary["strikes"]
        numbers = {law: _numbers(strikes, law) for law in laws}
        met = [law for law in laws if numbers[law]]
        if not met or (len(met) < len(laws) and not result.outcome.trips):
            self._terminal.say("Not every law had a strike: once more.")
            return None
        heard = {}
        for law in met:
            which = "The wall" if len(laws) == 1 else f"Strikes {_listed(numbers[law])}"
            answer = self._terminal.ask(
                f"{which}: free of chatter? y, n, again:", ("y", "n", "again")
            )
            if answer == "again":
                return None
            heard[law] = answer == "y"
        return heard

    def _keep(self, result: RunResult, law: str, stiffness: float, free: bool) -> None:
        strikes = [s for s in result.summary["strikes"] if _is(s, law)]
        chattering = [s for s in strikes if s["chatter"]]
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
            "; ".join(result.outcome.trips),
        )
        self.verdicts.append(verdict)
        with self.table.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(asdict(verdict).values())


def _is(strike: dict[str, Any], law: str) -> bool:
    return bool(strike["law"] == law)


def _numbers(strikes: Sequence[dict[str, Any]], law: str) -> list[int]:
    return [number for number, strike in enumerate(strikes, start=1) if _is(strike, law)]


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))
