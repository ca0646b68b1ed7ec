"""Reading of what runs and sweeps leave behind."""

import os
from typing import TYPE_CHECKING

from canwall.library.arguments import as_path
from canwall.library.recorded import RecordedRun

if TYPE_CHECKING:
    import xarray as xr


def read(path: str | os.PathLike[str]) -> "RecordedRun | xr.Dataset":
    """Read a recorded run, or the result of a sweep.

    Args:
        path: Folder of a run, also of one in progress or cut off, or a .nc file of a sweep.

    Returns:
        The run, or the Dataset with a dimension per axis and `units` in all attributes.

    Raises:
        canwall.errors.InputError: If there is neither, or it is damaged.
        canwall.errors.RunFailedError: If the folder of a run that was cut off cannot be completed.
    """
    path = as_path("path", path)
    if path.suffix == ".nc":
        from canwall.sweep import read_sweep

        return read_sweep(path)
    return RecordedRun.read(path)
