"""The laws by name: the one list that the loop, the workbench and the messages read."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

from canwall.errors import InputError
from canwall.walls import damped, half_sample, midpoint, standard


class UnknownLawError(InputError):
    """A name under which no law is known."""


@dataclass(frozen=True)
class Law:
    """A law, compiled: `address` is what compiled code calls it by."""

    name: str
    function: Any

    @property
    def address(self) -> int:
        """Address of the compiled function in this process."""
        return int(self.function.address)


def _named(module: ModuleType) -> tuple[str, Law]:
    name = module.__name__.rpartition(".")[2]
    return name, Law(name, getattr(module, name))


#: Every law that comes with the project; a law's name is its module's and its function's.
LAWS: dict[str, Law] = dict(_named(module) for module in (standard, damped, midpoint, half_sample))


def find_law(name: str) -> Law:
    """The law of that name. Raises UnknownLawError."""
    try:
        return LAWS[name]
    except KeyError:
        raise UnknownLawError(f"unknown law {name!r}; known are {', '.join(LAWS)}") from None
