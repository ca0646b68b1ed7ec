"""Coverage-guided fuzzing of the targets, by atheris (libFuzzer) in a process of its own.

An input that was found is tried again by `python tests/search/fuzzing.py TARGET FILE`.
"""

import re
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

#: Time that one input may take before it counts as a hang [s].
_HANG_S = 120
_STATUS = re.compile(r"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+) corp: (\d+)")


class FoundError(AssertionError):
    """What the search was looking for."""


def fuzz(
    name: str, seed: int, runs: int, folder: Path, tell: Callable[[int], None] = lambda done: None
) -> dict[str, int]:
    """Give a target so many inputs, and return their number, and the branches that they reached.

    Args:
        name: of the target.
        seed: of the mutations.
        runs: number of inputs.
        folder: for the corpus, and for an input that was found.
        tell: called with the inputs so far.

    Raises:
        FoundError: With the traceback, and the file that has the input.
    """
    from targets import TARGETS

    target = TARGETS[name]
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, content in enumerate(target.seeds()):
        (corpus / f"seed-{number}").write_bytes(content)
    options = {
        "runs": runs,
        "seed": seed % (1 << 31) + 1,  # 0 would be any
        "timeout": _HANG_S,
        "max_len": target.longest,
        "artifact_prefix": f"{folder}/",
    }
    words = [f"-{key}={value}" for key, value in options.items()]
    found = {"inputs": 0, "branches": 0, "features": 0, "kept": 0}
    lines: list[str] = []
    with subprocess.Popen(
        [sys.executable, __file__, name, *words, str(corpus)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines = [*lines[-200:], line]
            if status := _STATUS.match(line):
                found = dict(zip(found, map(int, status.groups()), strict=True))
                tell(found["inputs"])
    if process.returncode != 0:
        raise FoundError(f"{name}, seed {seed}:\n{''.join(lines)}")
    return found


def instrument(beginnings: tuple[str, ...], instrument_function: Callable[[Any], Any]) -> None:
    """Have the fuzzer see the branches of functions; compiled ones are none of Python's."""
    modules = [
        module
        for name, module in list(sys.modules.items())
        if name.startswith(beginnings) and isinstance(module, types.ModuleType)
    ]
    for module in modules:
        for thing in list(vars(module).values()):
            # An instance may refuse to be asked for its class.
            described = issubclass(type(thing), types.FunctionType | type)
            if described and thing.__module__ == module.__name__:
                for function in _functions(thing):
                    instrument_function(function)


def _functions(thing: Any) -> Iterator[types.FunctionType]:
    if isinstance(thing, types.FunctionType):
        yield thing
    elif isinstance(thing, staticmethod | classmethod):
        yield from _functions(thing.__func__)
    elif isinstance(thing, property):
        for part in (thing.fget, thing.fset):
            yield from _functions(part)
    elif isinstance(thing, type):
        for inner in vars(thing).values():
            yield from () if isinstance(inner, type) else _functions(inner)


def main() -> None:
    """Fuzz a target: its name, then what libFuzzer takes."""
    import atheris
    import other_tests  # noqa: F401
    from targets import TARGETS

    name, *arguments = sys.argv[1:]
    target = TARGETS[name]
    instrument(target.modules, atheris.instrument_func)
    with target.context():
        target.seeds()  # what they need is made once
        atheris.Setup([sys.argv[0], *arguments], target.take)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
