"""`canwall study` with a script for the person: prompts, ways to end, verdicts."""

import csv
import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import COMMAND, PATIENCE_S, Record, config_file, torque_is_on, wait_for
from fork_server import ForkedPopen
from hypothesis import example, given
from hypothesis import strategies as st
from rig import SIM_CONFIG, eds_with

from canwall.config import load
from canwall.errors import InputError
from canwall.study.session import Session, Verdict
from canwall.study.staircase import Staircase, stiffness_limits
from canwall.study.terminal import SessionEndedError, Terminal

BEGINS, STRUCK = "Enter begins, q ends: ", "y, n, again: "
COMPARED = "1, 2: "
#: The simulated hand strikes once a second.
ONE, TWO, FOR_EVER = 1.0, 2.0, 1e6

#: Changes of config/sim.toml: frames may be late, for the machine has other things to do.
PATIENT = {"hold_cycles = 2": "hold_cycles = 100", "late_cycles = 50": "late_cycles = 0"}
#: And time passes by the clock: a wall without an end has no record of hours. What a handle does
#: while nobody has time for it is no fault of the encoder.
BY_THE_CLOCK = PATIENT | {
    'pace = "auto"': 'pace = "real_time"',
    "watchdog_s = 0.1 ": "watchdog_s = 5.0 ",
    "stuck_rad = 0.0006": "stuck_rad = 0.0",
    "speed_rad_s = 60.0": "speed_rad_s = 6000.0",
}


pytestmark = pytest.mark.slow


class Person:
    """A study in a process of its own: reads its prompts and answers them."""

    def __init__(
        self, study: str, folder: Path, *arguments: object, config: Path | None = None
    ) -> None:
        self.folder = folder
        config = config or config_file(folder.parent / "sim.toml", PATIENT)
        options = ["--output", folder, *map(str, arguments)]
        self.process = ForkedPopen[str](
            [COMMAND, "study", study, config, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.words = self.process.stderr if "--json" in arguments else self.process.stdout

    def read_to(self, *prompts: str) -> str:
        """Everything printed up to one of the prompts, or to the end."""
        assert self.words is not None
        said = ""
        while not said.endswith(prompts):
            letter = self.words.read(1)
            if not letter:
                return said
            said += letter
        return said

    def type(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def end(self) -> tuple[int, str, str]:
        said, errors = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, said, errors

    @property
    def verdicts(self) -> list[dict[str, str]]:
        with (self.folder / "verdicts.csv").open(encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def is_pressed(self, run: str) -> None:
        """Wait until the wall has given torque, more than any probe."""
        wait_for(lambda: torque_is_on(self.folder / run / "bus.log", above=64))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "session"


@pytest.fixture
def people() -> Iterator[list[Person]]:
    started: list[Person] = []
    yield started
    for person in started:
        person.process.kill()
        person.process.communicate()


def test_a_staircase(folder: Path, people: list[Person]) -> None:
    person = Person(
        *("staircase", folder, "--law", "standard", "--seconds", ONE),
        *("--start", 10, "--ceiling", 40, "--finest", 2),
    )
    people.append(person)
    asked = []
    while (said := person.read_to(BEGINS, STRUCK)).endswith((BEGINS, STRUCK)):
        if said.endswith(BEGINS):
            asked.append(float(re.findall(r"K = (\S+) N·m/rad", said)[0]))
            person.type("")
        else:
            person.type("y" if asked[-1] < 15.0 else "n")
    assert person.end() == (0, "", "")
    assert asked == [10, 20]
    assert re.search(r"standard │ +10 N·m/rad │ +20 N·m/rad", said)
    assert [v["run"] for v in person.verdicts] == ["01-K10", "02-K20"]
    assert [v["free_of_chatter"] for v in person.verdicts] == ["True", "False"]
    for verdict in person.verdicts:
        record = Record(folder / verdict["run"])
        (strike,) = record.summary["strikes"]
        assert verdict["law"] == strike["law"] == "standard"
        assert float(verdict["stiffness_nm_per_rad"]) == strike["stiffness"]
        assert verdict["measured_chatter"] == str(strike["chatter"])
        assert float(verdict["energy_out_j"]) == strike["energy_out_max_j"]
        assert (folder / verdict["run"] / "run.png").exists()
    assert [v["measured_chatter"] for v in person.verdicts] == ["False", "True"]


def test_as_json(folder: Path, people: list[Person]) -> None:
    walls = ("--start", 10, "--ceiling", 10, "--seconds", ONE)
    person = Person("staircase", folder, "--law", "standard", *walls, "--json")
    people.append(person)
    person.read_to(BEGINS)
    person.type("")
    person.read_to(STRUCK)
    person.type("y")
    code, said, _ = person.end()
    assert code == 0
    found = json.loads(said)
    assert found["limits"] == {"standard": {"free_of_chatter_up_to": 10.0, "chatters_from": None}}
    (verdict,) = found["verdicts"]
    assert (verdict["run"], verdict["free_of_chatter"]) == ("01-K10", True)
    assert Path(found["table"]) == folder / "verdicts.csv"


def test_laws_in_turn(folder: Path, people: list[Person]) -> None:
    laws = ("standard", "half_sample+deadbeat")
    person = Person(
        *("alternating", folder, "--law", laws[0], "--law", laws[1]),
        *("--stiffness", "60,50,70", "--seconds", TWO),
    )
    people.append(person)
    said = person.read_to(BEGINS)
    person.type("")
    said += person.read_to(STRUCK)
    assert said.endswith("Strikes 1: free of chatter? y, n, again: ")
    person.type("maybe")
    said += person.read_to(STRUCK)
    person.type("n")
    said += person.read_to(STRUCK)
    assert said.endswith("Strikes 2: free of chatter? y, n, again: ")
    assert not any(law in said for law in laws)
    # Once more, with other verdicts.
    person.type("again")
    person.read_to(BEGINS)
    person.type("")
    for answer in ("n", "y"):
        person.read_to(STRUCK)
        person.type(answer)
    person.read_to(BEGINS)
    person.type("")
    assert "The wall: free of chatter?" in person.read_to(STRUCK)
    person.type("n")
    code, said, errors = person.end()
    assert (code, errors) == (0, "")
    assert re.search(r"standard +│ +– │ +50 N·m/rad", said)
    assert re.search(r"half_sample\+deadbeat │ +50 N·m/rad │ +60 N·m/rad", said)
    found = [(v["step"], v["law"], v["free_of_chatter"]) for v in person.verdicts]
    assert found == [
        *(("2", laws[0], "False"), ("2", laws[1], "True"), ("3", laws[1], "False")),
    ]


def test_answers_before_the_end_of_a_session_are_kept(folder: Path, people: list[Person]) -> None:
    laws = ("--law", "standard", "--law", "mean_force")
    person = Person("alternating", folder, *laws, "--stiffness", "60,50", "--seconds", TWO)
    people.append(person)
    person.read_to(BEGINS)
    person.type("")
    person.read_to(STRUCK)
    person.type("n")
    person.read_to(STRUCK)
    person.type("q")
    code, said, errors = person.end()
    assert (code, errors) == (0, "")
    assert "1 verdicts" in said
    assert [(v["law"], v["free_of_chatter"]) for v in person.verdicts] == [("standard", "False")]


def test_a_file_is_no_folder_of_a_session(folder: Path) -> None:
    folder.touch()
    code, _, errors = Person("staircase", folder).end()
    assert (code, errors) == (2, f"canwall: {folder}: cannot be written: it is a file\n")


def test_a_law_that_is_given_twice_is_judged_once(folder: Path) -> None:
    laws = ["standard", "damped", "standard"]
    session = Session(load(SIM_CONFIG), laws, folder, ONE, Terminal())
    assert session.laws == ["standard", "damped"]


def test_a_blind_comparison(folder: Path, people: list[Person]) -> None:
    config = config_file(folder.parent / "sim.toml", BY_THE_CLOCK)
    person = Person(
        *("comparison", folder, "--factor", 0.5, "--factor", 2, "--repeats", 1, "--seed", 1),
        config=config,
    )
    people.append(person)
    said = person.read_to(COMPARED)
    assert "Trial 1 of 2, wall 1." in said
    person.type("2")
    assert "feel wall 2 before you answer" in person.read_to(COMPARED)
    for trial in (1, 2):
        person.type("")
        said += person.read_to(COMPARED)
        assert f"Trial {trial} of 2, wall 2." in said
        assert not re.search("25|100", said)
        person.type("2")
        said += person.read_to(COMPARED)
    code, _, errors = person.end()
    assert (code, errors) == (0, "")
    record = Record(folder)
    assert record.summary["trips"] == []
    with (folder / "comparison.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    stiffness = dict(zip(record.column("j"), record.column("stiffness"), strict=True))
    for row in rows:
        walls = [json.loads(row[name])["stiffness_nm_per_rad"] for name in ("reference", "wall")]
        if row["reference_was"] == "2":
            walls.reverse()
        assert [stiffness[int(row[cycle])] for cycle in ("cycle_1", "cycle_2")] == walls
        assert row["wall_chosen"] == str(row["reference_was"] == "1")
    assert {json.loads(row["wall"])["stiffness_nm_per_rad"] for row in rows} == {25.0, 100.0}


def assert_ended(folder: Path) -> None:
    """The run in the folder was ended, and its last frames show the drive disabled."""
    record = Record(folder)
    assert record.summary["interrupted"]
    assert not record.summary["trips"]
    *_, (tpdo, rpdo) = record.cycles
    assert rpdo[2:4] == b"\0\0"
    # Statusword: no longer OPERATION ENABLED.
    assert tpdo is not None
    assert tpdo[4] & 0x07 != 0x07


def test_enter_ends_a_wall_and_q_the_session(folder: Path, people: list[Person]) -> None:
    config = config_file(folder.parent / "sim.toml", BY_THE_CLOCK)
    person = Person("staircase", folder, "--seconds", FOR_EVER, config=config)
    people.append(person)
    person.read_to(BEGINS)
    person.type("")
    person.is_pressed("01-K5")
    person.type("")
    assert "The drive is disabled." in person.read_to(STRUCK)
    person.type("n")
    person.read_to(BEGINS)
    person.type("")
    person.is_pressed("02-K2.5")
    person.type("q")
    code, said, errors = person.end()
    assert (code, errors) == (0, "")
    assert "The drive is disabled." in said
    assert "free of chatter?" not in said
    assert "1 verdicts" in said
    assert_ended(folder / "01-K5")
    assert_ended(folder / "02-K2.5")


@pytest.mark.parametrize("way", ["Ctrl-C", "no terminal"])
def test_a_wall_ends_with_its_person(folder: Path, people: list[Person], way: str) -> None:
    config = config_file(folder.parent / "sim.toml", BY_THE_CLOCK)
    person = Person("staircase", folder, "--seconds", FOR_EVER, config=config)
    people.append(person)
    person.read_to(BEGINS)
    person.type("")
    person.is_pressed("01-K5")
    if way == "Ctrl-C":
        os.kill(person.process.pid, signal.SIGINT)
    else:
        assert person.process.stdin is not None
        person.process.stdin.close()
        person.process.stdin = None
    code, said, errors = person.end()
    assert (code, errors) == (130 if way == "Ctrl-C" else 0, "")
    assert "The drive is disabled." in said
    assert "0 verdicts" in said
    assert_ended(folder / "01-K5")


def test_a_drive_that_is_not_restored_is_told_in_the_end(
    folder: Path, people: list[Person], tmp_path: Path
) -> None:
    odd = {("1800sub3", "DefaultValue"): "20\nHighLimit=10"}
    eds = eds_with(tmp_path / "odd.eds", odd)
    changes = PATIENT | {'"../eds/canwall-drive.eds"': f'"{eds}"\nrestore = true'}
    config = config_file(tmp_path / "config.toml", changes)
    person = Person("staircase", folder, "--seconds", ONE, config=config)
    people.append(person)
    person.read_to(BEGINS)
    person.type("")
    person.read_to(STRUCK)
    person.type("y")
    person.read_to(BEGINS)
    person.type("q")
    code, _, errors = person.end()
    assert code == 1
    assert errors.startswith("canwall: node 5: not restored: writing 0x14 to 0x1800:03")


@pytest.mark.parametrize(("of_the_file", "first"), [("50.0", "5"), ("2.0", "2")])
def test_ctrl_c_between_two_walls(
    folder: Path, people: list[Person], of_the_file: str, first: str
) -> None:
    walls = {"stiffness_nm_per_rad = 50.0": f"stiffness_nm_per_rad = {of_the_file}"}
    person = Person("staircase", folder, config=config_file(folder.parent / "a.toml", walls))
    people.append(person)
    assert f"K = {first} N·m/rad" in person.read_to(BEGINS)
    os.kill(person.process.pid, signal.SIGINT)
    code, said, errors = person.end()
    assert (code, errors) == (130, "")
    assert "0 verdicts" in said


@pytest.mark.parametrize(
    ("study", "arguments", "line"),
    [
        ("staircase", "--law none", "wall.law: unknown law 'none'"),
        ("staircase", "--output /proc/none", "/proc/none: cannot be written"),
        ("alternating", "--stiffness 5,5", "--stiffness: has a value twice"),
        ("comparison", "--factor 2 --factor -1", "--factor: has to be greater than 0, not -1"),
        ("comparison", "--factor 2 --factor 2", "--factor: two of them are the same wall"),
        ("comparison", "--law damped --law damped", "--law: two of them are the same wall"),
        ("comparison", "--law damped --factor 2", "--law and --factor: keep one of them"),
        ("comparison", "--law none", "wall.law: unknown law 'none'"),
        ("comparison", "--repeats 0", "--repeats: has to be greater than or equal to 1"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    folder: Path, study: str, arguments: str, line: str
) -> None:
    code, _, errors = Person(study, folder, *arguments.split()).end()
    assert code == 2
    assert errors.startswith(f"canwall: {line}")
    assert len(errors.splitlines()) == 1
    assert not folder.exists()


def test_a_folder_with_a_session_is_left_alone(folder: Path) -> None:
    folder.mkdir()
    (folder / "verdicts.csv").write_text("mine")
    code, _, errors = Person("staircase", folder).end()
    assert code == 2
    assert errors == f"canwall: {folder}: holds a session already; choose another --output\n"
    assert (folder / "verdicts.csv").read_text() == "mine"


@example(limit=0.5, start=46.0, ceiling=50.0, finest=1.25)
@given(
    limit=st.floats(0.5, 1000.0),
    start=st.floats(1.0, 50.0),
    ceiling=st.floats(50.0, 500.0),
    finest=st.floats(1.01, 3.0),
)
def test_a_staircase_ends_at_the_limit(
    limit: float, start: float, ceiling: float, finest: float
) -> None:
    asked: list[float] = []

    def is_free(stiffness: float) -> bool:
        asked.append(stiffness)
        return stiffness < limit

    Staircase(start, ceiling, finest).climb(is_free)
    assert max(asked) <= ceiling
    if limit > ceiling:
        assert asked[-1] == ceiling
    elif limit < min(asked):
        assert asked[-1] < start / 64.0
    else:
        one, other = sorted(asked[-2:])
        assert one < limit <= other
        assert other <= one * finest * (1.0 + 1e-12)


def test_who_errs_once_is_brought_back() -> None:
    asked: list[float] = []

    def is_free(stiffness: float) -> bool:
        asked.append(stiffness)
        return stiffness < 100.0 and len(asked) != 2

    Staircase(5.0, 500.0, 1.1).climb(is_free)
    assert min(asked[-2:]) < 100.0 <= max(asked[-2:])


def test_limits_are_the_stiffest_free_and_the_softest_that_is_not() -> None:
    def verdict(law: str, stiffness: float, free: bool) -> Verdict:
        return Verdict(1, "", law, stiffness, 1, free, False, "", 0.0, 0.0, None, "")

    said = [verdict("a", 5, True), verdict("a", 20, False), verdict("a", 10, True)]
    assert stiffness_limits([*said, verdict("b", 5, False)]) == {"a": (10, 20), "b": (0.0, 5)}
    assert stiffness_limits([]) == {}


@pytest.mark.parametrize(
    ("start", "ceiling", "finest", "what"),
    [
        (0.0, 10.0, 1.1, "--start 0: has to be above 0"),
        (20.0, 10.0, 1.1, "at most the ceiling, 10"),
        (1.0, float("inf"), 1.1, "--ceiling inf: has to be a finite number above 0"),
        (-1.0, -1.0, 1.1, "--ceiling -1: has to be a finite number above 0"),
        (1.0, 2.0, 1.0, "--finest 1: has to be a factor above 1"),
    ],
)
def test_impossible_steps(start: float, ceiling: float, finest: float, what: str) -> None:
    with pytest.raises(InputError, match=what):
        Staircase(start, ceiling, finest)


@pytest.fixture
def keyboard() -> Iterator[tuple[Terminal, Any]]:
    reading, writing = os.pipe()
    with os.fdopen(writing, "w", buffering=1) as keys:
        yield Terminal(reading), keys
    os.close(reading)


def test_what_was_typed_before_is_no_answer(keyboard: tuple[Terminal, Any]) -> None:
    terminal, keys = keyboard
    keys.write("y\n\nq\nhalf a line")
    terminal.discard_input()
    assert terminal.poll_line() is None
    keys.write("N \n")
    assert terminal.ask("?", ("y", "n")) == "n"


def test_lines_while_a_wall_is_rendered(
    keyboard: tuple[Terminal, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("canwall.study.terminal._POLL_INTERVAL_S", 0.0)
    terminal, keys = keyboard
    assert terminal.poll_line() is None
    keys.write("q")
    assert terminal.poll_line() is None
    keys.write("\n\n")
    assert [terminal.poll_line(), terminal.poll_line(), terminal.poll_line()] == ["q", "", None]
    keys.close()
    assert [terminal.poll_line(), terminal.poll_line()] == ["q", "q"]
    with pytest.raises(SessionEndedError):
        terminal.ask("?", ("",))
