"""`canwall ball`: its file, its line, its errors."""

import errno
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bouncing import Array, integrated, sample_times, zoh_of
from commands import call, command

from canwall.walls import LAWS
from canwall.workbench import Ball, sampled_ball


@dataclass
class Said:
    """Exit code and output of one command."""

    code: object
    out: str
    err: str


class Bounce:
    """Runs `canwall ball` in this process, into one file."""

    def __init__(self, file: Path, capfd: pytest.CaptureFixture[str]) -> None:
        self.file, self._capfd = file, capfd

    def __call__(self, *arguments: object) -> Said:
        if self.file.is_file():
            self.file.unlink()
        code = call("ball", "--output", self.file, *arguments)
        return Said(code, *self._capfd.readouterr())

    def columns(self) -> Array:
        """t, y, ẏ and f, shape (4, periods + 1)."""
        assert self.file.read_text().startswith("t,y,v,f\n")
        return np.loadtxt(self.file, delimiter=",", skiprows=1, ndmin=2).T


@pytest.fixture
def bounce(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Bounce:
    monkeypatch.chdir(tmp_path)
    return Bounce(tmp_path / "ball.csv", capfd)


def end_over_start(columns: Array) -> float:
    """Energy of the ball of test_ball.py, at the last sample outside, over that at first."""
    _, y, v, _ = columns
    last = np.flatnonzero(y >= 0.0)[-1]
    return float((0.5 * v[last] ** 2 + y[last]) / (0.5 * v[0] ** 2 + y[0]))


@pytest.mark.parametrize(
    ("law", "theta"),
    [
        (("half_sample", "--deadbeat"), 0.1),
        (("half_sample", "--deadbeat"), 0.5),
        (("two_step",), 0.1),
        (("two_step",), 1.5),
        (("push_only",), 0.5),
        (("push_only",), 1.0),
        (("continuous",), 0.5),
    ],
)
def test_energy_is_kept(bounce: Bounce, law: tuple[str, ...], theta: float) -> None:
    said = bounce("--law", *law, "--stiffness", (theta / 0.1) ** 2)
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith(f"θ = {theta:g}; energy 1 J at the start, 1 J at the last sample")
    assert end_over_start(bounce.columns()) == pytest.approx(1.0, rel=0.0, abs=1e-9)


@pytest.mark.parametrize(("law", "end"), [("mean_force", 0.98663), ("standard", 85.49574)])
def test_energy_that_is_not_kept(bounce: Bounce, law: str, end: float) -> None:
    said = bounce("--law", law)
    assert end_over_start(bounce.columns()) == pytest.approx(end, rel=1e-5)
    assert f"energy 1 J at the start, {end:.4f}" in said.out


def test_thread_that_was_left_behind_and_has_ended(
    bounce: Bounce, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python ends as usual: nothing computes any more."""
    ended = threading.Thread(target=lambda: None)
    ended.start()
    ended.join()
    monkeypatch.setattr("canwall.cli.program.given_up", [ended])
    monkeypatch.setattr(os, "_exit", lambda code: pytest.fail("ended at once"))
    assert bounce("--law", "mean_force").code == 0


def test_every_option_reaches_the_ball(bounce: Bounce) -> None:
    """All digits: the file, read back, is the ball to the last bit, and that of its own forces."""
    words = (
        *("--law", "pole_placement", "--deadbeat", "--stiffness", 31.0, "--damping", 0.4),
        *("--mass", 0.7, "--viscous", 0.05, "--spring", 0.6, "--gravity", 2.5, "--height", 0.8),
        *("--speed", -0.3, "--period", 0.03, "--periods", 700, "--tension", "budget"),
        *("--passivity", 0.2),
    )
    assert bounce(*words).code == 0
    ball = Ball(31.0, 0.4, 0.7, 0.05, 0.6, 2.5, 0.8, -0.3, 0.03, 700, "budget", 0.2)
    t, y, v, force = bounce.columns()
    expected = sampled_ball(ball, LAWS["pole_placement+deadbeat"])
    np.testing.assert_array_equal([y, v, force], expected)
    np.testing.assert_array_equal(t, sample_times(ball))
    phi, gamma = zoh_of(0.7, 0.05, 0.6, 0.03)
    state = np.array([0.8, -0.3])
    for j in range(701):
        assert state == pytest.approx([y[j], v[j]], rel=1e-9, abs=1e-9)
        state = phi @ state + gamma * (force[j] - 0.7 * 2.5)


def test_continuous_floor(bounce: Bounce) -> None:
    bounce("--law", "continuous", "--stiffness", 30, "--damping", 0.1, "--periods", 300)
    _, y, v, force = bounce.columns()
    ball = Ball(stiffness=30.0, damping=0.1, periods=300)
    y_ref, v_ref, _ = integrated(ball, sample_times(ball))
    np.testing.assert_allclose(y, y_ref, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(v, v_ref, rtol=0.0, atol=1e-8)
    floor = np.where(y < 0.0, -30.0 * y - 0.1 * v, 0.0)
    np.testing.assert_allclose(force[:-1], floor[:-1], rtol=1e-12)
    assert force[-1] == 0.0


def test_option_of_a_law(bounce: Bounce) -> None:
    bounce("--law", "hysteresis", "--option", "softening=0.25", "--option", "release=0.1")
    _, y, v, force = bounce.columns()
    velocity = np.diff(y, prepend=y[0]) / 0.1
    softened = np.where(y > -0.1, 0.0, -0.25 * y)
    expected = np.where(velocity > 0.0, softened, -y) * (y < 0.0)
    np.testing.assert_allclose(force[:-1], expected[:-1], rtol=1e-12, atol=0.0)
    assert np.any(v > 0.0)


@pytest.mark.parametrize(
    ("inside", "line"),
    [
        ("raise ValueError('no')", "raised ValueError: no (mine.py, line 3) at t = 1.5"),
        ("return math.nan", "gave a force that is not a number at t = 1.5"),
        ("return math.inf", "the trajectory overflows at t = 1.5"),
        # Only its energy does.
        ("return 1e300", "the trajectory overflows at t = 1.6"),
    ],
)
def test_law_without_a_usable_force(bounce: Bounce, inside: str, line: str) -> None:
    text = f"def mine(wall):\n    if wall.y < 0.0:\n        {inside}\n    return 0.0\nimport math\n"
    mine = bounce.file.with_name("mine.py")
    mine.write_text(text)
    said = bounce("--law", "mine.py:mine")
    assert (said.code, said.err) == (1, f"canwall: {mine}:mine: {line}\n")
    assert not bounce.file.exists()


def test_no_periods(bounce: Bounce) -> None:
    assert bounce("--law", "two_step", "--periods", 0, "--height", 2).code == 0
    assert bounce.file.read_text() == "t,y,v,f\n0,2,0,0\n"


@pytest.mark.slow
def test_installed_command(tmp_path: Path) -> None:
    done = command("ball", "--law", "midpoint", "--output", "ball.csv", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert len((tmp_path / "ball.csv").read_text().splitlines()) == 3002


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ("--period 0", "period has to be a number above 0, not 0"),
        ("--period nan", "period has to be a number above 0, not nan"),
        ("--mass inf", "mass has to be a number above 0, not inf"),
        ("--mass 0", "mass has to be a number above 0, not 0"),
        ("--stiffness -1", "stiffness has to be 0 or above, not -1"),
        ("--stiffness nan", "stiffness has to be 0 or above, not nan"),
        ("--damping inf", "damping has to be 0 or above, not inf"),
        ("--passivity nan", "passivity has to be 0 or above, not nan"),
        ("--gravity nan", "gravity has to be a number, not nan"),
        ("--height -inf", "height has to be a number, not -inf"),
        ("--speed fast", "Invalid value for '--speed': "),
        ("--periods -1", "periods has to be a whole number, 0 … 100000000, not -1"),
        ("--periods 100000000000", "periods "),
        ("--stiffness 1e14", "T·√(K/m) has to be 10000 or below"),
        ("--option length=nan", "--option length=nan: has to be NAME=NUMBER"),
        ("--periods 1.5", "Invalid value for '--periods': "),
        ("--tension some", "tension has to be one of allow, clamp, budget, not 'some'"),
        ("--deadbeat", "law standard has no deadbeat compensation; half_sample, pole_placement "),
        ("--option length=1", "law standard has no option 'length'; it has none"),
        ("--option length", "--option length: has to be NAME=NUMBER"),
        ("--option length=long", "--option length=long: has to be NAME=NUMBER"),
        ("--law continuous --deadbeat", "--law continuous is the referent: leave out --deadbeat"),
        ("--law continuous --option a=1", "--law continuous is the referent: leave out --deadbeat"),
        ("--law springy", "unknown law 'springy'; known are standard, damped, hysteresis, "),
        ("--colour red", "No such option: --colour"),
    ],
)
def test_one_line_for_what_is_wrong(bounce: Bounce, wrong: str, complaint: str) -> None:
    said = bounce("--law", "standard", *wrong.split())
    assert (said.code, said.out) == (2, "")
    (line,) = said.err.splitlines()
    assert line.startswith(f"canwall: {complaint}")
    assert not bounce.file.exists()


def test_one_line_for_a_file_that_cannot_be_written(bounce: Bounce, tmp_path: Path) -> None:
    for file, what in (
        (tmp_path, "exists already; choose another --output"),
        (tmp_path / "nowhere" / "ball.csv", "cannot be written: No such file or directory"),
    ):
        bounce.file = file
        said = bounce("--law", "standard")
        assert (said.code, said.out) == (2, "")
        assert said.err == f"canwall: {file}: {what}\n"


def test_file_is_whole_or_not_there(
    bounce: Bounce, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    savetxt = np.savetxt

    def fill_the_disk(*given: Any, **more: Any) -> None:
        savetxt(*given, **more)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savetxt", fill_the_disk)
    said = bounce("--law", "standard")
    why = "cannot be written: No space left on device"
    assert (said.code, said.err) == (2, f"canwall: {bounce.file}: {why}\n")
    assert not list(tmp_path.iterdir())


def test_one_line_for_a_law_that_cannot_be_compiled(bounce: Bounce, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def mine(wall):\n    return helper(wall)\n")
    said = bounce("--law", "mine.py:mine")
    assert (said.code, said.out) == (2, "")
    (line,) = said.err.splitlines()
    assert line.startswith(f"canwall: {tmp_path}/mine.py:mine: does not compile: ")


def test_file_that_exists_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "ball.csv"
    file.write_text("mine")
    done = command("ball", "--law", "midpoint", "--output", file)
    assert done.returncode == 2
    assert done.stderr.endswith("ball.csv: exists already; choose another --output\n")
    assert file.read_text() == "mine"
