"""Report of a measured latency: text, picture, histograms as CSV, numbers as JSON."""

import csv
import json
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from canwall.bench.latency import Histogram, Latency, LatencyPhase
from canwall.errors import InputError
from canwall.extras import is_installed
from canwall.figure_style import COLOURS, DPI, PAGE_IN, STYLE
from canwall.record import refuse_taken

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Width of the longest bar [characters].
_BAR = 24
_PERCENTILES = ("p50", "p99", "p999", "max")


class Quantity(NamedTuple):
    """A quantity of each phase.

    Attributes:
        name: Name in the files.
        title: Title in text and picture.
        of: Returns its histogram.
        margin: True if the cycle minus the histogram's value is reported.
    """

    name: str
    title: str
    of: Callable[[LatencyPhase], Histogram]
    margin: bool = False


QUANTITIES = (
    Quantity("sync_error", "SYNC: error of its interval", lambda phase: phase.sync_error),
    Quantity("tpdo_to_rpdo", "TPDO → RPDO", lambda phase: phase.tpdo_to_rpdo),
    Quantity(
        "rpdo_margin", "RPDO: margin before the next SYNC", lambda phase: phase.sync_to_rpdo, True
    ),
)


def percentiles_us(latency: Latency, quantity: Quantity, phase: LatencyPhase) -> dict[str, float]:
    """Return p50, p99, p99.9 and max of a quantity [µs].

    For a margin they are what that share of the cycles has at least, and min.
    """
    histogram = quantity.of(phase)
    values = (getattr(histogram, f"{name}_us") for name in _PERCENTILES)
    if not quantity.margin:
        return dict(zip(("p50", "p99", "p99.9", "max"), values, strict=True))
    period_us = latency.cycle_s * 1e6
    return dict(
        zip(("p50", "p99", "p99.9", "min"), (period_us - value for value in values), strict=True)
    )


def report_lines(latency: Latency) -> Iterator[str]:
    """Yield the histograms as text, with bins of 1, 2, 5, 10 … µs and logarithmic bars."""
    yield (
        f"{latency.interface} {latency.channel}, cycle {latency.cycle_s * 1e3:g} ms, exchange "
        f"{latency.exchange}; the drive is set up but not enabled, with zero torque"
    )
    yield f"load: {latency.load}"
    for what, grant in latency.granted.items():
        advice = f"; {grant.advice}" if grant.advice else ""
        yield f"{what.replace('_', '-')}: {grant.found}{advice}"
    for quantity in QUANTITIES:
        yield ""
        yield f"{quantity.title} [µs]"
        yield from _bar_lines(latency, quantity)
        for phase in latency.phases:
            numbers = percentiles_us(latency, quantity, phase)
            yield f"  {phase.name:>5}: " + ", ".join(f"{k} {v:.1f}" for k, v in numbers.items())
    yield ""
    for phase in latency.phases:
        yield (
            f"{phase.name}: {phase.cycles} cycles, {phase.missed_tpdo} TPDOs missed, "
            f"{phase.late_rpdo} RPDOs after the next SYNC"
        )


def _bar_lines(latency: Latency, quantity: Quantity) -> Iterator[str]:
    histograms = [quantity.of(phase) for phase in latency.phases]
    edges = _bin_edges(max(histogram.max_us for histogram in histograms))
    binned = [_bin_counts(histogram, edges) for histogram in histograms]
    total = max(int(counts.sum()) for counts in binned)
    used = np.flatnonzero(np.sum(binned, axis=0))
    if not len(used):
        return
    names = "".join(f"{phase.name:<{_BAR + 10}}" for phase in latency.phases)
    yield f"  {'':>15}  {names.rstrip()}"
    for k in range(used[0], used[-1] + 1):
        low, high = edges[k], edges[k + 1]
        if quantity.margin:
            period = latency.cycle_s * 1e6
            low, high = period - high, period - low
        bars = "".join(_bar(int(counts[k]), total) for counts in binned)
        yield f"  {low:>6g} – {high:<6g}  {bars.rstrip()}"


def _bar(count: int, total: int) -> str:
    length = math.ceil(_BAR * math.log1p(count) / math.log1p(total)) if count else 0
    return f"{count:>8} {'█' * length:<{_BAR}} "


def _bin_edges(largest_us: float) -> NDArray[np.float64]:
    """Return edges 0, 1, 2, 5, 10 … with the largest value in the last bin [µs]."""
    edges = [0.0]
    decade = 1.0
    while True:
        for step in (1.0, 2.0, 5.0):
            edges.append(step * decade)
            if step * decade >= largest_us:
                return np.array(edges)
        decade *= 10.0


def _bin_counts(histogram: Histogram, edges: NDArray[np.float64]) -> NDArray[np.int64]:
    """Count cycles between the edges, upper ones inclusive; shape (n − 1,)."""
    bins = np.searchsorted(edges[1:], np.minimum(histogram.ends_us, histogram.max_us))
    counts = np.zeros(len(edges) - 1, np.int64)
    np.add.at(counts, bins, histogram.counts)
    return counts


def prepare_folder(folder: Path) -> None:
    """Make the folder of a report before the measurement, which would be lost for want of it.

    Raises InputError if it cannot be written, or holds a report already.
    """
    refuse_taken(folder / f"latency.{ending}" for ending in ("json", "csv", "png"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from None


def write_latency(latency: Latency, folder: Path) -> list[Path]:
    """Write latency.json, latency.csv and latency.png into a folder and return their paths.

    There is no picture without the packages of the extra `plot`.

    latency.csv has every bucket: quantity, phase, upper end [µs], cycles. It has the time from
    SYNC to RPDO instead of the margin. Raises InputError if the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"latency.{ending}" for ending in ("json", "csv")]
        text = json.dumps(json_content(latency), indent=2, ensure_ascii=False)
        paths[0].write_text(text + "\n", encoding="utf-8")
        with paths[1].open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(("quantity", "phase", "up_to_us", "cycles"))
            table.writerows(_csv_rows(latency))
        if is_installed("plot"):
            paths.append(folder / "latency.png")
            _draw_figure(latency, paths[-1])
    except OSError as error:
        raise _unwritable(folder, error) from None
    return paths


def _unwritable(folder: Path, error: OSError) -> InputError:
    return InputError(f"--output {folder}: {error.strerror}; choose another folder")


def json_content(latency: Latency) -> dict[str, Any]:
    """Return the content of latency.json."""
    budget, shortest_cycle = latency.budget, latency.shortest_cycle
    return {
        "interface": latency.interface,
        "channel": latency.channel,
        "bitrate": latency.bitrate,
        "cycle_s": latency.cycle_s,
        "exchange": latency.exchange,
        "machine": {name: grant.found for name, grant in latency.granted.items()},
        "load": latency.load,
        "phases": {
            phase.name: {
                "cycles": phase.cycles,
                "missed_tpdo": phase.missed_tpdo,
                "late_rpdo": phase.late_rpdo,
                **{
                    f"{quantity.name}_us": percentiles_us(latency, quantity, phase)
                    for quantity in QUANTITIES
                },
            }
            for phase in latency.phases
        },
        "bus": {"bits": budget.bits, "share": budget.share, "highest_hz": budget.highest_hz},
        "holds_cycle_s": shortest_cycle.holds_s if math.isfinite(shortest_cycle.holds_s) else None,
        "verdict": shortest_cycle.text,
    }


def _csv_rows(latency: Latency) -> Iterator[tuple[str, str, float, int]]:
    for quantity in QUANTITIES:
        name = "sync_to_rpdo" if quantity.margin else quantity.name
        for phase in latency.phases:
            histogram = quantity.of(phase)
            for end, count in zip(histogram.ends_us, histogram.counts, strict=True):
                yield name, phase.name, float(end), int(count)


def _draw_figure(latency: Latency, path: Path) -> None:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(PAGE_IN, 7.0), layout="constrained", dpi=DPI)
        *panels, counts = figure.subplots(2, 2).ravel()
        for axes, quantity in zip(panels, QUANTITIES, strict=True):
            _draw_panel(axes, latency, quantity)
        _draw_missed(counts, latency)
        rate = f"{latency.cycle_s * 1e3:g} ms"
        figure.suptitle(
            f"{latency.interface} {latency.channel}, {latency.exchange}, cycle {rate}; "
            f"load: {latency.load}",
            fontsize=9,
            x=0.01,
            ha="left",
        )
        figure.savefig(path)


def _styled(latency: Latency) -> Iterator[tuple[LatencyPhase, str, str]]:
    """Yield each phase with its colour and hatch."""
    yield from zip(latency.phases, (COLOURS[0], COLOURS[3]), ("", "///"), strict=False)


def _draw_panel(axes: "Axes", latency: Latency, quantity: Quantity) -> None:
    """Draw the cycles per tenth of an octave, idle and under load, with their p99.9."""
    from matplotlib.ticker import LogLocator, NullFormatter

    filled = [h for h in map(quantity.of, latency.phases) if len(h.ends_us)]
    low = max(0.1, min((histogram.ends_us[0] for histogram in filled), default=0.1))
    high = max(low, max((histogram.max_us for histogram in filled), default=low))
    # Buckets are 1/32 to 1/64 of an octave apart, so every bin of a tenth has at least three.
    edges = low * 2.0 ** (np.arange(-1, math.ceil(10 * math.log2(high / low)) + 2) / 10)
    for phase, colour, hatch in _styled(latency):
        histogram = quantity.of(phase)
        ends = np.clip(histogram.ends_us, edges[0], edges[-1])
        counts, _ = np.histogram(ends, edges, weights=histogram.counts)
        label = f"{phase.name}: no cycle had one"
        if counts.any():
            numbers = percentiles_us(latency, quantity, phase)
            name = f"{phase.name}, margin" if quantity.margin else phase.name
            label = f"{name}: p50 {numbers['p50']:.0f}, p99.9 {numbers['p99.9']:.0f} µs"
            axes.axvline(histogram.p999_us, color=colour, linestyle="--", linewidth=1.2)
        axes.stairs(
            counts,
            edges,
            fill=True,
            facecolor=(colour, 0.35),
            edgecolor=colour,
            hatch=hatch,
            linewidth=1.0,
            label=label,
        )
    axes.set_title(quantity.title)
    what = "time"
    if quantity.margin:
        period_us = latency.cycle_s * 1e6
        axes.axvline(period_us, color="black", linewidth=1.5, label="the next SYNC")
        what = "from SYNC due to RPDO"
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.7, None)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(f"{what} [µs], logarithmic; dashed: p99.9")
    axes.set_ylabel("cycles, logarithmic")
    # Below the axes, where no peak is.
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.22), borderpad=0.0)


def _draw_missed(axes: "Axes", latency: Latency) -> None:
    """Draw the share of cycles without a TPDO, and of those with a late RPDO."""
    names = ("TPDO\nmissed", "RPDO after\nnext SYNC")
    height = 0.8 / len(latency.phases)
    for number, (phase, colour, hatch) in enumerate(_styled(latency)):
        for row, count in enumerate((phase.missed_tpdo, phase.late_rpdo)):
            place = row + (number - 0.5 * (len(latency.phases) - 1)) * height
            share = 100.0 * count / max(phase.cycles, 1)
            axes.barh(
                place,
                share,
                height=0.9 * height,
                facecolor=(colour, 0.35),
                edgecolor=colour,
                hatch=hatch,
                label=phase.name if row == 0 else None,
            )
            axes.text(
                min(share, 40.0) + 2.0,
                place,
                f"{phase.name}: {count} of {phase.cycles}",
                va="center",
                weight="bold" if count else "normal",
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.9},
            )
    axes.set_title("Missed and late frames")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of the cycles [%], linear")
    axes.grid(visible=False, axis="y")
