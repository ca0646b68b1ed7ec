"""The package as it is installed: built, and used outside the checkout."""

import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from commands import PATIENCE_S

from canwall.code_on_disk import _folders

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.slow


def execute(*words: object, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-P", "-m", *map(str, words)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, **environment},
        timeout=4 * PATIENCE_S,  # a start of the interpreter, with all imports
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel that is built from the source distribution, installed into an empty folder."""
    folder = tmp_path_factory.mktemp("package")
    execute("hatchling", "build", "-t", "sdist", "-d", folder, cwd=ROOT)
    (source,) = folder.glob("canwall-*.tar.gz")
    with tarfile.open(source) as archive:
        archive.extractall(folder, filter="data")
    unpacked = folder / source.name.removesuffix(".tar.gz")
    execute("hatchling", "build", "-t", "wheel", "-d", folder, cwd=unpacked)
    (wheel,) = folder.glob("*.whl")
    target = folder / "site"
    offline = ("--no-deps", "--no-index", "--no-compile", "--quiet", "--disable-pip-version-check")
    execute("pip", "install", *offline, "--target", target, wheel, cwd=folder)
    return target


def test_wheel_works_without_the_checkout(installed: Path, tmp_path: Path) -> None:
    # The code that is compiled is kept by a digest of the sources, and these are the same.
    compiled = _folders()[0]
    shutil.copytree(compiled, installed / "canwall" / "__pycache__" / compiled.name)
    there = {"PYTHONPATH": str(installed)}
    said = execute("canwall", "run", "--duration", "0.2", "--output", "run", cwd=tmp_path, **there)
    assert "compiling" not in said
    assert 'eds = "' + str(installed) in (tmp_path / "run" / "config.toml").read_text()
    assert (tmp_path / "run" / "run.png").stat().st_size > 10_000
    (tmp_path / "run" / "run.png").unlink()
    said = execute("canwall", "plot", "run", cwd=tmp_path, **there)
    assert said == "run/run.png\n"
    assert (tmp_path / "run" / "run.png").exists()


def test_wheel_has_what_belongs_to_it(installed: Path) -> None:
    package = installed / "canwall"
    for folder in ("config", "eds"):
        ours = {path.relative_to(ROOT) for path in (ROOT / folder).rglob("*.*")}
        assert ours == {
            p.relative_to(package / "data") for p in (package / "data" / folder).rglob("*.*")
        }
    modules = {path.relative_to(ROOT) for path in (ROOT / "canwall").rglob("*.py")}
    assert modules == {path.relative_to(installed) for path in package.rglob("*.py")}
    assert (package / "py.typed").exists()
    assert not list(installed.glob("tests*"))
    # The script and the module are the same start.
    assert "from canwall.__main__ import main" in (installed / "bin" / "canwall").read_text()
