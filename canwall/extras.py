"""Packages that only some commands need, by the extra of canwall that installs them."""

from importlib.util import find_spec

from canwall.errors import InputError

#: Modules of each extra of pyproject.toml that are imported here.
_MODULES = {
    "plot": ("matplotlib",),
    "sweep": ("xarray", "h5netcdf", "h5py", "pandas", "threadpoolctl"),
    "dask": ("distributed",),
    "dbc": ("cantools",),
    "panel": ("starlette", "uvicorn", "websockets", "uplot"),
}


class MissingExtraError(InputError, ImportError):
    """Packages that are not installed; the text says how to install them. Exit code 2."""


def is_installed(extra: str) -> bool:
    """Return True if all packages of an extra are there; none is imported."""
    return not _absent(extra)


def need(*extras: str) -> None:
    """Raise MissingExtraError unless all packages of these extras are installed.

    Called before the work begins, so that a missing package does not cost its result.
    """
    wanting = [extra for extra in extras if _absent(extra)]
    if wanting:
        absent = ", ".join(name for extra in wanting for name in _absent(extra))
        raise MissingExtraError(f"{absent}: not installed; {how_to_install(*wanting)}")


def how_to_install(*extras: str) -> str:
    """Return the command that installs extras."""
    return f"pip install 'canwall[{','.join(extras)}]'"


def _absent(extra: str) -> list[str]:
    return [name for name in _MODULES[extra] if find_spec(name) is None]
