"""Extras: what pyproject.toml, the code and the constraints say of them, and life without them."""

import itertools
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from commands import PATIENCE_S
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from canwall import extras
from canwall.extras import MissingExtraError, is_installed, need

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

#: Packages whose modules have another name.
MODULES_OF = {"uplot-python": "uplot"}

#: Before all other imports: packages of the extras are not there.
WITHOUT_EXTRAS = f"""
import sys
from importlib.machinery import PathFinder

class Without:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in {[*itertools.chain(*extras._MODULES.values())]}:
            return None
        return PathFinder.find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Without
"""


@pytest.fixture
def bare(tmp_path: Path) -> dict[str, str]:
    """Environment of processes that have the base installation alone."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(WITHOUT_EXTRAS)
    before = os.environ.get("PYTHONPATH", "")
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, (str(tmp_path / "site"), before))),
    }


def canwall(
    environment: dict[str, str], folder: Path, *arguments: str
) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-P", "-m", "canwall", *arguments],
        capture_output=True,
        text=True,
        env=environment,
        cwd=folder,
        timeout=4 * PATIENCE_S,  # a start of the interpreter, with all imports
        check=False,
    )


@pytest.mark.slow
def test_base_alone_runs(bare: dict[str, str], tmp_path: Path) -> None:
    done = canwall(bare, tmp_path, "run", "--duration", "0.2", "--output", "run")
    assert done.returncode == 0, done.stderr
    assert done.stderr == "canwall: no picture: pip install 'canwall[plot]', then canwall plot\n"
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == {"signals.parquet", "bus.log", "summary.json", "config.toml"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["plot", "run"], "plot"),
        (["sweep", "--output", "x.nc"], "sweep"),
        (["sweep", "--output", "x.nc", "--dask", "tcp://127.0.0.1:1"], "sweep,dask"),
        (["figures", "--output", "f"], "plot,sweep"),
        (["panel"], "panel"),
    ],
)
def test_missing_extra_is_told_at_once(
    bare: dict[str, str], tmp_path: Path, arguments: list[str], extra: str
) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    done = canwall(bare, folder, *arguments)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert line.endswith(f": not installed; pip install 'canwall[{extra}]'")
    assert not list(folder.iterdir())


def test_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    need("plot", "sweep", "dask")
    monkeypatch.setitem(extras._MODULES, "plot", ("matplotlib", "no_such_plots"))
    assert not is_installed("plot")
    with pytest.raises(MissingExtraError, match=re.escape("no_such_plots: not installed; pip")):
        need("sweep", "plot")


def test_extras_are_those_of_the_project() -> None:
    declared = {
        name: {Requirement(text).name for text in PROJECT["optional-dependencies"][name]}
        for name in extras._MODULES
    }
    for name, modules in extras._MODULES.items():
        packages = {MODULES_OF.get(package, package) for package in declared[name]}
        assert packages - {"canwall"} == set(modules)
    base = {Requirement(text).name for text in PROJECT["dependencies"]}
    assert not base & set().union(*declared.values())


def test_constraints_suit_the_project() -> None:
    """Otherwise: scripts/lock."""
    lines = (ROOT / "scripts" / "constraints.txt").read_text().splitlines()[1:]
    pins = [Requirement(line) for line in lines]
    pinned = {canonicalize_name(pin.name): str(pin.specifier).removeprefix("==") for pin in pins}
    assert all(pin.url is None and str(pin.specifier).startswith("==") for pin in pins)
    asked = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    for text in itertools.chain(*asked):
        wanted = Requirement(text)
        if wanted.name != "canwall":
            assert wanted.specifier.contains(pinned[canonicalize_name(wanted.name)]), text


def test_citation_is_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^version: (.*)$", citation, re.M) == [PROJECT["version"]]
    assert re.findall(r"^license: (.*)$", citation, re.M) == [PROJECT["license"]]
