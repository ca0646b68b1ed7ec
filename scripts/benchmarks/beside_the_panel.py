"""A run in real time with its panel open in a browser, and without, in turns."""

import itertools
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from canwall import config
from canwall.record.columns import TIMING_COLUMNS

_TURNS, _SECONDS = 7, 20.0
#: From the start of a run until its wall and its page can be looked at [s], and for how long.
_BEGINS_S, _LOOKS_S = 4.0, 12.0
_TICKS = os.sysconf("SC_CLK_TCK")
_PYTHON = (sys.executable, "-m", "canwall")


def panel_beside() -> dict[str, Any]:
    """From TPDO to RPDO with a page that shows the run, and without one; what the page costs.

    The drive is simulated in the process of the run, in real time at 1 kHz, and its hand strikes.
    There is a browser in both. Shares are of one processor; the browser draws without a graphics
    card. The signals are those of runs in simulated time, with a panel beside and without.
    """
    from playwright.sync_api import sync_playwright

    beside: list[dict[str, Any]] = []
    ratios: list[float] = []
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        folders = (Path(name, str(n)) for n in itertools.count())
        real_time = _configuration(Path(name, "real_time.toml"), "real_time")
        for turn in range(_TURNS):
            found = {}
            for panel in (True, False) if turn % 2 else (False, True):
                found[panel] = _turn(real_time, next(folders), browser if panel else None)
            beside.append(found[True])
            ratios.append(found[True]["p99.9_us"] / found[False]["p99.9_us"])
            beside[-1]["p99.9_alone_us"] = found[False]["p99.9_us"]
        simulated = _configuration(Path(name, "simulated.toml"), "simulated")
        same = _signals(simulated, next(folders), browser).equals(
            _signals(simulated, next(folders), None)
        )
        browser.close()
    names = ("frames_per_s", "panel_share", "browser_share", "p99.9_us", "p99.9_alone_us")
    medians = {n: round(statistics.median(turn[n] for turn in beside), 2) for n in names}
    return {
        "aim": "ratio <= 1.2",
        "ratio": round(statistics.median(ratios), 2),
        "repeats": [round(ratio, 2) for ratio in ratios],
        **medians,
        "missed_tpdo": [turn["missed_tpdo"] for turn in beside],
        "same_signals": same,
    }


def _configuration(path: Path, pace: str) -> Path:
    """Write config/sim.toml with another pace, and a hand that goes on striking."""
    text = config.shipped("config/sim.toml").read_text()
    for pattern, new in (
        (r"\.\./eds/canwall-drive\.eds", str(config.shipped("eds/canwall-drive.eds"))),
        (r'pace = "auto"', f'pace = "{pace}"'),
        (r"strikes = 4", "strikes = 1000"),
        (r"(?s)\n\[\[schedule\]\].*", "\n"),
    ):
        text, count = re.subn(pattern, new, text)
        assert count, pattern
    path.write_text(text)
    return path


def _turn(file: Path, folder: Path, browser: Any) -> dict[str, Any]:
    """Measure a run, with a page that shows it if there is a browser for it."""
    words = ("run", str(file), "--duration", str(_SECONDS), "--output", str(folder))
    with _started(*words) as run:
        found = {}
        if browser is None:
            run.wait()
        else:
            found = _page_beside(folder, browser, run)
    timing = json.loads((folder / "summary.json").read_text())
    found["p99.9_us"] = timing["timing"]["tpdo_to_rpdo"]["p99.9_us"]
    found["missed_tpdo"] = timing["missed_tpdo"]
    return found


def _page_beside(folder: Path, browser: Any, run: "subprocess.Popen[bytes]") -> dict[str, Any]:
    """Show a run in the browser to its end; frames drawn a second, and shares of a processor."""
    while not (folder / "live.json").exists():
        assert run.poll() is None
        time.sleep(0.05)
    with _started("panel", str(folder), "--no-browser", stdout=subprocess.PIPE) as panel:
        assert panel.stdout is not None
        said = re.search(rb"http://\S+", panel.stdout.readline())
        assert said is not None
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(said[0].decode())
        page.wait_for_timeout(1e3 * _BEGINS_S)
        renderers = _tree(os.getpid(), b"chromium")
        began, used = time.monotonic(), (_used({panel.pid}), _used(renderers))
        page.wait_for_timeout(1e3 * _LOOKS_S)
        passed = time.monotonic() - began
        found = {
            "frames_per_s": int(page.inner_text("#f-page").split()[0]),
            "panel_share": (_used({panel.pid}) - used[0]) / passed,
            "browser_share": (_used(renderers) - used[1]) / passed,
        }
        run.wait()
        page.close()
        panel.terminate()
    return found


def _signals(file: Path, folder: Path, browser: Any) -> Any:
    """Return the signals of a run in simulated time that a page has looked at, or nobody."""
    words = ("run", str(file), "--duration", "200", "--output", str(folder))
    with _started(*words) as run:
        if browser is not None:
            while not (folder / "live.json").exists():
                time.sleep(0.01)
            with _started("panel", str(folder), "--no-browser", stdout=subprocess.PIPE) as panel:
                assert panel.stdout is not None
                said = re.search(rb"http://\S+", panel.stdout.readline())
                assert said is not None
                page = browser.new_page()
                page.goto(said[0].decode())
                run.wait()
                page.close()
                panel.terminate()
        run.wait()
    return pq.read_table(folder / "signals.parquet").drop_columns(list(TIMING_COLUMNS))


@contextmanager
def _started(*words: str, stdout: int = subprocess.DEVNULL) -> "Iterator[subprocess.Popen[bytes]]":
    with subprocess.Popen([*_PYTHON, *words], stdout=stdout, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()


def _tree(root: int, name: bytes) -> set[int]:
    """Return the processes below one that have a name."""
    found: set[int] = set()
    waiting = [root]
    while waiting:
        pid = waiting.pop()
        try:
            for task in Path(f"/proc/{pid}/task").iterdir():
                waiting += map(int, (task / "children").read_text().split())
            if name in Path(f"/proc/{pid}/comm").read_bytes():
                found.add(pid)
        except OSError:
            continue  # it has ended
    return found


def _used(pids: set[int]) -> float:
    """Return the processor time of processes so far [s]."""
    ticks = 0
    for pid in pids:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        ticks += int(fields[11]) + int(fields[12])
    return ticks / _TICKS
