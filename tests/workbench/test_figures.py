"""The figures: all files, data that are the ball's and the drive's, an index that tells them."""

import csv
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from colour_vision import assert_nothing_overlaps, assert_readable, assert_told_apart
from commands import call
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

from canwall.analysis import metrics
from canwall.errors import InputError, RunFailedError
from canwall.walls import LAWS
from canwall.workbench import CONTINUOUS, Ball, continuous_ball, on_the_drive, simulate_ball
from canwall.workbench import figures as figures_module
from canwall.workbench.bounces import Bounces, entering
from canwall.workbench.comparison import DAMPING, FORCELESS, GROUPS, continuous_result
from canwall.workbench.designs import continuous_crossings
from canwall.workbench.figure_page import FigurePage
from canwall.workbench.figures import Extent, write_figures
from canwall.workbench.on_the_drive import effort, record_run
from canwall.workbench.traces import BALL, POINTS, drop_ball

# All figures are drawn once, for the whole file.
pytestmark = pytest.mark.slow

Array = NDArray[np.float64]

EXTENT = Extent(long_s=120.0, drops=4, phases=6, thetas=4, plane=3)
DIAGRAMS = [f"figure_5_{n:02}" for n in (1, 2, 6, 7)]
NAMES = [
    *(f"figure_5_{n:02}" for n in (3, 4, 5, *range(8, 20))),
    "all_laws",
    "effective_impedance",
    "unknown_hands",
    "diolaiti_plane",
]


@dataclass(frozen=True)
class Written:
    """Results of one `write_figures`."""

    folder: Path
    index: str
    figures: dict[str, Figure]
    steps: list[tuple[str, int, int]]

    def column(self, name: str, header: str) -> Array:
        with (self.folder / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            return np.array([float(row[header]) for row in csv.DictReader(file)])

    def words(self, name: str, header: str) -> list[str]:
        with (self.folder / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            return [row[header] for row in csv.DictReader(file)]

    def finding(self, name: str) -> str:
        """Return the text of the index about a figure's numbers."""
        section = next(s for s in self.index.split("\n## ") if f"({name}.png)" in s)
        return section.partition("*Here:* ")[2]

    def numbers(self, name: str, pattern: str) -> list[float]:
        """The numbers that the groups of a pattern find in it."""
        found = re.search(pattern, self.finding(name))
        assert found, f"{pattern!r} not in {self.finding(name)!r}"
        return [float(group) for group in found.groups()]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    folder = tmp_path_factory.mktemp("figures") / "new" / "folder"
    steps: list[tuple[str, int, int]] = []
    figures: dict[str, Figure] = {}
    write = FigurePage.write

    def noted(page: FigurePage, folder: Path) -> None:
        figures[page.name] = page.figure
        write(page, folder)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(FigurePage, "write", noted)
        path = write_figures(folder, EXTENT, lambda *step: steps.append(step))
    assert path == folder / "index.md"
    return Written(folder, path.read_text(encoding="utf-8"), figures, steps)


def test_every_figure_has_its_files_and_nothing_else_is_left(written: Written) -> None:
    expected = {f"{name}.{kind}" for name in NAMES for kind in ("png", "csv")} | {"index.md"}
    expected |= {f"{name}.png" for name in DIAGRAMS}
    assert {path.name for path in written.folder.iterdir()} == expected


def test_figures_are_in_the_order_of_the_chapter(written: Written) -> None:
    numbered = [name for name in written.figures if name.startswith("figure_5_")]
    assert numbered == [f"figure_5_{n:02}" for n in range(1, 20)]
    assert re.findall(r"## Figure 5\.(\d+):", written.index) == [str(n) for n in range(1, 20)]


@pytest.mark.parametrize("name", NAMES + DIAGRAMS)
def test_they_are_readable_with_few_colours_and_in_a_column(written: Written, name: str) -> None:
    figure = written.figures[name]
    assert_told_apart(figure)
    assert_readable(figure)
    assert_nothing_overlaps(figure)


@pytest.mark.parametrize("name", NAMES + DIAGRAMS)
def test_pictures_show_something(written: Written, name: str) -> None:
    picture = imread(written.folder / f"{name}.png")
    assert min(picture.shape[:2]) >= 400
    assert picture.shape[1] >= 700
    assert 0.01 < np.mean(picture[..., :3].min(axis=2) < 0.95) < 0.9


@pytest.mark.parametrize("name", NAMES)
def test_columns_have_units_and_one_length(written: Written, name: str) -> None:
    with (written.folder / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert all(re.fullmatch(r".+ \[.+\]", column) for column in header if column != "law")
    assert len(rows) > 3
    assert {len(row) for row in rows} == {len(header)}


@pytest.mark.parametrize("name", NAMES + DIAGRAMS)
def test_index_tells_claim_and_finding(written: Written, name: str) -> None:
    section = next(s for s in written.index.split("\n## ") if f"({name}.png)" in s)
    assert (f"[data]({name}.csv)" in section) == (name in NAMES)
    says = "The chapter" if name.startswith("figure_5_") else "Shown"
    for part in (rf"\*{says}:\* (.{{40,}})", r"\*Here:\* (.{40,})"):
        assert re.search(part, section)
    assert not re.search(r"\bnan\b|\binf\b", section)


def test_progress_goes_from_nothing_to_all(written: Written) -> None:
    total = written.steps[0][2]
    assert [step[1:] for step in written.steps] == [(n, total) for n in range(total + 1)]


# The balls


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("figure_5_08", "standard"),
        ("figure_5_10", "half_sample"),
        ("figure_5_14", "pole_placement"),
        ("figure_5_16", "half_sample+deadbeat"),
    ],
)
def test_data_are_the_balls(written: Written, name: str, law: str) -> None:
    t, y = written.column(name, "t [s]"), written.column(name, "y rendered [m]")
    f = written.column(name, "f held [N]")
    at = written.column(name, "at a sample [0 or 1]") == 1.0
    ball = replace(BALL, periods=int(at.sum()) - 1)
    assert ball.periods * ball.period == 45.0
    y_ball, v_ball, f_ball = simulate_ball(ball, law)
    np.testing.assert_array_equal(t[at], np.arange(ball.periods + 1) * ball.period)
    np.testing.assert_allclose(y[at], y_ball, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(f[at], f_ball)
    # Between the samples a free mass under the force held, by hand.
    j = np.arange(len(t) - 1) // POINTS
    tau = t[:-1] - j * ball.period
    by_hand = y_ball[j] + v_ball[j] * tau + 0.5 * (f_ball[j] - ball.gravity) * tau * tau
    np.testing.assert_allclose(y[:-1], by_hand, rtol=0.0, atol=1e-10)
    np.testing.assert_array_equal(f[:-1], f_ball[j])
    np.testing.assert_array_equal(written.column(name, "-f/K [m]"), 0.0 - f)
    referent = written.column(name, "y continuous [m]")
    np.testing.assert_allclose(referent[at], continuous_ball(ball)[0], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("close_up", "whole"),
    [
        ("figure_5_04", "figure_5_08"),
        ("figure_5_09", "figure_5_08"),
        ("figure_5_11", "figure_5_10"),
        ("figure_5_17", "figure_5_16"),
    ],
)
def test_close_ups_are_parts_of_their_figures(written: Written, close_up: str, whole: str) -> None:
    t, t_whole = written.column(close_up, "t [s]"), written.column(whole, "t [s]")
    start = int(np.flatnonzero(t_whole == t[0])[0])
    for header in ("t [s]", "y rendered [m]", "f held [N]", "y continuous [m]"):
        part = written.column(whole, header)[start : start + len(t)]
        np.testing.assert_array_equal(written.column(close_up, header), part)
    y = written.column(close_up, "y rendered [m]")
    assert y[0] > 0.0 > y.min()
    assert y[-1] > 0.0


def test_loop_of_figure_5_3_is_the_energy_gained(written: Written) -> None:
    y, v, _ = simulate_ball(replace(BALL, periods=60), "standard")
    energy = BALL.energy(y, v)
    gained = energy[np.flatnonzero(y < 0.0).max() + 1] - energy[0]
    area, share = written.numbers("figure_5_03", r"area is ([\d.]+) J, ([\d.]+)%")
    assert area == pytest.approx(gained, abs=5e-4)
    assert share == pytest.approx(100.0 * gained / energy[0], abs=0.05)
    put_in, given_back = written.numbers(
        "figure_5_03", r"in takes ([\d.]+) J, moving out gives ([\d.]+) J"
    )
    assert given_back - put_in == pytest.approx(gained, abs=2e-3)
    # From 12 m under 1 m/s² a floor of 1 N/m is pressed in by 6 m: ½·6² = 1·(12 + 6).
    assert written.numbers("figure_5_03", r"give ([\d.]+) J") == [18.0]
    x, f = written.column("figure_5_03", "x [m]"), written.column("figure_5_03", "f held [N]")
    assert -np.sum(f[:-1] * np.diff(x)) == pytest.approx(gained, abs=1e-9)


def test_delays_of_figure_5_4(written: Written) -> None:
    on_s, off_s = written.numbers("figure_5_04", r"Δt_a = ([\d.]+) s.*Δt_b = ([\d.]+) s")
    # The threshold is met after √(2·12) s; the sample after that one is the first inside.
    met = math.sqrt(2.0 * BALL.height / BALL.gravity)
    assert on_s == pytest.approx(-met % BALL.period, abs=5e-5)
    y, v, f = simulate_ball(replace(BALL, periods=60), "standard")
    last = int(np.flatnonzero(y < 0.0).max())
    a = f[last] - 1.0
    crossing = (-v[last] + math.sqrt(v[last] ** 2 - 2.0 * a * y[last])) / a
    assert off_s == pytest.approx(BALL.period - crossing, abs=5e-5)


def test_pull_of_figure_5_11(written: Written) -> None:
    y, _, f = simulate_ball(replace(BALL, periods=180), "half_sample")
    last = int(np.argmin(f))
    pull, taken = written.numbers("figure_5_11", r"pulls with ([\d.]+) N and takes ([\d.]+) J")
    assert pull == pytest.approx(-f[last], abs=5e-4)
    assert taken == pytest.approx(-f[last] * (y[last + 1] - y[last]), abs=5e-4)
    (middle,) = written.numbers("figure_5_11", r"meet at ([\d.]+) of the period")
    assert middle == pytest.approx(0.5, abs=0.01)


def test_heights_of_figure_5_12(written: Written) -> None:
    ball = replace(BALL, periods=round(EXTENT.long_s / BALL.period))
    y, v, f = simulate_ball(ball, "half_sample")
    flying = (y >= 0.0) & (f == 0.0)
    flying[: int(np.argmin(y >= 0.0))] = False  # the drop itself
    heights = (y + 0.5 * v * v)[flying] / BALL.height
    bounces = np.count_nonzero((y[:-1] < 0.0) & (y[1:] >= 0.0))
    assert written.numbers("figure_5_12", r"Over (\d+) bounces") == [bounces]
    low, high = written.numbers("figure_5_12", r"between ([\d.]+)% and ([\d.]+)%")
    assert low == pytest.approx(100.0 * heights.min(), abs=0.05)
    assert high == pytest.approx(100.0 * heights.max(), abs=0.05)


def test_roots_of_figure_5_13(written: Written) -> None:
    theta = written.column("figure_5_13", "theta [1]")
    free = (np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.eye(2), 0)
    roots = {
        law: written.column("figure_5_13", f"Re z {law} [1]")
        + 1j * written.column("figure_5_13", f"Im z {law} [1]")
        for law in ("standard", "half_sample", "pole_placement")
    }
    np.testing.assert_allclose(roots["pole_placement"], np.exp(1j * theta), atol=1e-9)
    for at, *found in list(zip(theta, roots["standard"], roots["half_sample"], strict=True))[::10]:
        # A free mass under a held force (SciPy); −K·y now, and half a period ahead on the spring.
        a, b, *_ = cont2discrete(free, at)
        gains = ([[1.0, 0.0]], [[math.cos(0.5 * at), math.sin(0.5 * at)]])
        for k, z in zip(gains, found, strict=True):
            assert np.abs(np.linalg.eigvals(a - b @ np.array(k)) - z).min() < 1e-9
    standard = written.numbers("figure_5_13", r"standard ([\d.]+), ([\d.]+), ([\d.]+)")
    assert standard == pytest.approx([math.sqrt(1 + x * x / 2) for x in (0.25, 1.0, 2.0)], abs=5e-5)


def test_crossings_of_figure_5_15(written: Written) -> None:
    entry, leave = continuous_crossings()

    def fall(t: float, state: list[float]) -> list[float]:
        return [state[1], max(-state[0], 0.0) - 1.0]

    def surface(t: float, state: list[float]) -> float:
        return state[0]

    found = solve_ivp(fall, (0.0, 10.0), [12.0, 0.0], events=surface, rtol=1e-10, atol=1e-10)
    assert found.t_events[0][:2] == pytest.approx([entry, leave], abs=1e-6)
    m, n, before, after = written.numbers(
        "figure_5_15", r"m = (\d+), n = (\d+).*Δt_a = ([\d.]+) s.*Δt_b = ([\d.]+) s"
    )
    assert ((m - 1) * 0.25 + before, n * 0.25 - after) == pytest.approx((entry, leave), abs=1e-4)
    assert 0.0 < before < 0.25
    assert 0.0 < after < 0.25


# The run on the simulated drive


def test_strip_chart_of_figure_5_5_is_the_first_contact(written: Written) -> None:
    t, y = written.column("figure_5_05", "t [ms]"), written.column("figure_5_05", "y [mrad]")
    whole_t = written.column("figure_5_18", "t [s]")
    whole = written.column("figure_5_18", "y [mrad]")
    start = int(np.flatnonzero(np.isclose(whole_t, t[0] * 1e-3))[0])
    np.testing.assert_array_equal(y, whole[start : start + len(y)])
    assert whole[:start].min() > 0.0
    assert (y[0] > 0.0, y[-1] > 0.0, y.min() < 0.0) == (True, True, True)
    # The force is that of the sample before, and so on and off a sample late.
    held = written.column("figure_5_05", "-f/K held [mrad]")
    half_step = 0.5 * 0.000637 / 50.0 * 1e3
    np.testing.assert_allclose(held[1:], np.minimum(y[:-1], 0.0), rtol=0, atol=half_step + 1e-9)
    on, off = written.numbers("figure_5_05", r"begins ([\d.]+) ms.*ends ([\d.]+) ms")
    assert 1.0 < on < 2.0
    assert 1.0 < off < 2.0


def test_strikes_of_figure_5_18(written: Written) -> None:
    t, y = written.column("figure_5_18", "t [s]"), written.column("figure_5_18", "y [mrad]")
    torque = written.column("figure_5_18", "torque applied [N·m]")
    laws = np.array(written.words("figure_5_18", "law"))
    cycle_s = 0.001
    np.testing.assert_allclose(np.diff(t), cycle_s, rtol=1e-9)
    contacts = written.numbers("figure_5_18", r"strike 1 \(standard\): (\d+) contacts, chatter")
    first = metrics.strikes(metrics.contacts(y * 1e-3, torque), cycle_s)[0]
    assert contacts == [len(first.contacts)]
    assert set(laws[first.cycles]) == {"standard"}
    for number in (2, 4):
        written.numbers("figure_5_18", rf"strike ({number}) \(half_sample\): 1 contact, no chatter")


def test_displayed_effort_of_figure_5_19_belongs_to_the_sample_before(written: Written) -> None:
    y = written.column("figure_5_19", "y [mrad]")
    shown = written.column("figure_5_19", "-f/K standard displayed [mrad]")
    half_step = 0.5 * 0.000637 / 50.0 * 1e3
    np.testing.assert_allclose(shown[1:], np.minimum(y[:-1], 0.0), rtol=0, atol=half_step + 1e-9)


def test_effort_not_displayed_is_the_laws_own() -> None:
    recorded = record_run()
    settings = recorded.settings
    laws = np.array(recorded.signals["law"].to_pylist())
    displayed = recorded.column("force_applied")
    for wall in [stage.wall for stage in settings.stages[:2]]:
        held = effort(recorded, wall)
        # Where the law was displayed, what it would have held is what the drive applied.
        own = np.flatnonzero((laws[:-1] == wall.law) & (displayed[1:] != 0.0)) + 1
        assert len(own) > 100
        np.testing.assert_allclose(held[own], displayed[own], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("interrupted", "trips", "error"),
    [(True, [], KeyboardInterrupt), (False, ["overspeed", "late"], RunFailedError)],
)
def test_run_that_did_not_reach_its_end_draws_nothing(
    monkeypatch: pytest.MonkeyPatch,
    interrupted: bool,
    trips: list[str],
    error: type[BaseException],
) -> None:
    outcome = SimpleNamespace(interrupted=interrupted, trips=trips)
    result = SimpleNamespace(outcome=outcome, notes=[])
    monkeypatch.setattr(on_the_drive, "run", lambda settings, folder: result)
    with pytest.raises(error, match="^" + "; ".join(trips) + "$"):
        record_run()


# All laws


def test_every_law_is_compared(written: Written) -> None:
    grouped = [law for laws in GROUPS.values() for law in laws]
    assert sorted((*grouped, *FORCELESS)) == sorted(LAWS)
    assert list(dict.fromkeys(written.words("all_laws", "law"))) == grouped


def test_gain_of_the_standard_floor_by_hand(written: Written) -> None:
    rows = np.array(written.words("all_laws", "law")) == "standard"
    thetas = written.column("all_laws", "theta [1]")[rows]
    assert thetas[0] == pytest.approx(0.05)
    assert thetas[-1] == pytest.approx(3.0)
    theta = float(thetas[1])
    gains, peak = [], 0.0
    for phase in (np.arange(EXTENT.phases) + 0.5) / EXTENT.phases:
        # Up from the floor at 5 m/s for that part of a period, then the other way round.
        y = 5.0 * phase * theta - 0.5 * (phase * theta) ** 2
        v = phase * theta - 5.0
        entered = False
        while not (entered and y >= 0.0):
            force = max(-y, 0.0)
            entered = entered or y < 0.0
            peak = max(peak, force)
            y += v * theta + 0.5 * (force - 1.0) * theta**2
            v += (force - 1.0) * theta
        gains.append(math.log((y + 0.5 * v * v) / 12.5))
    for header, expected in (
        ("change of ln E, mean [1]", float(np.mean(gains))),
        ("change of ln E, least [1]", min(gains)),
        ("change of ln E, most [1]", max(gains)),
        ("peak force over the continuous wall's [1]", peak / (1.0 + math.sqrt(26.0))),
    ):
        assert written.column("all_laws", header)[rows][1] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("law", ["half_sample+deadbeat", "pole_placement+deadbeat", "two_step"])
def test_exact_laws_gain_nothing(written: Written, law: str) -> None:
    rows = np.array(written.words("all_laws", "law")) == law
    for header in ("change of ln E, least [1]", "change of ln E, most [1]"):
        assert np.abs(written.column("all_laws", header)[rows]).max() < 1e-9
    assert law in written.finding("all_laws").partition(", up to some θ")[0]


def test_continuous_floors_that_all_is_compared_with() -> None:
    # Undamped: the depth at which ½·x² = ½·5² + x, no energy lost. Damped: some is.
    assert continuous_result(0.0).peak == pytest.approx(1.0 + math.sqrt(26.0), rel=1e-6)
    assert continuous_result(0.0).mean == pytest.approx(0.0, abs=1e-12)
    assert continuous_result(DAMPING).mean < -0.5


# What is counted of bounces


def test_entering_meets_the_floor_when_and_as_fast_as_asked() -> None:
    ball = entering(Ball(viscous=0.3, spring=0.2, gravity=2.0, period=0.5, periods=1), 3.0, 0.6)
    bounces = Bounces(ball, *(np.array([x, 0.0]) for x in (ball.height, ball.speed, 0.0)))
    bounces.y[1] = -1.0
    assert bounces.crossing(0) == pytest.approx(0.3, rel=1e-12)


@pytest.mark.parametrize("where", ["inside", "at the first sample outside"])
def test_contacts_that_are_not_known_to_have_ended_do_not_count(where: str) -> None:
    whole = drop_ball("standard", 45.0)
    second = whole.contacts[1]
    end = second.start + 3 if where == "inside" else second.stop - 1
    cut = drop_ball("standard", end * BALL.period)
    assert (cut.y[-1] < 0.0) == (where == "inside")
    assert len(cut.contacts) == 1
    np.testing.assert_array_equal(cut.heights, whole.heights[:2])


def test_energy_is_kept_on_the_continuous_floor() -> None:
    bounces = drop_ball(CONTINUOUS)
    assert len(bounces.gains) == 3
    np.testing.assert_allclose(bounces.heights, BALL.height, rtol=1e-12)


# The command


def test_command_is_a_call_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def fake(output: Path, progress: Callable[[str, int, int], None]) -> Path:
        progress("Figure 5.3", 0, 2)
        progress("written", 2, 2)
        return output / "index.md"

    monkeypatch.setattr(figures_module, "write_figures", fake)
    assert call("figures", "--output", tmp_path / "here") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'here' / 'index.md'}\n"


def test_folder_that_exists_is_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Nothing is computed: a call of None would fail."""
    (tmp_path / "index.md").write_text("mine")
    monkeypatch.setattr(figures_module, "write_figures", None)
    assert call("figures", "--output", tmp_path) == 2
    said = f"canwall: {tmp_path}: exists already; choose another --output\n"
    assert capsys.readouterr().err == said
    assert (tmp_path / "index.md").read_text() == "mine"


def test_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    taken = tmp_path / "file"
    taken.touch()
    with pytest.raises(InputError, match=r"file: cannot be written: File exists$"):
        write_figures(taken, EXTENT)
