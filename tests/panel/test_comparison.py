"""Blind comparison and staircases: what is shown, what stays hidden, what is kept."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canwall.config import ConfigError, Limits, Wall, WallChange, parse_request
from canwall.errors import InputError
from canwall.panel.ab import AB
from canwall.panel.comparison import Comparison
from canwall.panel.walls import completed
from canwall.record.live import LiveLaw
from canwall.study import Staircase

LIMITS = Limits(torque_nm=1.0)
IN_FORCE = Wall(law="mean_force", stiffness_nm_per_rad=50.0, options={"x": 0.5}, damping_ratio=0.3)


class Run:
    """A run that takes every change, unless it is told to refuse the next one."""

    def __init__(self, wall: Wall = IN_FORCE) -> None:
        self.wall, self.cycle, self.refuses = wall, 0, False
        self.requests: list[dict[str, Any]] = []
        self.marks: list[dict[str, Any]] = []

    def request(self, asked: dict[str, Any]) -> int:
        if self.refuses:
            self.refuses = False
            raise ConfigError("the run refuses it")
        self.requests.append(asked)
        request = parse_request(asked)
        change = request if isinstance(request, WallChange) else WallChange()
        wall = change.applied_to(self.wall, LIMITS)[0]
        self.wall = Wall.model_validate(wall.model_dump())
        self.cycle += 100
        return self.cycle

    def note(self, mark: dict[str, Any]) -> None:
        assert len(json.dumps(mark)) <= 200
        self.marks.append(mark)


def comparison(run: Run, folder: Path | None = None, **asked: Any) -> Comparison:
    made = Comparison(run.request, run.note, folder)
    made.begin({"procedure": "comparison", "seed": 7, **asked}, run.wall)
    return made


def rows(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def answer_all(made: Comparison, run: Run, wanted: Any) -> list[dict[str, Any]]:
    """Answer each trial by the stiffnesses of both walls; return what a page saw meanwhile."""
    seen = []
    while made.active:
        seen.append(made.state())
        first = run.wall
        made.show("2")
        seen.append(made.state())
        made.answer("1" if wanted(first, run.wall) else "2")
    return seen


changes = st.fixed_dictionaries(
    {},
    optional={
        "law": st.sampled_from(["standard", "half_sample"]),
        "options": st.just({"y": 1.0}),
        "stiffness_nm_per_rad": st.floats(1.0, 100.0),
        "damping_nm_s_per_rad": st.floats(0.0, 0.1),
        "damping_ratio": st.floats(0.1, 1.0),
        "cap": st.sampled_from([0.0, 0.8]),
        "tension": st.sampled_from(["allow", "clamp"]),
        "deadbeat": st.booleans(),
    },
).filter(lambda one: not (one.get("damping_ratio") and one.get("damping_nm_s_per_rad")))


@given(
    st.lists(changes, min_size=1, max_size=4),
    st.lists(st.integers(0, 4)),
    st.sampled_from([0.0, 0.4]),
)
def test_a_wall_is_the_same_whatever_came_before_it(
    given: list[dict[str, Any]], order: list[int], ratio: float
) -> None:
    base = IN_FORCE.model_copy(update={"damping_ratio": ratio})
    asked = [WallChange.model_validate(one) for one in given]
    full = completed(asked, base)
    expected = [change.applied_to(base, LIMITS)[0] for change in [*asked, WallChange()]]

    def felt(wall: Wall) -> dict[str, Any]:
        # A damping without effect, because there is a ratio.
        unused = {"damping_nm_s_per_rad"} if wall.damping_ratio else set()
        return wall.model_dump(exclude=unused)

    run = Run(base)
    for i in order:
        i %= len(full)
        run.request({"do": "change", **full[i]})
        assert felt(run.wall) == felt(expected[i])


def test_a_person_who_feels_everything(tmp_path: Path) -> None:
    run = Run()
    made = comparison(run, tmp_path, factors=[0.5, 0.8, 1.25, 2.0], repeats=6)
    seen = answer_all(
        made, run, lambda one, other: one.stiffness_nm_per_rad > other.stiffness_nm_per_rad
    )
    assert not any(
        word in json.dumps(state) for state in seen for word in ("stiffness_", "law", "50", "100")
    )
    assert [state["phase"] for state in seen[:2]] == ["feel", "answer"]
    end = made.state()
    assert [dict(zip(end["columns"], row, strict=True))["chosen"] for row in end["rows"]] == [
        *(0, 0, 6, 6)
    ]
    assert "do not overlap" in end["result"]
    assert run.wall == IN_FORCE
    kept = rows(tmp_path, "comparison.csv")
    assert len(kept) == 24
    for trial, row in enumerate(kept, start=1):
        assert row["trial"] == str(trial)
        assigned, answered = (m for m in run.marks if m.get("trial") == trial)
        assert assigned["reference"] == row["reference_was"]
        assert answered["answer"] == row["answer"]
        # What was in force, as the run has it.
        shown = [row["reference"], row["wall"]]
        if row["reference_was"] == "2":
            shown.reverse()
        for cycle, wall in zip((row["cycle_1"], row["cycle_2"]), shown, strict=True):
            asked = run.requests[int(cycle) // 100 - 1]
            assert {"do": "change", **json.loads(wall)} == asked
    for pair in range(1, 5):
        of_pair = [row for row in kept if row["pair"] == str(pair)]
        assert [row["reference_was"] for row in of_pair].count("1") == 3
    for block in range(6):
        assert {row["pair"] for row in kept[4 * block : 4 * block + 4]} == {"1", "2", "3", "4"}
    table = rows(tmp_path, "comparison-table.csv")
    assert [row["chosen"] for row in table] == ["0", "0", "6", "6"]


def test_no_other_law_takes_its_turn_in_a_comparison() -> None:
    run = Run()
    comparison(run)
    turns, change = run.requests
    assert turns == {
        "do": "take_turns",
        "walls": [{"law": IN_FORCE.law, "options": IN_FORCE.options}],
    }
    assert change["do"] == "change"


def test_a_person_who_guesses_has_a_function(tmp_path: Path) -> None:
    run, random = Run(), np.random.default_rng(3)
    made = comparison(run, tmp_path, repeats=50, factors=[0.6, 0.8, 1.25, 1.6])

    def stiffer(one: Wall, other: Wall) -> bool:
        ratio = one.stiffness_nm_per_rad / other.stiffness_nm_per_rad
        return bool(np.log(ratio) + random.normal(0.0, 0.3) > 0.0)

    answer_all(made, run, stiffer)
    words = made.state()["result"].split()
    # 0.6745 standard deviations of 0.3 in the logarithm.
    assert float(words[words.index("at") + 1]) == pytest.approx(1.0, abs=0.1)
    assert float(words[words.index("of") + 1]) == pytest.approx(np.exp(0.6745 * 0.3), abs=0.1)


def test_answers_survive_whatever_happens(tmp_path: Path) -> None:
    run = Run()
    made = comparison(run, tmp_path, switch="strike")
    with pytest.raises(ConfigError, match="feel wall 2"):
        made.answer(1)
    made.strike_ended(run.cycle)  # it began before the wall was in force
    assert made.state()["wall"] == "1"
    made.strike_ended(run.cycle + 1)
    assert made.state()["wall"] == "2"
    run.refuses = True
    with pytest.raises(ConfigError, match="the run refuses it"):
        made.answer(1)
    assert len(rows(tmp_path, "comparison.csv")) == 1
    assert (made.state()["trial"], made.state()["wall"]) == (2, None)
    made.show(1)
    made.strike_ended(run.cycle + 1)
    table = tmp_path / "comparison.csv"
    kept = table.read_bytes()
    table.unlink()
    table.mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        made.answer(2)
    table.rmdir()
    table.write_bytes(kept)
    made.answer(2)
    assert [row["answer"] for row in rows(tmp_path, "comparison.csv")] == ["1", "2"]
    made.end()
    assert (made.active, run.wall) == (False, IN_FORCE)
    assert sum(row[3] for row in made.state()["rows"]) == 2
    with pytest.raises(ConfigError, match="begin one"):
        made.answer(1)
    made.begin({"procedure": "comparison"}, run.wall)
    assert (tmp_path / "comparison-2.csv").exists()
    made.end("the run has ended", restore=False)
    assert not made.active


def test_a_run_that_refuses_the_last_change_keeps_the_table(tmp_path: Path) -> None:
    run = Run()
    made = comparison(run, tmp_path)
    made.show("2")
    made.answer(1)
    run.refuses = True
    with pytest.raises(ConfigError, match="the run refuses it"):
        made.end()
    assert len(rows(tmp_path, "comparison-table.csv")) == 1


def test_staircases_of_two_laws_are_those_of_the_study(tmp_path: Path) -> None:
    run = Run()
    made = Comparison(run.request, run.note, tmp_path)
    limits = {"standard": 21.0, "half_sample": 130.0}
    asked = {"procedure": "staircase", "laws": list(limits), "ceiling": 200.0, "seed": 1}
    made.begin(asked, run.wall)
    met: dict[str, list[float]] = {law: [] for law in limits}
    order = []
    while made.active:
        assert "law" not in json.dumps(made.state())
        order.append(run.wall.law)
        met[run.wall.law].append(run.wall.stiffness_nm_per_rad)
        made.answer(1 if run.wall.stiffness_nm_per_rad <= limits[run.wall.law] else 2)
    for law, limit in limits.items():
        climbed: list[float] = []
        Staircase(5.0, 200.0, 1.1).climb(lambda k, c=climbed, m=limit: c.append(k) or k <= m)  # type: ignore[misc]
        assert met[law] == climbed
    assert order != sorted(order)  # interleaved
    for law, free, chatters, _ in made.state()["rows"]:
        assert free <= limits[law] < chatters <= 1.1 * free
    assert run.wall == IN_FORCE
    assert len(rows(tmp_path, "staircase.csv")) == len(order)


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({}, "procedure: has to be comparison or staircase"),
        ({"procedure": []}, "procedure: has to be"),
        ({"procedure": "comparison", "question": "nicer"}, "question: has to be"),
        ({"procedure": "comparison", "walls": [{"stifness": 1}]}, "walls.0.stifness: unknown key"),
        ({"procedure": "comparison", "walls": [{"limits": {"torque_nm": 1}}]}, "limits: walls"),
        (
            {"procedure": "comparison", "factors": []},
            "factors: has to be an array that is not empty",
        ),
        (
            {"procedure": "comparison", "factors": [2.0], "walls": [{"law": "standard"}]},
            "walls and factors are given; keep one of them",
        ),
        ({"procedure": "comparison", "repeats": 0}, "repeats: has to be"),
        ({"procedure": "comparison", "repeats": 100, "factors": [*range(2, 13)]}, "1100 trials"),
        ({"procedure": "comparison", "factors": [2, 3, 2.0]}, "factors: two of them are the same"),
        (
            {
                "procedure": "comparison",
                "walls": [{"cap": 0.8}, {"cap": 0.8, "damping_ratio": 0.3}],
            },
            "walls: two of them are the same wall",
        ),
        ({"procedure": "staircase", "start": 600}, "start 600: has to be"),
        ({"procedure": "staircase", "finest": 1}, "finest 1: has to be"),
    ],
    ids=str,
)
def test_what_is_no_comparison(tmp_path: Path, asked: dict[str, Any], says: str) -> None:
    run = Run()
    made = Comparison(run.request, run.note, tmp_path)
    with pytest.raises(InputError) as raised:
        made.begin(asked, run.wall)
    assert says in str(raised.value)
    assert not made.active
    assert run.requests == run.marks == list(tmp_path.iterdir()) == []


def test_what_the_run_or_the_folder_refuses(tmp_path: Path) -> None:
    run = Run()
    run.refuses = True
    with pytest.raises(ConfigError, match="refuses"):
        comparison(run)
    with pytest.raises(InputError, match="cannot be written"):
        comparison(run, tmp_path / "no")
    assert run.requests == []
    made = comparison(run)
    with pytest.raises(ConfigError, match="in progress"):
        made.begin({"procedure": "comparison"}, run.wall)
    for which in (3, "", "a"):
        with pytest.raises(ConfigError, match="has to be 1 or 2"):
            made.show(which)


def test_a_and_b() -> None:
    run = Run()
    both = AB(run.request)
    with pytest.raises(ConfigError, match="set them first"):
        both.use("a")
    laws = (LiveLaw(name="standard"), LiveLaw(name="mean_force"))
    for wrong, said in (
        ({"law": "damped"}, "law damped is not one of the run's: standard, mean_force; list it in"),
        ({"options": {"zz": 1.0}}, "law mean_force has no option 'zz'; it has none"),
    ):
        with pytest.raises(ConfigError, match=said):
            both.set({"law": "standard"}, wrong, run.wall, laws)
    both.set({"law": "standard"}, {"stiffness_nm_per_rad": 20.0}, run.wall, laws)
    assert (both.use("b"), run.wall.law, run.wall.stiffness_nm_per_rad) == (100, "mean_force", 20.0)
    both.use("a")
    assert (run.wall.law, run.wall.stiffness_nm_per_rad) == ("standard", 50.0)
    assert both.state()["which"] == "a"
    both.auto(True)
    assert run.requests[-1]["do"] == "take_turns"
    assert [wall["stiffness_nm_per_rad"] for wall in run.requests[-1]["walls"]] == [50.0, 20.0]
    assert both.state() == {
        "a": {"law": "standard"},
        "b": {"stiffness_nm_per_rad": 20.0},
        "which": None,
        "auto": True,
    }
    both.use("b")
    assert run.requests[-2] == {"do": "take_turns", "walls": []}
    with pytest.raises(ConfigError, match="has to be a or b"):
        both.use("c")
    with pytest.raises(ConfigError, match="has to be"):
        both.set({"stiffness_nm_per_rad": -1.0}, {}, run.wall, laws)
