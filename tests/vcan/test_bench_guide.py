"""Error frames, as the bench guide shows them."""

import itertools
import os
import re
from pathlib import Path

from pages import DOCS, blocks
from socketcan import Bench, wait_for

GUIDE = DOCS / "bench" / "wiring.md"
#: An error frame as candump -e shows it, and the lines that explain it.
_SHOWN = re.compile(r"^can0  (\w{8})   \[8\]  (.{23})   ERRORFRAME\n((?:\t.*\n)+)", re.MULTILINE)


def _shown() -> list[tuple[str, ...]]:
    text = GUIDE.read_text(encoding="utf-8")
    return [match.groups() for match in _SHOWN.finditer(text)]


def test_candump_shows_errors_as_the_guide_does(tmp_path: Path) -> None:
    frames = _shown()
    assert len(frames) == 5
    bench = Bench(tmp_path, "native")
    dump = tmp_path / "candump.txt"
    command = next(block for block in blocks(GUIDE) if "candump" in block.text).text
    bench.start("stdbuf", "-oL", *command.replace("can0", "vcan0").split(), output=dump)
    try:
        # candump may need a moment until it listens.
        for sent in itertools.count():
            bench.start("cansend", "vcan0", "123#00").wait()
            if "123" in dump.read_text():
                break
            assert sent < 1000
        for can_id, data, _ in frames:
            bench.start("cansend", "vcan0", f"{can_id}#{data.replace(' ', '')}").wait()
        wait_for(lambda: dump.read_text().count("ERRORFRAME") == len(frames))
        wait_for(lambda: os.stat(dump).st_size > 0 and dump.read_text().endswith("\n"))
    finally:
        bench.close()
    shown = dump.read_text()
    for can_id, data, explained in frames:
        assert re.search(
            rf"vcan0  {can_id} +\[8\]  {data} +ERRORFRAME\n{re.escape(explained)}", shown
        )
