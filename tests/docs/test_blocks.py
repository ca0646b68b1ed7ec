"""Every code block of the documentation, played: a page from top to bottom in a folder of its own.

The folder looks like a checkout. What differs from what a reader would see:

- Grids of a sweep, LO:HI:N, have two points.
- A configuration for a bench is played on the simulated drive, on the embedded bus.
- Questions are answered with q.
- A command in the background (`&`) is interrupted at the next heading.
"""

import contextlib
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
_SOCKET = "/tmp/canwall.sock"


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(blocks(p))], ids=lambda p: str(p.relative_to(ROOT))
)
def test_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with contextlib.closing(Player(tmp_path)) as player:
        index = page.with_name("index.md")
        if index != page and index.parent != DOCS and index.exists():
            # The pages of a folder go on with the files of its first page.
            player.play(block for block in blocks(index) if block.caption)
        player.play(blocks(page))


def test_what_is_not_played_is_known() -> None:
    """A new one has to be counted here."""
    unplayed = Counter(block.remark for page in PAGES for block in blocks(page) if block.remark)
    assert unplayed == {
        "root": 2,
        "interactive": 1,
        "socketcan": 1,
        "long": 4,
        "development": 4,
        FAILS: 1,
    }
    assert set(unplayed) - {FAILS} == set(UNPLAYED)


class Player:
    """Plays blocks in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names: dict[str, Any] = {"__name__": "__main__"}
        self._background: list[tuple[str, ForkedPopen[str]]] = []
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
            path.write_text(
                block.text if block.caption else tomli_w.dumps(_merged(BASE, written)),
                encoding="utf-8",
            )
            run_laws(config.load(path))
        except ValueError as error:
            pytest.fail(f"{block.where}: {error}", pytrace=False)
        bus = {**written.get("bus", {}), "interface": "virtual", "channel": "canwall"}
        on_the_simulated_drive = {"simulation": {}, **written, "bus": bus}
        path.write_text(tomli_w.dumps(on_the_simulated_drive), encoding="utf-8")

    # Commands

    def _shell(self, block: Block) -> None:
        for where, words in commands(block):
            if words[0] in SCRIPTS:
                continue
            if words[0] not in PROGRAMS:
                pytest.fail(f"{where}: {words[0]}: not known to this test", pytrace=False)
            words = [self._local(_two_points(word)) for word in words]
            if words[-1] == "&":
                self._start(where, words[:-1])
            else:
                self._run(where, words, expected=1 if block.remark == FAILS else 0)

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


def _merged(below: Any, above: Any) -> Any:
    """Tables key by key; all else from above."""
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    return below | {key: _merged(below.get(key), value) for key, value in above.items()}
