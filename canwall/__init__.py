"""A virtual wall on an industrial servo drive over CANopen.

What scripts and notebooks use is listed here; each name is imported at its first use, since a
command should not wait for what it does not need. Everything else is in the packages,
`canwall.walls`, `canwall.analysis` …
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from canwall import errors as errors
    from canwall.library.attached import AttachedRun as AttachedRun
    from canwall.library.attached import attach as attach
    from canwall.library.ball import ball as ball
    from canwall.library.configuration import load as load
    from canwall.library.laws import law as law
    from canwall.library.reading import read as read
    from canwall.library.recorded import RecordedRun as RecordedRun
    from canwall.library.running import run as run
    from canwall.library.simulated_drive import SimulatedDrive as SimulatedDrive
    from canwall.library.sweeping import law_table as law_table
    from canwall.library.sweeping import sweep as sweep
    from canwall.library.sweeping import sweep_figures as sweep_figures

#: Modules of the names.
_MODULES = {
    "AttachedRun": "canwall.library.attached",
    "RecordedRun": "canwall.library.recorded",
    "SimulatedDrive": "canwall.library.simulated_drive",
    "attach": "canwall.library.attached",
    "ball": "canwall.library.ball",
    "law": "canwall.library.laws",
    "law_table": "canwall.library.sweeping",
    "load": "canwall.library.configuration",
    "read": "canwall.library.reading",
    "run": "canwall.library.running",
    "sweep": "canwall.library.sweeping",
    "sweep_figures": "canwall.library.sweeping",
}

#: Extras that names need.
_EXTRAS = dict.fromkeys(("ball", "law_table", "sweep", "sweep_figures"), "sweep")

__all__ = ["errors", *_MODULES]


def __getattr__(name: str) -> Any:
    """Import a name at its first use (PEP 562)."""
    if name == "errors":
        return importlib.import_module("canwall.errors")
    if name not in _MODULES:
        raise AttributeError(f"module 'canwall' has no attribute {name!r}")
    if name in _EXTRAS:
        from canwall.extras import need

        need(_EXTRAS[name])
    found = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Library(ModuleType):
    """This module, in which `canwall.run` and `canwall.sweep` stay functions.

    Two packages have the same names, and `from canwall.run import …` still finds them; but Python
    would bind a package to the name of the function as soon as anything imports it.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _MODULES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Library
