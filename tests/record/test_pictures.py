"""The picture of a run, from its record alone."""

import shutil
from pathlib import Path
from typing import Any

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pyarrow as pa
import pytest
from colour_vision import assert_nothing_overlaps, assert_readable, assert_told_apart
from commands import Record, command
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from canwall.config import ConfigError
from canwall.figure_style import CHATTER
from canwall.record import RunFolder
from canwall.record.folder import read_signals
from canwall.record.pictures import (
    DRAWN,
    draw_in_force,
    draw_strikes,
    law_colours,
    plot_run,
    run_figure,
    shown_strikes,
    thin_out,
    warm_up,
)


@pytest.fixture
def copied(four_strikes: Record, tmp_path: Path) -> RunFolder:
    """Copy of the files from which the picture is drawn, without the picture."""
    folder = RunFolder(tmp_path)
    shutil.copy(four_strikes.folder / "signals.parquet", folder.signals)
    shutil.copy(four_strikes.folder / "summary.json", folder.summary)
    return folder


@pytest.fixture
def figure(copied: RunFolder, monkeypatch: pytest.MonkeyPatch) -> Figure:
    drawn: list[Figure] = []
    monkeypatch.setattr(
        FigureCanvasAgg, "print_png", lambda self, *args, **options: drawn.append(self.figure)
    )
    plot_run(copied)
    (figure,) = drawn
    return figure


@pytest.mark.slow
def test_picture_of_the_run(four_strikes: Record) -> None:
    picture = matplotlib.image.imread(four_strikes.folder / "run.png")
    height, width, _ = picture.shape
    assert width > 1000
    assert height > 700
    # Not an empty sheet: many places are not white, in more than one colour.
    inked = picture[..., :3].min(axis=2) < 0.9
    assert 0.01 < inked.mean() < 0.5
    assert len(np.unique((picture[inked][:, :3] * 8).round(), axis=0)) > 10


@pytest.mark.slow
def test_command_draws_it_again(four_strikes: Record, copied: RunFolder) -> None:
    done = command("plot", copied.path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"{copied.picture}\n"
    again, first = (
        matplotlib.image.imread(folder / "run.png") for folder in (copied.path, four_strikes.folder)
    )
    assert np.array_equal(again, first)


@pytest.mark.slow
def test_folder_without_a_record(tmp_path: Path) -> None:
    done = command("plot", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line == f"canwall: {tmp_path}/signals.parquet: no such file; give the folder of a run"


def test_folder_without_a_summary(copied: RunFolder) -> None:
    copied.summary.unlink()
    with pytest.raises(ConfigError, match="not a summary of a run"):
        plot_run(copied)


def test_summary_of_something_else(copied: RunFolder) -> None:
    copied.summary.write_text("{}")
    with pytest.raises(ConfigError, match="not a summary of a run"):
        plot_run(copied)


def test_axes_have_titles_and_units(figure: Figure) -> None:
    axes = figure.get_axes()
    assert len(axes) == 7
    for one in axes:
        assert "[" in one.get_ylabel()
    for one in axes[2:6]:  # the first two and the mass share the third's
        assert "[" in one.get_xlabel()
    close_ups = [one.get_title(loc="left") for one in axes[3:5]]
    assert close_ups == ["mean_force, 0.25 s", "standard, 1.25 s"]


def test_strikes_are_marked_with_law_and_verdict(figure: Figure, four_strikes: Record) -> None:
    texts = figure.get_axes()[0].texts
    laws, verdicts = texts[::2], texts[1::2]
    assert [law.get_text() for law in laws] == ["mean_force", "standard"] * 2
    table = (four_strikes.folder / "stdout.txt").read_text().splitlines()
    for number, strike in enumerate(four_strikes.summary["strikes"]):
        (row,) = (line for line in table if line.startswith(f"{number + 1} "))
        said = verdicts[number].get_text()
        # In the words of the table, and in a colour that no law has.
        assert said.partition(", ")[2] == row.partition("yes, ")[2].strip()
        assert said.startswith("chatter") == strike["chatter"]
        assert (verdicts[number].get_color() == CHATTER) == strike["chatter"]
        for text in (laws[number], verdicts[number]):
            assert strike["start_s"] < text.xy[0] < strike["end_s"]


def test_no_law_has_the_colour_of_chatter(figure: Figure, four_strikes: Record) -> None:
    strikes = [{"law": str(number)} for number in range(20)]
    assert CHATTER not in law_colours(strikes).values()
    used = {to_hex(line.get_color()).upper() for line in figure.findobj(Line2D)}
    assert CHATTER not in used
    bars = [p for p in figure.axes[0].patches if to_hex(p.get_facecolor()).upper() == CHATTER]
    chattered = [strike for strike in four_strikes.summary["strikes"] if strike["chatter"]]
    assert [bar.get_x() for bar in bars] == [strike["start_s"] for strike in chattered]


def test_it_is_readable_with_few_colours(figure: Figure) -> None:
    assert assert_told_apart(figure) > 3
    assert_readable(figure)
    assert_nothing_overlaps(figure)


def strike_of(law: str, start_s: float, depth: float = 1e-3) -> dict[str, Any]:
    end = {"end_s": start_s + 0.02, "stiffness": 50.0, "chatter": False}
    return {"law": law, "start_s": start_s, "peak_penetration_rad": depth} | end


def signals_of(y: "np.ndarray[Any, np.dtype[np.float64]]") -> pa.Table:
    constant = dict.fromkeys(DRAWN, np.zeros(len(y)))
    return pa.table(constant | {"t_s": np.arange(len(y)) * 1e-3, "y": y})


def test_contact_that_is_shown_is_no_ramp_and_no_graze() -> None:
    y = np.full(600, 0.01)
    for start in (0, 100, 200, 300):
        y[start : start + 20] = -1e-3
    ramp, graze = strike_of("a", 0.0), strike_of("a", 0.1, depth=1e-5)
    real, other = strike_of("a", 0.2), strike_of("a", 0.3)
    signals = signals_of(y)
    assert shown_strikes(signals, [ramp, graze, real, other]) == [real]
    # Before the first row there is no outside; a law that has nothing else is shown as it is.
    assert shown_strikes(signals, [ramp]) == [ramp]
    assert shown_strikes(signals, [ramp, real, strike_of("b", 0.3)])[1]["law"] == "b"


def test_many_strikes_get_a_legend_instead_of_names(tmp_path: Path) -> None:
    drawn = Figure(figsize=(8.0, 3.0))
    axes = drawn.add_subplot()
    strikes = [strike_of(law, 0.01 + 0.05 * k) for k, law in enumerate("ab" * 20)]
    strikes[3]["chatter"] = True
    strikes = [strike | {"chatter_frequency_hz": 40.0} for strike in strikes]
    draw_strikes(axes, signals_of(np.zeros(2000)), strikes, law_colours(strikes))
    assert not axes.texts
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b", "chatter"]


def test_long_signals_keep_what_can_be_seen() -> None:
    t = np.arange(1_000_003) * 1e-3
    y = np.sin(0.37 * t)
    y[123_456], y[1_000_001] = 5.0, -7.0
    thin_t, thin_y = thin_out(t, y, columns=1000)
    assert len(thin_t) < 5100
    assert (thin_y.max(), thin_y.min()) == (5.0, -7.0)
    assert np.all(np.diff(thin_t) > 0.0)
    assert np.array_equal(y[np.searchsorted(t, thin_t)], thin_y)
    # Each column keeps its extremes.
    of_column = y[:1_000_000].reshape(1000, -1)
    starts = np.searchsorted(thin_t, t[:1_000_000:1000])
    np.testing.assert_array_equal(
        np.maximum.reduceat(thin_y, starts)[:-1], of_column.max(axis=1)[:-1]
    )
    assert len(thin_out(t[:4000], y[:4000])[0]) == 4000


def test_it_can_be_warmed_up(capsys: pytest.CaptureFixture[str]) -> None:
    warm_up()
    assert plt.get_fignums() == []


def test_signals_are_drawn_as_recorded(figure: Figure, four_strikes: Record) -> None:
    position, torque = figure.get_axes()[0].lines[0], figure.get_axes()[1].lines[0]
    assert np.array_equal(np.asarray(position.get_ydata()), four_strikes.column("y") * 1e3)
    assert np.array_equal(np.asarray(torque.get_ydata()), four_strikes.column("torque_applied"))
    # The close-up is of a contact with the plain wall: the penetration crosses zero, and the force
    # follows it.
    close_up = figure.get_axes()[4]
    penetration, held = (np.asarray(line.get_ydata(), dtype=float) for line in close_up.lines[:2])
    assert penetration.min() < 0.0 < penetration.max()
    # It is late by the delay of bus and drive, more than one period.
    older = four_strikes.summary["delay_cycles"] - 1.0
    inside = np.maximum(penetration, 0.0)
    expected = older * inside[1:-2] + (1.0 - older) * inside[2:-1]
    assert np.allclose(held[3:], expected, atol=0.2)


@pytest.mark.slow
def test_run_without_contact(tmp_path: Path) -> None:
    done = command("run", "--duration", 0.1, "--output", tmp_path / "run")
    assert done.returncode == 0
    assert Record(tmp_path / "run").summary["strikes"] == []
    assert matplotlib.image.imread(tmp_path / "run" / "run.png").min() < 0.5


def test_no_state_is_left_in_pyplot(copied: RunFolder) -> None:
    plot_run(copied)
    assert plt.get_fignums() == []
    assert not plt.rcParams["axes.grid"]


@pytest.mark.parametrize(("asked", "top"), [(1e9, 320.0), (90.0, 90.5)])
def test_stiffness_asked_for_does_not_hide_that_in_force(asked: float, top: float) -> None:
    columns = {"stiffness": asked, "stiffness_in_force": 80.0, "mass_est": 1e-4}
    signals = {name: np.full(100, value) for name, value in columns.items()}
    axes = Figure().add_subplot()
    draw_in_force(axes, pa.table(signals | {"t_s": np.arange(100) * 1e-3}))
    low, high = axes.get_ylim()
    assert low == 0.0
    assert high == pytest.approx(top, rel=0.02)


def test_own_law_has_its_short_name(four_strikes: Record) -> None:
    own = [
        s | {"law": f"/home/of/somebody/laws.py:{s['law']}"}
        for s in four_strikes.summary["strikes"]
    ]
    drawn = run_figure(read_signals(four_strikes.folder / "signals.parquet", DRAWN), own)
    texts = [text.get_text() for text in drawn.findobj(Text)]
    assert "laws.py:mean_force" in texts
    assert not [text for text in texts if "somebody" in text]
