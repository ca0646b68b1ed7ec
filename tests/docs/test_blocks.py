"""Every code block of the documentation, played: a page from top to bottom in a folder of its own.

The folder looks like a checkout. What differs from what a reader would see:

- Grids of a sweep, LO:HI:N, have two points; what is waited for has no --duration beyond 1 s.
- A configuration for a bench is played on the simulated drive, on the embedded bus; a command on
  can0 on unixcan, where the drive of the rehearsal is.
- The doctor, which goes by the clock, has a slower cycle and a longer watchdog.
- A configuration that a command has written and the page shows has to be the same, but for [bus]
  and paths.
- Questions are answered with q.
- A command in the background (`&`) is interrupted at the next heading.
"""

import contextlib
import csv
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
import tomli_w
from commands import COMMAND, PATIENCE_S, wait_for
from fork_server import ForkedPopen
from pages import DOCS, FAILS, PAGES, ROOT, UNPLAYED, Block, blocks

from canwall import config
from canwall.cli import INTERRUPTED
from canwall.cycle import run_laws

#: Commands of the documentation, and what they are called by here.
PROGRAMS = {
    "canwall": [COMMAND],
    "scripts/run": [COMMAND, "run"],
    "python": [sys.executable],
}
#: Not played from within the tests.
SCRIPTS = ("scripts/test",)
#: Configuration that completes a part of one.
BASE = {
    "drive": {"node_id": 5, "eds": "eds/canwall-drive.eds"},
    "mechanics": {"inertia_kg_m2": 1.64e-4},
    "limits": {"torque_nm": 1.9},
}
PATIENT = {
    "bus": {"cycle_s": 0.01},
    "drive": {"watchdog_s": 0.5},
    "limits": {"hold_cycles": 100, "ramp_cycles": 1000, "late_cycles": 0},
}
#: The handle of a bench is free.
NOBODY = {"inertia_kg_m2": 0.0, "damping_nm_s_per_rad": 0.0, "stiffness_nm_per_rad": 0.0}
_SOCKET = "/tmp/canwall.sock"
#: SDO request for 0x1000 of node 5.
_DEVICE_TYPE = can.Message(
    arbitration_id=0x605, data=b"\x40\x00\x10\0\0\0\0\0", is_extended_id=False
)
#: The configuration of the simulated drive with which the bench guide is rehearsed.
REHEARSAL = "rehearsal.toml"
#: Words of a command on a bench, and what they are in a rehearsal.
ON_UNIXCAN = {"socketcan": "unixcan", "can0": _SOCKET}


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(blocks(p))], ids=lambda p: str(p.relative_to(ROOT))
)
def test_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with contextlib.closing(Player(tmp_path)) as player:
        if page.parent != DOCS and page.with_name("index.md").exists():
            # The pages of a folder share their files.
            for other in sorted(set(page.parent.glob("*.md")) - {page}):
                player.play(block for block in blocks(other) if block.caption)
        player.play(blocks(page))


@pytest.mark.slow
def test_encoder_of_the_tutorial_sticks_as_the_handle_enters_the_wall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    parts = [b for b in blocks(DOCS / "tutorial.md") if "stuck" in (b.caption or b.text)]
    with contextlib.closing(Player(tmp_path)) as player:
        player.play(iter(parts))
    with (tmp_path / "runs/stuck/trip.csv").open(encoding="utf-8") as file:
        depths = [-float(row["y"]) for row in csv.DictReader(file)]
    assert len(depths) == 200
    assert depths[-6] == depths[-1] > 0.0 > depths[-8]


def test_what_is_not_played_is_known() -> None:
    """A new one has to be counted here."""
    unplayed = Counter(block.remark for page in PAGES for block in blocks(page) if block.remark)
    assert unplayed == {
        "root": 5,
        "interactive": 3,
        "socketcan": 2,
        "long": 4,
        "development": 7,
        FAILS: 1,
    }
    assert set(unplayed) - {FAILS} == set(UNPLAYED)


class Player:
    """Plays blocks in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names: dict[str, Any] = {"__name__": "__main__"}
        self._background: list[tuple[str, ForkedPopen[str]]] = []
        self._files: set[Path] = set()
        for name in ("docs", "eds"):
            (folder / name).symlink_to(ROOT / name)
        shutil.copytree(ROOT / "config", folder / "config")
        for file in (folder / "config").rglob("*.toml"):
            file.write_text(self._local(file.read_text(encoding="utf-8")), encoding="utf-8")

    def play(self, page: Iterator[Block]) -> None:
        section = 0
        for block in page:
            if block.section != section:
                section = block.section
                self._end_background()
            if block.remark in UNPLAYED or block.language == "text":
                continue
            {"sh": self._shell, "python": self._python, "toml": self._toml}[block.language](block)
        self._end_background()

    def close(self) -> None:
        for _, process in self._background:
            process.kill()
            process.communicate()

    def _local(self, text: str) -> str:
        """Sockets in this folder."""
        return text.replace(_SOCKET, str(self._folder / "canwall.sock"))

    # Python

    def _python(self, block: Block) -> None:
        # Blank lines in front: an error names the line of the page.
        code = compile("\n" * (block.line - 1) + block.text, str(block.page), "exec")
        exec(code, self._names)

    # TOML

    def _toml(self, block: Block) -> None:
        try:
            written = tomllib.loads(block.text)
            path = self._folder / (block.caption or "fragment.toml")
            by_command = self._made_by_command(path)
            self._files.add(path)
            path.write_text(
                block.text if block.caption else tomli_w.dumps(_merged(BASE, written)),
                encoding="utf-8",
            )
            run_laws(config.load(path))
        except ValueError as error:
            pytest.fail(f"{block.where}: {error}", pytrace=False)
        if (differs := _differences(written, by_command)) and by_command:
            pytest.fail(f"{block.where}: the command writes {differs}", pytrace=False)
        bus = written.get("bus", {})
        if "simulation" not in written or bus.get("interface") != "unixcan":
            written |= {"bus": {**bus, "interface": "virtual", "channel": "canwall"}}
        text = tomli_w.dumps({"simulation": {"hand": NOBODY}, **written})
        path.write_text(self._local(text), encoding="utf-8")

    def _made_by_command(self, path: Path) -> dict[str, Any]:
        """Return what a command has written into a file that the page shows, else nothing."""
        if path in self._files or not path.exists():
            return {}
        return tomllib.loads(path.read_text(encoding="utf-8"))

    def _patient(self, path: Path) -> None:
        """Give a configuration a slow cycle: the doctor goes by the clock of a busy machine."""
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
        path.write_text(tomli_w.dumps(_merged(settings, PATIENT)), encoding="utf-8")

    # Commands

    def _shell(self, block: Block) -> None:
        for where, words in commands(block):
            if words[0] in SCRIPTS:
                continue
            if words[0] not in PROGRAMS:
                pytest.fail(f"{where}: {words[0]}: not known to this test", pytrace=False)
            if "can0" in words and not self._background:
                self._start(where, ["canwall", "drive", REHEARSAL, "--real-time"])
            words = [self._local(_two_points(ON_UNIXCAN.get(word, word))) for word in words]
            if words[:2] == ["canwall", "doctor"] and self._folder / words[2] in self._files:
                self._patient(self._folder / words[2])
            if words[-1] == "&":
                self._start(where, words[:-1])
            else:
                self._run(where, _short(words), expected=1 if block.remark == FAILS else 0)

    def _popen(self, words: list[str]) -> "ForkedPopen[str]":
        pipe = subprocess.PIPE
        program = PROGRAMS[words[0]] + words[1:]
        return ForkedPopen[str](program, stdin=pipe, stdout=pipe, stderr=pipe, text=True)

    def _run(self, where: str, words: list[str], expected: int) -> None:
        with self._popen(words) as process:
            try:
                output, errors = process.communicate("q\n" * 9, PATIENCE_S)
            except BaseException:
                process.kill()
                raise
        if process.returncode != expected:
            said = f"ended with {process.returncode}\n{output}{errors}"
            pytest.fail(f"{where}: {shlex.join(words)}: {said}", pytrace=False)

    def _start(self, where: str, words: list[str]) -> None:
        """Start a program and wait until it is there: a drive says so, a run can be changed."""
        process = self._popen(words)
        self._background.append((where, process))
        if "--output" in words:
            live = Path(words[words.index("--output") + 1]) / "live.json"
            wait_for(lambda: live.exists() or process.poll() is not None)
        else:
            assert process.stdout is not None
            process.stdout.readline()
        if "--real-time" in words:
            # It may have to compile before it answers.
            wait_for(lambda: self._drive_answers() or process.poll() is not None)

    def _drive_answers(self) -> bool:
        with can.Bus(interface="unixcan", channel=self._local(_SOCKET)) as bus:
            bus.send(_DEVICE_TYPE)
            return bus.recv(1.0) is not None

    def _end_background(self) -> None:
        while self._background:
            where, process = self._background[0]
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=PATIENCE_S)
            del self._background[0]
            if process.returncode not in (0, INTERRUPTED):
                said = f"ended with {process.returncode}\n{output}{errors}"
                pytest.fail(f"{where}: {said}", pytrace=False)


def commands(block: Block) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the words of each command in a block; a backslash joins two lines."""
    text, first = "", block.line
    for line, part in enumerate(block.text.splitlines(), start=block.line):
        first = first if text else line
        text += part.removesuffix("\\")
        if part.endswith("\\"):
            continue
        if words := shlex.split(text, comments=True):
            yield f"{block.page.relative_to(ROOT)}:{first}", words
        text = ""


def _two_points(word: str) -> str:
    return re.sub(r"^((?:[\w.]+=)?[\d.]+:[\d.]+):\d+$", r"\1:2", word)


def _short(words: list[str]) -> list[str]:
    return [
        "1" if before == "--duration" and float(word) > 1.0 else word
        for before, word in zip(["", *words], words, strict=False)
    ]


def _differences(shown: dict[str, Any], made: dict[str, Any]) -> dict[str, Any]:
    """Return the keys, by table, in which a file is not what a page shows of it."""
    return {
        f"{table}.{key}": made.get(table, {}).get(key)
        for table, keys in shown.items()
        if isinstance(keys, dict)
        for key, value in keys.items()
        if table != "bus" and key != "eds" and made.get(table, {}).get(key) != value
    }


def _merged(below: Any, above: Any) -> Any:
    """Tables key by key; all else from above."""
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    return below | {key: _merged(below.get(key), value) for key, value in above.items()}
