"""A law in the user's own file: the documentation's example, and errors in such files."""

import os
import runpy
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bouncing import Array
from commands import Record, command, config_file
from rig import IDEAL_CONFIG

from canwall.record import Phase
from canwall.walls import LAWS, WALL, UnknownLawError, find_law, set_plant, set_referent, wall_force
from canwall.walls.user_law import load_law
from canwall.workbench import Ball, sampled_ball, simulate_ball

EXAMPLE = Path(__file__).parents[2] / "docs" / "my_law.py"

Write = Callable[[str], str]
"""Writes a file with a law `mine`; returns the law's name."""


@pytest.fixture
def example(tmp_path: Path) -> str:
    """Name of the example's law, in a copy of its own."""
    return f"{shutil.copy(EXAMPLE, tmp_path)}:my_law"


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(text: str) -> str:
        (tmp_path / "mine.py").write_text(text)
        return f"{tmp_path}/mine.py:mine"

    return written


def stiffening(y: Array, v: Array, stiffness: float, growth: float, period: float) -> Array:
    """The undamped example's formula."""
    depth = np.maximum(-(y + 0.5 * period * v), 0.0)
    return np.where(y < 0.0, stiffness * (depth + growth * depth**2), 0.0)


def test_example_is_its_formula(example: str) -> None:
    law = find_law(example)
    wall = np.zeros(1, WALL)
    set_plant(wall, mass=0.3, viscous=0.1, spring=0.0, period=0.01)
    set_referent(wall, 40.0, 0.2, law.option_values({"growth": 3.0}))
    interpreted = runpy.run_path(str(EXAMPLE))["my_law"]
    for y, v in ((-0.1, -2.0), (-0.1, 2.0), (-0.001, 3.0), (0.0, -1.0), (0.1, -1.0)):
        wall["y"], wall["v"] = y, v
        force = wall_force(law.address, wall[0])
        undamped = stiffening(np.array(y), np.array(v), 40.0, 3.0, 0.01)
        assert force == pytest.approx(undamped - (0.2 * v if y < 0.0 else 0.0))
        fields = {name: wall[name][0] for name in ("y", "v", "period", "stiffness", "damping")}
        options = SimpleNamespace(growth=3.0)
        assert force == pytest.approx(interpreted(SimpleNamespace(**fields, options=options)))


def test_example_without_growth_is_the_clamped_midpoint(example: str) -> None:
    own = simulate_ball(Ball(stiffness=4.0), example, options={"growth": 0.0})
    midpoint = sampled_ball(Ball(stiffness=4.0, tension="clamp"), LAWS["midpoint"])
    for mine, theirs in zip(own, midpoint, strict=True):
        assert mine[:100] == pytest.approx(theirs[:100], rel=1e-9, abs=1e-9)


@pytest.mark.slow
def test_ball_command_finds_the_file_from_where_it_is_called(example: str, tmp_path: Path) -> None:
    for start in ("compiled", "as compiled by the first"):
        done = command(
            *("ball", "--law", "my_law.py:my_law", "--option", "growth=2", "--stiffness", "4"),
            *("--periods", "200", "--output", f"{start}.csv"),
            cwd=tmp_path,
        )
        assert (done.returncode, done.stderr) == (0, "")
    _, y, v, force = np.loadtxt(tmp_path / f"{start}.csv", delimiter=",", skiprows=1).T
    expected = stiffening(y, v, 4.0, 2.0, 0.1)[:-1]
    np.testing.assert_allclose(force[:-1], expected, rtol=0.0, atol=1e-12)
    assert force.max() > 1.0


@pytest.mark.slow
def test_run_finds_the_file_beside_its_configuration(example: str, tmp_path: Path) -> None:
    (tmp_path / "ideal.toml").write_text(IDEAL_CONFIG.read_text().partition("[[schedule]]")[0])
    config = config_file(
        tmp_path / "mine.toml",
        {
            'law = "standard"': 'law = "my_law.py:my_law"',
            "[limits]": "[wall.options]\ngrowth = 2.5\n\n[limits]",
            "duration_s = 4.2": "duration_s = 0.6",
        },
        source=tmp_path / "ideal.toml",
    )
    done = command("run", config, "--output", tmp_path / "run", cwd=Path("/"))
    assert (done.returncode, done.stderr) == (0, "")
    record = Record(tmp_path / "run")
    assert record.summary["law"] == [example]
    rendering = record.column("phase") == Phase.RENDERING
    y, v = record.column("y_est")[rendering], record.column("v_est")[rendering]
    expected = stiffening(y, v, 50.0, 2.5, 0.001)
    assert expected.max() > 0.01
    np.testing.assert_allclose(record.column("force")[rendering], expected, rtol=1e-9, atol=1e-12)


def test_options_of_an_own_law(example: str) -> None:
    law = find_law(example)
    assert law.option_values({}) == [5.0]
    assert law.option_values({"growth": 0.5}) == [0.5]
    with pytest.raises(UnknownLawError, match=r"my_law has no option 'grwth'; did you mean growth"):
        law.option_values({"grwth": 1.0})


def test_options_are_read_by_name_and_there_may_be_many(write: Write) -> None:
    """Each of 64 options has an effect of its own on the force."""
    names = [f"weight_{i}" for i in range(64)]
    terms = " + ".join(f"wall.options.{name} * wall.y**{i}" for i, name in enumerate(names))
    law = write(f"OPTIONS = dict.fromkeys({names}, 0)\ndef mine(wall):\n    return {terms}\n")
    found = find_law(law)
    wall = np.zeros(1, WALL)
    wall["y"] = -1.5
    for i, name in enumerate(names):
        set_referent(wall, 0.0, 0.0, found.option_values({name: 2.0}))
        assert wall_force(found.address, wall[0]) == pytest.approx(2.0 * (-1.5) ** i)


def test_options_of_one_law_do_not_reach_the_next() -> None:
    wall = np.zeros(1, WALL)
    set_referent(wall, 1.0, 0.0, LAWS["hysteresis"].option_values({"release": 0.1}))
    assert list(wall["option_values"][0, :3]) == [0.8, 0.1, 0.0]
    set_referent(wall, 1.0, 0.0, LAWS["exponential"].option_values({}))
    assert list(wall["option_values"][0, :3]) == [0.02, 0.0, 0.0]


def test_helpers_constants_memory_and_plain_integers(write: Write) -> None:
    law = write(
        "from canwall.compiled import compiled\n"
        "LIMIT = 0.5\n"
        "@compiled\n"
        "def limited(x):\n"
        "    return min(x, LIMIT)\n"
        "def mine(wall):\n"
        "    wall.memory[0] += 1\n"
        "    if wall.y >= 0:\n"
        "        return 0\n"
        "    return limited(-wall.stiffness * wall.y) + 0.001 * wall.memory[0]\n"
    )
    y, _, force = simulate_ball(Ball(periods=100), law)
    calls = 0.001 * (np.arange(100) + 1.0)
    expected = np.where(y < 0.0, np.minimum(-y, 0.5), 0.0)[:-1] + np.where(y[:-1] < 0.0, calls, 0.0)
    np.testing.assert_allclose(force[:-1], expected, rtol=1e-12, atol=0.0)


def test_options_may_be_numbers_of_numpy(write: Write) -> None:
    law = write(
        "import numpy as np\n"
        "OPTIONS = {'a': np.int64(2), 'b': np.float32(0.5)}\n"
        "def mine(wall):\n    return wall.options.a * wall.options.b\n"
    )
    _, _, force = simulate_ball(Ball(periods=3), law)
    assert force[:-1].tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("def other(wall):\n    return 0.0\n", "the file has no such function"),
        (
            "from canwall.walls.user_law import make_law\n"
            "def other(wall):\n    return 0.0\n"
            "mine = make_law('mine', other, {})\n",
            "in a file the function stands without @canwall.law; options are the dictionary "
            "OPTIONS beside it",
        ),
        (
            "from numba import njit\n@njit\ndef mine(wall):\n    return 0.0\n",
            "stands without numba's decorator; canwall compiles it",
        ),
        (
            "def mine(wall):\n    wall.period = 1.0\n    return 0.0\n",
            "line 2: changes period; a law reads the wall",
        ),
        (
            "OPTIONS = {'growth': 1}\ndef mine(wall):\n    wall.options.growth += 1.0\n"
            "    return 0.0\n",
            "line 3: changes growth; a law reads the wall",
        ),
        ("def mine(wall)\n    return 0.0\n", "SyntaxError: expected ':' (mine.py, line 1)"),
        ("\nimport nowhere\n", "line 2: ModuleNotFoundError: No module named 'nowhere'"),
        ("def mine(wall):\n    pass\n", "line 2: returns None; a law returns a number"),
        ("def mine(wall):\n    raise ValueError\n", "returns on no way through it; a law returns"),
        (
            "def mine(wall):\n    if wall.y < 0.0:\n        return 1.0\n",
            "line 2: returns None; a law returns a number, on every way through it",
        ),
        ("def mine(wall):\n    return 'a'\n", "line 2: returns a string; a law returns a number"),
        (
            "def mine(wall):\n    if wall.y < 0.0:\n        return 1.0\n    return 'a'\n",
            "line 4: does not compile: Can't unify return type",
        ),
        ("def mine(wall):\n    return wall.y, 1.0\n", "line 2: returns UniTuple"),
        ("def mine(wall):\n    return 1j * wall.y\n", "line 2: returns complex128; a law"),
        (
            "def helper(x):\n    return x\ndef mine(wall):\n    return helper(wall.y)\n",
            "line 4: does not compile: Untyped global name 'helper'",
        ),
        (
            "def mine(wall):\n    return wall.stifness\n",
            "line 2: uses stifness, which is neither a field of the wall nor an option; "
            "did you mean stiffness? (fields: stiffness, damping, mass, viscous, spring, period, ",
        ),
        (
            "from numba import njit\n@njit\ndef helper(wall):\n    return wall.stifness\n"
            "def mine(wall):\n    return helper(wall)\n",
            "line 4: uses stifness, which is neither a field of the wall nor an option",
        ),
        (
            "def mine(wall):\n    wall.hardness = 1.0\n    return 0.0\n",
            "line 2: uses hardness, which is neither a field of the wall nor an option",
        ),
        (
            "OPTIONS = {'growth': 1}\ndef mine(wall):\n    return wall.options.grwth\n",
            "line 3: uses grwth, which is neither a field of the wall nor an option; "
            "did you mean growth? (fields: ",
        ),
        (
            "def mine(wall):\n    return wall.options.growth\n",
            "line 2: uses wall.options, but declares no OPTIONS",
        ),
        ("def mine(wall, y):\n    return y\n", "takes 2 arguments; a law takes one, the wall"),
        (
            "import math\ndef wrong():\n    math.nowhere\nwrong()\n",
            "line 3: AttributeError: module 'math' has no attribute 'nowhere'",
        ),
        ("OPTIONS = ['a']\ndef mine(wall):\n    return 0.0\n", "OPTIONS "),
        (
            "OPTIONS = {'a': 'b'}\ndef mine(wall):\n    return 0.0\n",
            "OPTIONS: a has to be a finite",
        ),
        *(
            (f"OPTIONS = {{'a': {value}}}\ndef mine(wall):\n    return 0.0\n", "OPTIONS: a has to")
            for value in ("float('nan')", "-1e999", "10**400")
        ),
        (
            "OPTIONS = {'a-b': 1}\ndef mine(wall):\n    return 0.0\n",
            "OPTIONS: 'a-b' cannot be read",
        ),
        ("OPTIONS = {'is': 1}\ndef mine(wall):\n    return 0.0\n", "OPTIONS: 'is' cannot be read"),
        (
            "OPTIONS = {f'n{i}': i for i in range(65)}\ndef mine(wall):\n    return 0.0\n",
            "65 options; a law may have up to 64",
        ),
    ],
)
def test_one_line_for_what_is_wrong(write: Write, text: str, complaint: str) -> None:
    name = write(text)
    with pytest.raises(UnknownLawError) as caught:
        find_law(name)
    message = str(caught.value)
    assert message.startswith(f"{name}: {complaint}")
    assert "\n" not in message


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (3, "def mine(wall):\n    return wall.options[0]\n"),
        (4, "def mine(wall):\n    o = wall.options\n    return o[0] + o.growth\n"),
        (3, "def mine(wall):\n    wall.options[0] = 2.0\n    return 0.0\n"),
        (3, "def mine(wall):\n    return wall[0]\n"),
        (
            5,
            "from numba import njit\n@njit\ndef first(options):\n    return options[0]\n"
            "def mine(wall):\n    return first(wall.options)\n",
        ),
    ],
)
def test_fields_are_not_read_by_position(write: Write, line: int, text: str) -> None:
    name = write("OPTIONS = {'growth': 1}\n" + text)
    with pytest.raises(UnknownLawError) as caught:
        find_law(name)
    assert str(caught.value).startswith(f"{name}: line {line}: uses a field by its position; use")


def test_a_law_is_one_file(write: Write, tmp_path: Path) -> None:
    (tmp_path / "helpers.py").write_text("GROWTH = 2.0\n")
    name = write("from helpers import GROWTH\ndef mine(wall):\n    return GROWTH\n")
    with pytest.raises(UnknownLawError) as caught:
        find_law(name)
    assert str(caught.value) == (
        f"{name}: line 1: ModuleNotFoundError: No module named 'helpers'; a law is one file: "
        "write into it what it needs"
    )


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("gamma", "wall.gamma[1] = 0.0"),
        ("phi", "wall.phi[0, 0] = 5.0"),
        ("phi", "wall.phi[0][1] = 5.0"),
        ("phi", "wall.phi[int(wall.y)][:] = 5.0"),
        ("phi", "for row in wall.phi: row[0] = 5.0"),
        ("gamma", "g = wall.gamma; g += 1.0"),
        ("gamma", "wall['gamma'][0] = 1.0"),
        ("period", "wall['period'] = 1.0"),
        ("mass", "wall.referent[0].mass = 1.0"),
        ("growth", "wall.options['growth'] = 2.0"),
    ],
)
def test_a_law_does_not_change_the_wall(write: Write, field: str, change: str) -> None:
    """Neither does a function that it calls, with the wall or with an array of it."""
    begin = "from numba import njit\nOPTIONS = {'growth': 1}\n"
    for text in (
        f"\n\ndef mine(wall):\n    {change}\n    return 0.0\n",
        f"@njit\ndef sneak(wall):\n    z = 0.0\n    {change}\n"
        "def mine(wall):\n    sneak(wall)\n    return 0.0\n",
    ):
        name = write(begin + text)
        with pytest.raises(UnknownLawError) as caught:
            find_law(name)
        line = (begin + text)[: (begin + text).index(change)].count("\n") + 1
        assert str(caught.value) == (
            f"{name}: line {line}: changes {field}; a law reads the wall, and keeps numbers of its "
            "own in wall.memory"
        )


def test_an_array_of_the_wall_is_not_changed_by_a_function_that_gets_it(write: Write) -> None:
    put = "from numba import njit\n@njit\ndef put(numbers):\n    numbers[1] = 2.0\n"
    name = write(put + "def mine(wall):\n    put(wall.gamma)\n    return 0.0\n")
    with pytest.raises(UnknownLawError, match=r"mine: line 4: changes gamma; a law reads the wall"):
        find_law(name)


@pytest.mark.slow
def test_a_law_writes_its_memory_and_arrays_of_its_own(write: Write) -> None:
    found = find_law(
        write(
            "import numpy as np\n"
            "from numba import njit\n"
            "@njit\n"
            "def put(numbers):\n"
            "    numbers[1] = 2.0\n"
            "def mine(wall):\n"
            "    put(wall.memory)\n"
            "    kept = wall.plan[2:]\n"
            "    kept[0] += 3.0\n"
            "    wall['plan'][0] = 4.0\n"
            "    gamma = wall.gamma.copy()\n"
            "    gamma[0] = 5.0\n"
            "    phi = 2.0 * wall.phi\n"
            "    phi[0, 0] += 6.0\n"
            "    own = np.zeros(2)\n"
            "    own[:] = wall.gamma\n"
            "    y = wall.phi[0, 0]\n"
            "    y += 1.0\n"
            "    return gamma[0] + phi[0, 0] + y\n"
        )
    )
    wall = np.zeros(1, WALL)
    assert wall_force(found.address, wall[0]) == 12.0
    assert wall["memory"][0, 1] == 2.0
    assert wall["plan"][0, :3].tolist() == [4.0, 0.0, 3.0]
    assert not wall["gamma"].any()


def test_one_line_for_a_file_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("def mine(wall):\n    return 0.0\n")
    for file, complaint in (
        (tmp_path / "mine.py", "no such file"),
        (tmp_path, "no such file"),
        (tmp_path / "mine.txt", "not a Python file"),
    ):
        with pytest.raises(UnknownLawError) as caught:
            find_law(f"{file}:mine")
        assert str(caught.value) == f"{file}:mine: {complaint}"


def test_law_that_was_written_anew_is_the_new_one(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the same size and within the same second, by which Python would know its bytecode."""
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    for force in (1.0, 2.0):
        write(f"def mine(wall):\n    return {force}\n")
        os.utime(tmp_path / "mine.py", (0, 0))
        law = load_law(tmp_path / "mine.py", "mine")
        assert wall_force(law.address, np.zeros(1, WALL)[0]) == force
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]


def test_own_law_has_no_deadbeat(write: Write) -> None:
    with pytest.raises(UnknownLawError):
        find_law(write("def mine(wall):\n    return 0.0\n"), deadbeat=True)


@pytest.mark.slow
def test_run_says_it_in_one_line(write: Write, tmp_path: Path) -> None:
    law = write("def mine(wall):\n    pass\n")
    done = command("run", "--law", law, "--output", tmp_path / "run")
    (line,) = done.stderr.splitlines()
    assert line.startswith("canwall: ")
    assert f"{law}: line 2: returns None; a law returns a number" in line
    assert done.returncode == 2
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("body", "raised"),
    [
        ("raise ValueError('no')", "ValueError: no"),
        # Far beyond its end.
        ("return wall.memory[int(wall.stiffness)]", "IndexError: index is out of bounds"),
        ("return 1 // int(wall.y)", "ZeroDivisionError: integer division by zero"),
        ("return 1.0 / (wall.y - wall.y)", "ZeroDivisionError: division by zero"),
    ],
)
def test_exception_in_a_law_is_a_nan_force_and_is_told(
    tmp_path: Path, body: str, raised: str
) -> None:
    file = tmp_path / "raises.py"
    file.write_text(
        "def raises(wall):\n"
        "    wall.memory[1] += 1.0\n"
        "    if wall.y < 0.0 and wall.memory[1] == 2.0:\n"
        f"        {body}\n"
        "    return 0.25\n"
    )
    found = find_law(f"{file}:raises")
    bench = np.zeros(1, WALL)
    bench["stiffness"] = 50.0
    bench["y"] = 0.1
    assert wall_force(found.address, bench[0]) == 0.25
    assert found.failure() == ""
    bench["y"] = -0.1
    assert not np.isfinite(wall_force(found.address, bench[0]))
    # The exception of that call, although the law would not raise it in the state that it left.
    for _ in range(2):
        assert found.failure() == f"{raised} (raises.py, line 4)"
    assert wall_force(found.address, bench[0]) == 0.25
    assert found.failure() == ""


def test_force_that_is_no_number_is_no_exception(write: Write) -> None:
    found = find_law(write("import math\ndef mine(wall):\n    return math.nan\n"))
    assert not np.isfinite(wall_force(found.address, np.zeros(1, WALL)[0]))
    assert found.failure() == ""
