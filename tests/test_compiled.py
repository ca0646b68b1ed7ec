"""Code that is called is the code that is there, wherever it is kept, whoever starts beside."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import canwall
from canwall import code_on_disk
from canwall.compiled import data_to_number, number_to_data

#: Two modules of the copy: a function that calls one of another file. They compile in no time.
CALLED = """
from canwall.compiled import compiled

@compiled
def way(t: float) -> float:
    return 0.5 * t * t
"""
CALLER = """
from canwall.called import way
from canwall.compiled import compiled

@compiled
def fallen(t: float) -> float:
    return -2.0 * way(t)
"""
FALL = """
from canwall.compiled import _compiling
missed = []
_compiling.note_miss = lambda: missed.append(1)
from canwall.caller import fallen
print(fallen(1.0), "compiled" if missed else "loaded")
"""
PATIENCE_S = 300.0


class Installation:
    """A copy of the package, and the environment in which its programs start."""

    def __init__(self, folder: Path) -> None:
        self.package = folder / "canwall"
        source = Path(canwall.__file__).parent
        shutil.copytree(source, self.package, ignore=shutil.ignore_patterns("__pycache__"))
        (self.package / "called.py").write_text(CALLED)
        (self.package / "caller.py").write_text(CALLER)
        self.user = folder / "user"
        self.environment = {
            **{name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"},
            "XDG_CACHE_HOME": str(self.user),
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def start(self, program: str = FALL) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", program],
            cwd=self.package.parent,
            env={**self.environment, "PYTHONPATH": str(self.package.parent)},
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, program: str = FALL) -> str:
        started = self.start(program)
        output, _ = started.communicate(timeout=PATIENCE_S)
        assert started.returncode == 0
        return output.strip()

    def change(self, words: str, others: str) -> None:
        """Exchange words of the function that is called, in another file."""
        called = self.package / "called.py"
        text = called.read_text()
        assert text.count(words) == 1
        called.write_text(text.replace(words, others))

    def refuse_files(self) -> None:
        """Make it impossible to keep anything beside the sources, for root as well."""
        for folder in (self.package, *self.package.rglob("*/")):
            if folder.is_dir():
                (folder / "__pycache__").touch()


@pytest.fixture
def installation(tmp_path: Path) -> Installation:
    return Installation(tmp_path)


def beside(installation: Installation) -> Path:
    return installation.package / "__pycache__"


def in_a_given_folder(installation: Installation) -> Path:
    given = installation.package.parent / "given"
    installation.environment["NUMBA_CACHE_DIR"] = str(given)
    return given


def in_the_users_cache(installation: Installation) -> Path:
    installation.refuse_files()
    return installation.user


def nowhere(installation: Installation) -> Path | None:
    installation.refuse_files()
    installation.user.touch()
    return None


@pytest.mark.slow
@pytest.mark.parametrize("place", [beside, in_a_given_folder, in_the_users_cache, nowhere])
def test_change_in_another_file_is_noticed(
    installation: Installation, place: Callable[[Installation], Path | None]
) -> None:
    folder = place(installation)
    kept = "compiled" if folder is None else "loaded"
    assert installation.run() == "-1.0 compiled"
    assert installation.run() == f"-1.0 {kept}"
    installation.change("0.5", "1.5")
    assert installation.run() == "-3.0 compiled"
    # The code of other sources has been left to those who run them.
    installation.change("1.5", "0.5")
    assert installation.run() == f"-1.0 {kept}"
    if folder is not None:
        assert len(list(folder.rglob("compiled-*"))) == 2


@pytest.mark.slow
def test_several_first_starts_at_once(installation: Installation) -> None:
    for process in [installation.start() for _ in range(4)]:
        output, _ = process.communicate(timeout=PATIENCE_S)
        assert output.startswith("-1.0")
    assert installation.run() == "-1.0 loaded"
    for file in beside(installation).rglob("*-*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[:-1])
    assert installation.run() == "-1.0 compiled"


def test_first_start_is_one_to_its_end(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also once it has kept its first function: what compiles beside it is asked for later."""
    folder = tmp_path / "compiled"
    monkeypatch.setattr(code_on_disk, "_folders", lambda: [folder])
    code_on_disk.is_first_start.cache_clear()
    assert code_on_disk.is_first_start()
    folder.mkdir()
    assert code_on_disk.is_first_start()
    code_on_disk.is_first_start.cache_clear()
    assert not code_on_disk.is_first_start()
    code_on_disk.is_first_start.cache_clear()


@pytest.mark.slow
def test_process_whose_sources_change_keeps_nothing(installation: Installation) -> None:
    """It may have imported a source before or after the change."""
    changing = "import canwall.physics, pathlib; pathlib.Path('canwall/units.py').touch()\n"
    assert installation.run(changing + FALL) == "-1.0 compiled"
    assert not list(installation.package.parent.rglob("compiled-*"))


def test_folders_of_other_sources_are_removed_when_unused(tmp_path: Path) -> None:
    now_s, day_s = time.time(), 86400.0
    for days in range(20):
        (tmp_path / f"compiled-{days}").mkdir()
        os.utime(tmp_path / f"compiled-{days}", (now_s, now_s - (0.6 + 0.1 * days) * day_s))
    present = tmp_path / "compiled-19"
    code_on_disk._tidy_up(present)
    assert abs(present.stat().st_mtime - now_s) < 0.5 * day_s
    left = {int(folder.name.partition("-")[2]) for folder in tmp_path.iterdir()}
    assert left == {*range(8), 19}
    # However many have been used within the last day.
    for days in range(20):
        (tmp_path / f"compiled-{days}").mkdir(exist_ok=True)
        os.utime(tmp_path / f"compiled-{days}")
    code_on_disk._tidy_up(tmp_path / "compiled-18")
    assert len(list(tmp_path.iterdir())) == 20


def test_rooms_without_compiled_code_have_none() -> None:
    package = Path(canwall.__file__).parent
    for room in code_on_disk._WITHOUT_COMPILED_CODE:
        for source in (package / room).rglob("*.py"):
            assert "@compiled" not in source.read_text()
            assert "compiled_for_c" not in source.read_text()


def test_data_survive_the_way_through_a_number() -> None:
    for data in (b"", b"\x01", bytes(range(248, 256)), b"\x00\xff", bytes(8)):
        assert number_to_data(data_to_number(data), len(data)) == data
