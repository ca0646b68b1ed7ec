"""Laws of one's own that are declared where they are used, in a script or a notebook."""

from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any, TypeAlias, overload

from canwall.config import absolute_law
from canwall.errors import InputError
from canwall.walls import Law, declare_law

#: A law by name, by `file.py:function`, or as `@canwall.law` has declared it.
LawLike: TypeAlias = str | Law

_Function: TypeAlias = Callable[[Any], float]


@overload
def law(function: _Function, /) -> Law: ...


@overload
def law(**options: float) -> Callable[[_Function], Law]: ...


def law(function: _Function | None = None, /, **options: float) -> Any:
    """Declare a function as a law, for `canwall.run`, `canwall.sweep` and `canwall.ball`.

    The function takes one record, `wall`, and returns the force that pushes out of the wall (y < 0
    is inside); it is compiled by numba. Options are declared with defaults, and read by name::

        @canwall.law(growth=5.0)
        def stiffening(wall):
            if wall.y >= 0.0:
                return 0.0
            return -wall.stiffness * wall.y * (1.0 - wall.options.growth * wall.y)

    The law is known by the function's name from then on, in configurations as well, until this
    process ends; declared again, it is replaced.

    Raises:
        canwall.errors.InputError: If the function is no law or does not compile; one line with the
            line of the function, what is wrong, and what to do.
    """
    if function is None:
        return lambda function: _declare(function, options)
    return _declare(function, {})


def _declare(function: _Function, options: dict[str, float]) -> Law:
    if not isinstance(function, FunctionType):
        raise InputError(f"@law: {function!r} is no function of Python")
    return declare_law(function, options)


def law_name(law: LawLike) -> str:
    """Return the name of a law; a path in it is relative to the working directory."""
    if isinstance(law, Law):
        return law.name
    if not isinstance(law, str):
        raise InputError(f"law: {law!r} is no law; declare a function with @canwall.law")
    return absolute_law(law, Path())
