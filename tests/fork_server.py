"""Processes that begin with canwall imported, because they are forked from one that has it.

`ForkedPopen` is `subprocess.Popen` for commands of this Python and of the scripts installed beside
it. The process is a real one: a child of the caller with its own standard streams, folder, environment,
session and signals, that ends as any interpreter does. Only the start of the interpreter and the
imports are left out, which take seconds. Tests of these use `subprocess.Popen`, and so do tests of
what libraries decide as they are imported (from MPLCONFIGDIR, NUMBA_CPU_NAME, TERM).

This file is the server's program as well.
"""

import atexit
import ctypes
import gc
import io
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import types
import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, AnyStr, TextIO

PYTHON = Path(sys.executable)
#: The installed command, a script of Python like `dask`.
COMMAND = str(PYTHON.with_name("canwall"))

_REQUEST_BYTES = 1 << 20
_MOST_DESCRIPTORS = 64
_PR_SET_CHILD_SUBREAPER = 36


class ForkedPopen(subprocess.Popen[AnyStr]):
    """`subprocess.Popen` that has this Python and its scripts forked by the server."""

    def __init__(
        self, args: Sequence[str], *, start_new_session: bool = False, **options: Any
    ) -> None:
        self._new_session = start_new_session
        super().__init__(args, start_new_session=start_new_session, **options)

    def _execute_child(self, args: Sequence[str], *options: Any) -> None:
        """Start the process and close its ends of the pipes, as Popen does by fork and exec."""
        if Path(args[0]).parent != PYTHON.parent:
            super()._execute_child(args, *options)  # type: ignore[misc]
            return
        _, _, _, pass_fds, folder, environment, _, _, _, *pipes = options[:15]
        streams = (pipes[0], pipes[3], pipes[5])
        descriptors = {n: n if stream == -1 else stream for n, stream in enumerate(streams)}
        descriptors |= {descriptor: descriptor for descriptor in pass_fds}
        request = {
            "arguments": list(args),
            "folder": os.fspath(folder or os.getcwd()),
            "environment": dict(os.environ if environment is None else environment),
            "new_session": self._new_session,
            "descriptors": list(descriptors),
        }
        self.pid = _server().fork(request, list(descriptors.values()))
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]


class _Server:
    """The server, seen by the process that has started it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._socket, its_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with its_end:
            self._process = subprocess.Popen(
                [str(PYTHON), __file__, str(its_end.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[its_end.fileno()],
            )
        atexit.register(self._close)

    def fork(self, request: Mapping[str, object], descriptors: Sequence[int]) -> int:
        """Have a process forked that has these descriptors under the numbers of the request.

        Returns its process number. The process in between that forks it ends at once; an orphan
        goes to its nearest ancestor that takes orphans, which is this process meanwhile.
        """
        with self._lock:
            _take_orphans(True)
            try:
                socket.send_fds(self._socket, [json.dumps(request).encode()], descriptors)
                answer = self._socket.recv(64)
            finally:
                _take_orphans(False)
        if not answer:
            raise OSError("the fork server has ended")
        return int(answer)

    def _close(self) -> None:
        self._socket.close()
        self._process.wait()


@cache
def _server() -> _Server:
    return _Server()


def _take_orphans(yes: bool) -> None:
    if ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(yes), 0, 0, 0) != 0:
        raise OSError("prctl: PR_SET_CHILD_SUBREAPER is refused")


# The server


def load() -> None:
    """Import what the commands import, and have their compiled code loaded."""
    import distributed  # noqa: F401
    import h5netcdf  # noqa: F401
    import matplotlib.pyplot  # noqa: F401

    import canwall.bench
    import canwall.cli
    import canwall.record.writer
    import canwall.run
    import canwall.study
    import canwall.sweep
    import canwall.workbench  # noqa: F401
    from canwall import config

    for exchange in ("python-can", "native"):
        given = {"run.duration_s": 0.05, "bus.exchange": exchange}
        settings = config.load(config.shipped("config/sim.toml"), given)
        with tempfile.TemporaryDirectory() as folder:
            canwall.run.run(settings, Path(folder) / "run")


def serve(requests: socket.socket) -> None:
    """Fork a process for each request, until there are no more of them.

    Each of these processes leaves with its program's exception, or returns at its program's end.
    """
    while True:
        request, descriptors = _receive(requests)
        if request is None:
            return
        parted, part = os.pipe()
        number, tell = os.pipe()
        between = _fork()
        if between == 0:
            child = _fork()
            if child != 0:
                os.write(tell, str(child).encode())
                os._exit(0)
            # Its program is not to see another parent than the one that it will have.
            os.close(part)
            os.read(parted, 1)
            requests.detach()
            _take_over(request, descriptors)
            _run(request["arguments"])
            return
        os.waitpid(between, 0)
        requests.send(os.read(number, 64))
        for descriptor in (parted, part, number, tell, *descriptors):
            os.close(descriptor)


def _receive(requests: socket.socket) -> tuple[dict[str, Any] | None, list[int]]:
    data, descriptors, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, _MOST_DESCRIPTORS)
    return (json.loads(data) if data else None), descriptors


def _fork() -> int:
    with warnings.catch_warnings():
        # Threads of the libraries: they know of forking, and are idle.
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()


def _take_over(request: Mapping[str, Any], descriptors: Sequence[int]) -> None:
    """Have what the new process is given: descriptors, session, folder, environment, signals."""
    wanted = request["descriptors"]
    # First to numbers that nobody wants.
    aside = max(*wanted, *descriptors) + 1
    for n, descriptor in enumerate(descriptors):
        os.dup2(descriptor, aside + n)
    os.closerange(0, aside)
    for n, descriptor in enumerate(wanted):
        os.dup2(aside + n, descriptor)
    os.closerange(aside, os.sysconf("SC_OPEN_MAX"))
    if request["new_session"]:
        os.setsid()
    os.chdir(request["folder"])
    loaded_with = _search_path(os.environ)
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[: len(loaded_with)] = _search_path(os.environ)
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _search_path(environment: Mapping[str, str]) -> list[str]:
    return list(filter(None, environment.get("PYTHONPATH", "").split(os.pathsep)))


def _run(arguments: Sequence[str]) -> None:
    """Be Python, or a script of it, with these arguments."""
    program, *words = arguments
    unbuffered = False
    if program == str(PYTHON):
        while words[0] == "-u":
            unbuffered = True
            del words[0]
    sys.stdin = sys.__stdin__ = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = sys.__stdout__ = _output(1, unbuffered)
    sys.stderr = sys.__stderr__ = _output(2, unbuffered)
    sys.orig_argv = [*arguments]
    if program != str(PYTHON):
        sys.argv = [*arguments]
        sys.path.insert(0, str(Path(program).parent))
        runpy.run_path(program, run_name="__main__")
    elif words[0] == "-m":
        name, sys.argv = words[1], words[1:]
        sys.path.insert(0, os.getcwd())
        sys.modules.pop(name, None)
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    elif words[0] == "-c":
        sys.argv = ["-c", *words[2:]]
        sys.path.insert(0, "")
        sys.modules["__main__"] = main = types.ModuleType("__main__")
        exec(compile(words[1], "<string>", "exec"), main.__dict__)
    else:
        raise ValueError(f"options of Python that are not known here: {words}")


def _output(descriptor: int, unbuffered: bool) -> TextIO:
    binary = open(descriptor, "wb", 0 if unbuffered else -1, closefd=False)  # noqa: SIM115
    return io.TextIOWrapper(
        binary,
        errors="backslashreplace" if descriptor == 2 else "strict",
        line_buffering=descriptor == 2 or binary.isatty(),
        write_through=unbuffered,
    )


if __name__ == "__main__":
    del sys.path[0]  # this folder, which is of no program
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    load()
    gc.collect()
    gc.freeze()
    serve(socket.socket(fileno=int(sys.argv[1])))
