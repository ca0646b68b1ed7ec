"""The picture of a run, from its record alone."""

import shutil
from pathlib import Path

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
from commands import Record, command
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from canwall.config import ConfigError
from canwall.record import RunFolder
from canwall.record.pictures import plot_run


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
    for one in (axes[2], *axes[4:]):  # the first two and the mass share the third's
        assert "[" in one.get_xlabel()
    close_ups = [one.get_title(loc="left") for one in axes[4:6]]
    assert close_ups == ["First contact: mean_force", "First contact: standard"]


def test_strikes_are_marked_with_law_and_verdict(figure: Figure, four_strikes: Record) -> None:
    texts = [text.get_text() for text in figure.get_axes()[0].texts]
    assert [text.split("\n")[0] for text in texts] == ["mean_force", "standard"] * 2
    assert [text.split("\n")[1][:7] for text in texts] == ["no chat", "chatter"] * 2
    for text, strike in zip(
        figure.get_axes()[0].texts, four_strikes.summary["strikes"], strict=True
    ):
        assert strike["start_s"] < text.get_position()[0] < strike["end_s"]


def test_signals_are_drawn_as_recorded(figure: Figure, four_strikes: Record) -> None:
    position, torque = figure.get_axes()[0].lines[0], figure.get_axes()[1].lines[0]
    assert np.array_equal(np.asarray(position.get_ydata()), four_strikes.column("y") * 1e3)
    assert np.array_equal(np.asarray(torque.get_ydata()), four_strikes.column("torque_applied"))
    # The close-up is of a contact with the plain wall: the penetration crosses zero, and the force
    # follows it.
    close_up = figure.get_axes()[5]
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
