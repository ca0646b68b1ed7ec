"""Configurations that come with canwall, by name: `sim`, `vcan`, `epos4`."""

import os
import re
from pathlib import Path

from canwall.errors import ConfigError, did_you_mean

#: Folders with configurations, relative to the project or to the installed package's data.
_FOLDERS = ("config", "config/drives")
_PACKAGE = Path(__file__).resolve().parents[1]
_EDS = re.compile(r'^(eds = )"(\.\./.*?)"', re.MULTILINE)


def shipped(relative: str) -> Path:
    """Return the path of a file that ships with the project, e.g. `config/sim.toml`."""
    installed = _PACKAGE / "data" / relative
    return installed if installed.exists() else _PACKAGE.parent / relative


def catalogue() -> dict[str, Path]:
    """Return the configurations that come with canwall, by name."""
    return {
        path.stem: path for folder in _FOLDERS for path in sorted(shipped(folder).glob("*.toml"))
    }


def located(path: Path) -> Path:
    """Return the file that a path or a name stands for.

    A name has neither folder nor suffix. A path stands for itself.

    Raises:
        ConfigError: If there is no configuration of that name, or a file in the working directory
            could be meant as well.
    """
    if path.suffix or len(path.parts) != 1 or path == Path(".."):
        return path
    name, known = path.name, catalogue()
    if name not in known:
        if os.path.exists(path):  # False for a name that is too long
            return path
        raise ConfigError(f"{name}: no such file or configuration{_meant(name)}")
    for here in (path, path.with_suffix(".toml")):
        if here.is_file():
            shown = here if here.suffix else here.absolute()
            raise ConfigError(
                f"{name}: may be the file {here} of this folder or the configuration that comes "
                f"with canwall; write {shown} for the file, or rename it"
            )
    return known[name]


def named(name: str) -> Path:
    """Return the file of a configuration of the catalogue. Raises ConfigError."""
    known = catalogue()
    if name not in known:
        raise ConfigError(f"{name}: no configuration of this name{_meant(name)}")
    return known[name]


def _meant(name: str) -> str:
    return did_you_mean(name, catalogue()) or "; `canwall config` lists the names"


def portable_text(path: Path) -> str:
    """Return the text of a configuration of the catalogue, with paths that hold in any folder."""

    def absolute(match: re.Match[str]) -> str:
        return f'{match[1]}"{(path.parent / match[2]).resolve()}"'

    return _EDS.sub(absolute, path.read_text(encoding="utf-8"))


def title_of(path: Path) -> str:
    """Return what the comment with which a configuration begins says first."""
    words = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("# "):
            break
        words.append(line.removeprefix("# "))
    return re.split(r"[.:](?: |$)", " ".join(words), maxsplit=1)[0]
