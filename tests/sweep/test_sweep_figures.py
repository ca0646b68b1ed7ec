"""The figures of a sweep, drawn from its file alone."""

import itertools
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from colour_vision import assert_nothing_overlaps, assert_readable, assert_told_apart
from commands import command
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rig import settings_with

from canwall.analysis.analytic_limits import CEILINGS, delayed_stiffness, stable_stiffness
from canwall.errors import InputError
from canwall.sweep import make_plan, read_sweep, sweep, sweep_table
from canwall.sweep.figures import write_sweep_figures
from canwall.sweep.labels import panel_title, shared_parameters

STRIKE: dict[str, Any] = {"speed": [1.0], "phase": [0.0, 0.5], "press": 0.3}


def swept(path: Path, **axes: Any) -> xr.Dataset:
    return sweep(make_plan(settings_with(), {**STRIKE, **axes}), path)


@pytest.fixture(scope="module")
def z_width(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "map.nc"
    swept(
        path,
        law=["damped", "half_sample"],
        operator="none",
        delay=[0, 1],
        stiffness="0.3:100:12",
        damping="0:0.06:5",
    )
    return path


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Figure]:
    figures: dict[str, Figure] = {}
    monkeypatch.setattr(Figure, "savefig", lambda self, path: figures.__setitem__(path.stem, self))
    return figures


def line(figure: Figure, panel: int, label: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    (found,) = (one for one in figure.axes[panel].get_lines() if one.get_label() == label)
    return np.asarray(found.get_xydata())


@pytest.mark.slow
def test_every_picture_of_a_map_is_written(z_width: Path) -> None:
    done = command("plot", z_width)
    assert (done.returncode, done.stderr) == (0, "")
    assert [Path(word).name for word in done.stdout.split()] == [
        f"map-{name}.png" for name in ("energy", "amplitude", "frequency", "z-width")
    ]
    for word in done.stdout.split():
        height, width, _ = matplotlib.image.imread(word).shape
        assert width > 900
        assert height > 400


@pytest.mark.slow
def test_a_map_has_a_panel_for_each_condition_and_the_limits_in_it(
    z_width: Path, drawn: dict[str, Figure]
) -> None:
    write_sweep_figures(read_sweep(z_width), z_width.with_suffix(""))
    figure = drawn["map-z-width"]
    assert [axes.get_title("left") for axes in figure.axes] == [
        "damped, operator: none, D = 0",
        "damped, operator: none, D = 1",
        "half_sample, operator: none, D = 0",
        "half_sample, operator: none, D = 1",
    ]
    for panel, delay in ((0, 0), (1, 1)):
        for k, b in line(figure, panel, "the same, exact")[::20]:
            assert k == stable_stiffness(1e-4, 5e-4, b, 1e-3, delay)
        for k, b in line(figure, panel, "spring and damper: (b + B)/(T/2 + D·T)"):
            assert k == delayed_stiffness(5e-4, b, 1e-3, delay)
    ((k, b),) = line(figure, 1, "the same, ceiling at b = 0")
    assert (k * 1e-6 / 1e-4, b * 1e-3 / 1e-4) == pytest.approx(CEILINGS[1])
    ((k, b),) = line(figure, 0, "passive with encoder, B = 0 (Abbott, Okamura)")
    assert (k, b) == (pytest.approx(1.0), 0.0)
    # Coloured as the strikes have it.
    for panel, (law, delay) in enumerate([("damped", 0), ("damped", 1)]):
        chatters = read_sweep(z_width)["chatters"].sel(law=law, delay=delay, operator="none")
        (mesh,) = figure.axes[panel].collections
        shown = np.asarray(mesh.get_array()) > 0.5
        np.testing.assert_array_equal(shown, chatters.any(("speed", "phase")).squeeze())
        assert shown.any()
        assert not shown.all()


@pytest.mark.slow
def test_figures_are_readable_with_few_colours(z_width: Path, drawn: dict[str, Figure]) -> None:
    write_sweep_figures(read_sweep(z_width), z_width.with_suffix(""))
    for figure in drawn.values():
        assert assert_told_apart(figure) > 0
        assert_readable(figure)
        assert_nothing_overlaps(figure)


@pytest.mark.slow
def test_energy_is_that_of_the_worst_strike(z_width: Path, drawn: dict[str, Figure]) -> None:
    dataset = read_sweep(z_width)
    write_sweep_figures(dataset, z_width.with_suffix(""))
    there = dataset.sel(law="half_sample", delay=1, operator="none", damping=0.0)
    shown = line(drawn["map-energy"], 1, "half_sample")
    np.testing.assert_array_equal(shown[:, 0], dataset["stiffness"])
    energy = there["energy_out"].squeeze().transpose("stiffness", "phase").values
    worst = np.maximum(energy[:, 0], energy[:, 1])
    np.testing.assert_allclose(shown[:, 1], worst * 1e6)


def test_k_limits_over_the_rate(tmp_path: Path, drawn: dict[str, Figure]) -> None:
    dataset = swept(
        tmp_path / "rate.nc", law=["standard", "midpoint"], operator="finger", rate="400:1000:3"
    )
    write_sweep_figures(dataset, tmp_path / "rate")
    figure = drawn["rate-limit-over-rate"]
    for law in ("standard", "midpoint"):
        shown = line(figure, 0, law)
        np.testing.assert_array_equal(shown[:, 0], [400, 700, 1000])
        worst = dataset["worst"].sel(law=law).squeeze() / 2.28e-4 / dataset["rate"] ** 2
        np.testing.assert_allclose(shown[:, 1], worst)
    linear = line(figure, 0, "spring and damper, linear, exact")
    for rate, limit in linear:
        exact = stable_stiffness(2.28e-4, 0.0261, 0.0, 1.0 / rate, 1)
        assert limit == pytest.approx(exact / 2.28e-4 / rate**2, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("low", "high"), [(10.0, 16.0), (0.01, 0.3)])
def test_stiffnesses_along_an_axis_can_be_read(
    tmp_path: Path, drawn: dict[str, Figure], low: float, high: float
) -> None:
    whole = swept(tmp_path / "a.nc", stiffness=[1.0, 2.0], damping=[0.0, 0.1], speed=1, phase=0)
    write_sweep_figures(whole.assign_coords(stiffness=[low, high]), tmp_path / "a")
    for figure in drawn.values():
        FigureCanvasAgg(figure).draw()
        axis = figure.axes[0].xaxis
        ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
        labels = [t.label1 for t in ticks if t.label1.get_text() and low <= t.get_loc() <= high]
        assert len(labels) >= 3
        boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
        assert all(one.x1 < other.x0 for one, other in itertools.pairwise(boxes))


def test_each_strike_is_drawn_where_the_worst_chatters_on_every_wall(
    tmp_path: Path, drawn: dict[str, Figure]
) -> None:
    limits = swept(tmp_path / "a.nc", speed=1, law=["standard"])
    limits["worst"][:] = limits["worst_normalised"][:] = limits["limit"][..., 0] = 0.0
    write_sweep_figures(limits, tmp_path / "a")
    (strikes, _) = drawn["a-limits"].axes[0].get_lines()
    best = limits["limit"].max() * limits["period"] ** 2 / limits["inertia"]
    np.testing.assert_allclose(strikes.get_xdata(), [0.0, best.item()])


def test_limits_of_zero_alone_can_be_drawn(tmp_path: Path, drawn: dict[str, Figure]) -> None:
    limits = swept(tmp_path / "a.nc", speed=1, phase=0, law="standard")
    limits["worst"][:] = limits["worst_normalised"][:] = limits["limit"][:] = 0.0
    write_sweep_figures(limits, tmp_path / "a")
    axes = drawn["a-limits"].axes[0]
    low, high = axes.get_xlim()
    assert all(low < x < high for one in axes.get_lines() for x in one.get_xdata())


@pytest.mark.slow
def test_long_names_of_laws_and_axes_have_room(tmp_path: Path, drawn: dict[str, Figure]) -> None:
    law = f"{Path(__file__).parents[2] / 'docs' / 'my_law.py'}:my_law"
    axes: dict[str, Any] = {"law": ["standard", law], "speed": 1, "phase": 0, "press": 0.1}
    several = {"sync_jitter": [0.0, 5e-5], "simulation.viscous_nm_s_per_rad": [0.0005, 0.001]}
    walls = swept(tmp_path / "a.nc", stiffness=[5.0, 10.0], damping=[0.0, 0.01], **axes, **several)
    write_sweep_figures(walls, tmp_path / "a")
    write_sweep_figures(swept(tmp_path / "b.nc", **axes), tmp_path / "b")
    assert drawn["a-energy"].legends[0].get_texts()[1].get_text() == "my_law.py:my_law"
    assert drawn["b-limits"].axes[0].get_yticklabels()[1].get_text() == "my_law.py:my_law"
    for figure in drawn.values():
        assert_nothing_overlaps(figure)


@pytest.mark.slow
def test_limits_of_one_condition_and_what_cannot_be_drawn(tmp_path: Path) -> None:
    limits = swept(tmp_path / "limits.nc", law=["standard", "midpoint"])
    (path,) = write_sweep_figures(limits, tmp_path / "limits")
    assert path.name == "limits-limits.png"
    with pytest.raises(InputError, match="cannot be written"):
        write_sweep_figures(limits, tmp_path / "nowhere" / "limits")
    point = swept(tmp_path / "point.nc", stiffness=[10.0])
    with pytest.raises(InputError, match="has a single stiffness"):
        write_sweep_figures(point, tmp_path / "point")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "no such file"),
        (b"", "not the result of a sweep"),
        (b"no result", "not the result of a sweep"),
    ],
)
def test_a_file_that_is_no_sweep(tmp_path: Path, content: bytes | None, line: str) -> None:
    if content is not None:
        (tmp_path / "a.nc").write_bytes(content)
    done = command("plot", "a.nc", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"canwall: a.nc: {line}")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_damping_ratio_stands_where_a_damping_would(tmp_path: Path) -> None:
    settings = settings_with({"wall.damping_ratio": 0.5})
    of_ratio = sweep(make_plan(settings, {**STRIKE, "stiffness": [5.0, 10.0]}), tmp_path / "r.nc")
    assert "ζ = 0.5" in shared_parameters(of_ratio.isel(damping=0))
    undamped = swept(tmp_path / "b.nc", stiffness=[5.0, 10.0])
    assert "B = 0 N·m·s/rad," in shared_parameters(undamped.isel(damping=0))
    ratios = {"stiffness": [5.0, 10.0], "wall.damping_ratio": [0.0, 0.3]}
    of_axis = sweep(make_plan(settings, {**STRIKE, **ratios}), tmp_path / "a.nc")
    # The titles of the panels have it.
    assert "ζ" not in shared_parameters(of_axis)
    assert "ζ = 0.3" in shared_parameters(of_axis.isel({"wall.damping_ratio": 1}))


@pytest.mark.slow
def test_damping_of_k_limits_is_told(tmp_path: Path, drawn: dict[str, Figure]) -> None:
    given = {**STRIKE, "law": "standard", "rate": [900, 1000], "phase": 0.0}
    for ratio, told, walls in ((0.5, "ζ = 0.5", "alone"), (0.0, "B = 0 N·m·s/rad", "and damper")):
        settings = settings_with({"wall.damping_ratio": ratio})
        limits = sweep(make_plan(settings, given), tmp_path / f"{ratio}.nc")
        write_sweep_figures(limits, tmp_path / "k")
        figure = drawn["k-limit-over-rate"]
        assert told in " ".join(figure.get_suptitle().split())
        assert len(line(figure, 0, f"spring {walls}, linear, exact")) == 2


def test_true_and_false_are_called_so(tmp_path: Path) -> None:
    axis = {"stiffness": [5.0, 10.0], "operator.adapt": [True, False]}
    dataset = swept(tmp_path / "a.nc", law=["standard"], **axis)
    assert panel_title(dataset, {"operator.adapt": 1}) == "operator.adapt = false"
    column = sweep_table(dataset).columns[1]
    assert (column.header, [*column.cells]) == ("operator.adapt", ["true", "false"])
