"""A run from a script or a notebook."""

import os
import threading
import warnings
from collections.abc import Mapping
from typing import Any

import can

from canwall.errors import InputError, RunFailedError, RunWarning, TrippedError
from canwall.library.arguments import as_path
from canwall.library.configuration import Config, wall_settings
from canwall.library.laws import LawLike
from canwall.library.progress import Progress
from canwall.library.recorded import RecordedRun
from canwall.run import run as run_wall
from canwall.run import stop_on_signals


def run(
    config: Config = None,
    *,
    law: LawLike | None = None,
    stiffness: float | None = None,
    damping: float | None = None,
    options: Mapping[str, float] | None = None,
    duration: float | None = None,
    output: str | os.PathLike[str] | None = None,
    overrides: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> RecordedRun:
    """Render a wall: enable the drive, run, record, disable it again (`canwall run`).

    Ctrl-C, a notebook's stop button, SIGTERM and SIGHUP end the wall as they end the command: zero
    torque first, then a disabled drive, then a complete record. A run without a duration, which is
    ended in this way, is returned; one that is cut short raises KeyboardInterrupt after that, so
    that no further wall of a script begins.

    Args:
        config: As for `canwall.load`.
        law: Law of the wall; changes of law in `[[schedule]]` are then skipped.
        stiffness: Stiffness [N·m/rad].
        damping: Damping [N·m·s/rad], instead of a damping ratio too.
        options: Options of the law.
        duration: Duration [s].
        output: Folder of the record; None: a new folder below `runs`.
        overrides: Other keys of the configuration, as for `canwall.load`.
        progress: Show the progress, in a terminal or a notebook.

    Returns:
        The run, read from its record.

    Raises:
        canwall.errors.InputError: For bad input; nothing has been enabled.
        canwall.errors.TrippedError: If a limit ended the run; its attribute `run` is the run.
        canwall.errors.RunFailedError: If the drive cannot be set up, the bus fails, or nothing was
            recorded.
        KeyboardInterrupt: See above.

    Warns:
        canwall.errors.RunWarning: For what is missing in the record, or could not be put back in
            the drive.
    """
    if threading.current_thread() is not threading.main_thread():
        raise RunFailedError(
            "run: call it from the main thread; in others no signal could end the wall"
        )
    if output == "":
        raise InputError("output: is empty, and would be the working directory; give a folder")
    folder = None if output is None else as_path("output", output)
    settings = wall_settings(config, overrides, law, stiffness, damping, duration, options)
    with stop_on_signals(held=False) as stop:
        try:
            with Progress(progress) as display:
                result = run_wall(settings, folder, display.report, display.advance)
        except can.CanError as error:
            raise RunFailedError(str(error)) from error
        recorded = RecordedRun.read(result.folder.path, tuple(result.remarks))
    for missing in (*result.not_restored, *result.notes):
        warnings.warn(missing, RunWarning, stacklevel=2)
    if result.outcome.trips:
        raise TrippedError("; ".join(result.outcome.trips), recorded)
    if stop() and settings.run.duration_s is not None:
        raise KeyboardInterrupt(f"the drive is disabled; record: {recorded.folder}")
    return recorded
