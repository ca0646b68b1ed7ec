"""Machine code on disk, by a digest of the sources that it was compiled from.

numba notices changes of the file that a function stands in, not of those that it calls into: a law
would go on using the estimator with which it was compiled.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any, TypeAlias

#: Packages without compiled code, and without dtypes or constants that compiled code takes.
_WITHOUT_COMPILED_CODE = ("bench", "cli", "config", "library", "panel", "study")
_PACKAGE = Path(__file__).resolve().parent

#: Folders of other sources that are kept: those used last, and those used within this time [s].
_FOLDERS_KEPT, _FOLDER_KEPT_S = 8, 24 * 3600.0

#: Length of the checksum at the beginning of a file [bytes].
_CHECKSUM = hashlib.sha256().digest_size

_States: TypeAlias = dict[str, tuple[int, int]]


def _source_states() -> _States:
    """Return time of change [ns] and size of each source that compiled code may depend on."""
    states = {}
    for directory, below, names in os.walk(_PACKAGE):
        aside = _WITHOUT_COMPILED_CODE if directory == str(_PACKAGE) else ()
        below[:] = [name for name in below if name not in (*aside, "__pycache__")]
        for name in names:
            if name.endswith(".py"):
                path = os.path.join(directory, name)
                found = os.stat(path)
                states[os.path.relpath(path, _PACKAGE)] = found.st_mtime_ns, found.st_size
    return states


def _digest(sources: Iterable[str]) -> str:
    """Return a digest of the sources' names and contents."""
    digest = hashlib.sha256()
    for name in sorted(sources):
        digest.update(f"{name}\0".encode())
        digest.update(hashlib.sha256((_PACKAGE / name).read_bytes()).digest())
    return digest.hexdigest()[:20]


# At the start of this process, which imports the sources at various times afterwards.
_states_at_start = _source_states()


def _sources_are_as_at_start() -> bool:
    try:
        return _source_states() == _states_at_start
    except OSError:  # one is being exchanged
        return False


@functools.cache
def _folders() -> list[Path]:
    """Return the folders of the machine code of these sources, in the order of preference.

    Code is kept in `NUMBA_CACHE_DIR` if that is set, else beside the package, else in the user's
    cache. A folder that cannot be written to is only read. There is none if the sources have
    changed since the start of this process.
    """
    if not _sources_are_as_at_start():
        return []
    name = f"compiled-{_digest(_states_at_start)}"
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(given).absolute() / "canwall" / name]
    folders = [_PACKAGE / "__pycache__" / name]
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(user):
        folders.append(Path(user) / "canwall" / name)
    return folders


@functools.cache
def is_first_start() -> bool:
    """Return True if nothing compiled from the present sources was on disk when first asked."""
    return not any(folder.is_dir() for folder in _folders())


@functools.cache
def _tidy_up(folder: Path) -> None:
    """Note that a folder is in use, and remove those of other sources that have not been for long.

    A process that still uses such a folder compiles what it does not find.
    """
    with contextlib.suppress(OSError):
        os.utime(folder)
        others = [other for other in folder.parent.glob("compiled-*") if other != folder]
        used = sorted(((other.stat().st_mtime, other) for other in others), reverse=True)
        for last_s, other in used[_FOLDERS_KEPT:]:
            if time.time() - last_s > _FOLDER_KEPT_S:
                shutil.rmtree(other, ignore_errors=True)


def _load_code(name: str) -> bytes | None:
    """Return what was saved by that name for these sources, None if nothing or damaged."""
    for folder in _folders():
        with contextlib.suppress(OSError):
            content = (folder / name).read_bytes()
            if hashlib.sha256(content[_CHECKSUM:]).digest() == content[:_CHECKSUM]:
                _tidy_up(folder)
                return content[_CHECKSUM:]
    return None


def _save_code(name: str, code: bytes) -> None:
    """Save in the first folder that can be written to, if any; other processes may do the same.

    Nothing is saved once a source has changed: this process may have imported it before or after.
    """
    if not _sources_are_as_at_start():
        return
    for folder in _folders():
        path = folder / name
        part = path.with_name(f"{uuid.uuid4().hex}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(hashlib.sha256(code).digest() + code)
            part.replace(path)
        except OSError:
            with contextlib.suppress(OSError):
                part.unlink()
        else:
            _tidy_up(folder)
            return


def is_ours(function: Callable[..., Any]) -> bool:
    """Return True for a function of this package, the sources of which are watched."""
    return Path(function.__code__.co_filename).resolve().is_relative_to(_PACKAGE)


@functools.cache
def cache_class() -> Any:
    """Return a variant of numba's cache in the folder of these sources.

    Its instances are made of a function, its use, and what to call before it is compiled.

    Each signature has a file of its own: numba's index of them is not safe from other processes.

    It loads machine code without preparing to compile: numba fills its registries (and imports
    scipy.linalg for them) before it looks into the cache. Loading needs only the symbols of its
    runtime, and numba fills the registries by itself before it compiles. This halves the start of a
    program whose code is all in the cache.
    """
    import numba
    from numba.core.caching import CompileResultCacheImpl, FunctionCache
    from numba.core.runtime import rtsys
    from numba.core.serialize import dumps

    made_by = numba.__version__, sys.implementation.cache_tag

    class Results(CompileResultCacheImpl):  # type: ignore[misc]
        """Serialization of compiled code, without numba's choice of a folder."""

        def __init__(self, function: FunctionType) -> None:
            self._lineno = function.__code__.co_firstlineno
            self._locator = SimpleNamespace(_py_file=function.__code__.co_filename)

    class CodeOnDisk(FunctionCache):  # type: ignore[misc]
        def __init__(self, function: FunctionType, use: str, note_miss: Callable[[], None]) -> None:
            self._py_func = function
            self._use = use
            self._note_miss = note_miss
            self._impl = Results(function)
            self._cache_path = None
            source = Path(function.__code__.co_filename).resolve().relative_to(_PACKAGE)
            line = function.__code__.co_firstlineno
            self._stem = f"{source.with_suffix('')}.{function.__qualname__}-{line}"
            self.enable()

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            rtsys.initialize(target_context)
            key = self._index_key(sig, target_context.codegen())
            if (saved := _load_code(self._name_of(key))) is not None:
                of, code = pickle.loads(saved)
                if of == key:
                    return self._impl.rebuild(target_context, code)
            self._note_miss()
            return None

        def save_overload(self, sig: Any, data: Any) -> None:
            if self._impl.check_cachable(data):
                key = self._index_key(sig, data.codegen)
                _save_code(self._name_of(key), dumps((key, self._impl.reduce(data))))

        def _index_key(self, sig: Any, codegen: Any) -> Any:
            return (*super()._index_key(sig, codegen), self._use, *made_by)

        def _name_of(self, key: Any) -> str:
            return f"{self._stem}-{hashlib.sha256(repr(key).encode()).hexdigest()[:20]}"

    return CodeOnDisk
