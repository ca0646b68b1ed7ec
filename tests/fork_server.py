"""Processes that begin with canwall imported, because they are forked from one that has it.

`ForkedPopen` is `subprocess.Popen` for commands of this Python and of the scripts installed beside
it. The process is a real one: a child of the caller with standard streams, folder, environment,
session and signals of its own, that ends as an interpreter does. Only the start of the interpreter
and the imports, which take seconds, are left out, and the reading of the shipped EDS. Tests of
these use `subprocess.Popen`, and so do tests of what libraries decide as they are imported (from
MPLCONFIGDIR, NUMBA_CPU_NAME, TERM).

This file is also the program of the server that forks them, and has nothing else to do meanwhile.
"""

import atexit
import contextlib
import ctypes
import gc
import io
import json
import os
import pickle
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
import types
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, AnyStr, NoReturn, TextIO, cast

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary

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
        program = Program(
            [str(word) for word in args],
            os.fspath(folder or os.getcwd()),
            dict(os.environ if environment is None else environment),
            self._new_session,
            list(descriptors),
        )
        self.pid = self._fork(program, list(descriptors.values()))
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]

    def _fork(self, program: "Program", descriptors: Sequence[int]) -> int:
        return _server().fork(program, descriptors)


class PopenByFork(ForkedPopen[AnyStr]):
    """The same forked from the caller, who has imported all that is needed."""

    def _fork(self, program: "Program", descriptors: Sequence[int]) -> int:
        if (child := _fork()) != 0:
            return child
        gc.freeze()  # what the caller has open is not closed here
        atexit._clear()
        program.become(descriptors)


@dataclass(frozen=True)
class Program:
    """A process to be."""

    arguments: list[str]
    folder: str
    environment: dict[str, str]
    new_session: bool
    #: The numbers that the descriptors it is given have there; all others are closed.
    descriptors: list[int]

    def become(self, given: Sequence[int]) -> NoReturn:
        """Be this program in this process; given: what is to have the numbers of descriptors."""
        status: object = 1
        try:
            self._take_over(given)
            self._run()
            status = 0
        except SystemExit as end:
            status = end.code or 0
            if isinstance(status, str):
                print(status, file=sys.stderr)
        except BaseException as error:
            traceback.print_exc()
            if isinstance(error, KeyboardInterrupt):
                signal.signal(signal.SIGINT, signal.SIG_DFL)
                signal.raise_signal(signal.SIGINT)
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
        with contextlib.suppress(OSError):
            sys.stdout.flush()
        # To take down all that is imported would mean to copy it first.
        os._exit(status if isinstance(status, int) else 1)

    def _take_over(self, given: Sequence[int]) -> None:
        """Have descriptors, session, folder, environment and signals of its own."""
        # First to numbers that nobody wants.
        aside = max(*self.descriptors, *given) + 1
        for n, descriptor in enumerate(given):
            os.dup2(descriptor, aside + n)
        os.closerange(0, aside)
        for n, descriptor in enumerate(self.descriptors):
            os.dup2(aside + n, descriptor)
        os.closerange(aside, os.sysconf("SC_OPEN_MAX"))
        if self.new_session:
            os.setsid()
        os.chdir(self.folder)
        before = _search_path(os.environ)
        os.environ.clear()
        os.environ.update(self.environment)
        sys.path[: len(before)] = _search_path(os.environ)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

    def _run(self) -> None:
        """Do what Python does with the arguments."""
        program, *words = self.arguments
        options = set()
        kind = "script"
        if program == str(PYTHON):
            while words[0] in ("-u", "-P"):
                options.add(words.pop(0))
            kind, program, *words = words
        sys.stdin = sys.__stdin__ = open(0, closefd=False)  # noqa: SIM115
        sys.stdout = sys.__stdout__ = _output(1, "-u" in options)
        sys.stderr = sys.__stderr__ = _output(2, "-u" in options)
        sys.argv = ["-c" if kind == "-c" else program, *words]
        if "-P" not in options:
            sys.path.insert(0, {"script": str(PYTHON.parent), "-m": os.getcwd(), "-c": ""}[kind])
        if kind == "script":
            runpy.run_path(program, run_name="__main__")
        elif kind == "-m":
            sys.modules.pop(program, None)
            runpy.run_module(program, run_name="__main__", alter_sys=True)
        else:
            sys.modules["__main__"] = main = types.ModuleType("__main__")
            exec(compile(program, "<string>", "exec"), main.__dict__)


def _search_path(environment: Mapping[str, str]) -> list[str]:
    return list(filter(None, environment.get("PYTHONPATH", "").split(os.pathsep)))


def _output(descriptor: int, unbuffered: bool) -> TextIO:
    binary = open(descriptor, "wb", 0 if unbuffered else -1, closefd=False)  # noqa: SIM115
    return io.TextIOWrapper(
        binary,
        errors="backslashreplace" if descriptor == 2 else "strict",
        line_buffering=descriptor == 2 or binary.isatty(),
        write_through=unbuffered,
    )


def _fork() -> int:
    with warnings.catch_warnings():
        # Threads of the libraries: they know of forking, and are idle.
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()


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

    def fork(self, program: Program, descriptors: Sequence[int]) -> int:
        """Have a process forked for the program; returns its number.

        What forks it there ends at once, and an orphan goes to its nearest ancestor that takes
        orphans, which is this process meanwhile.
        """
        request = json.dumps(asdict(program)).encode()
        with self._lock:
            _take_orphans(True)
            try:
                socket.send_fds(self._socket, [request], descriptors)
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


def eds_read_once() -> "Callable[..., ObjectDictionary]":
    """Return a `load_eds` that reads each file once; each call has a dictionary of its own."""
    from canwall.eds import load_eds

    read: dict[tuple[object, ...], bytes] = {}

    def load_once(path: Path, node_id: int, required: Iterable[int] = ()) -> "ObjectDictionary":
        if not path.is_file():
            return load_eds(path, node_id, required)
        found, objects = path.stat(), tuple(required)
        key = (path.resolve(), found.st_mtime_ns, found.st_size, node_id, objects)
        if key not in read:
            read[key] = pickle.dumps(load_eds(path, node_id, objects))
        return cast("ObjectDictionary", pickle.loads(read[key]))

    return load_once


# The server


def load() -> None:
    """Import what the commands import, have their compiled code loaded, and the EDS read."""
    import distributed  # noqa: F401
    import h5netcdf  # noqa: F401
    import matplotlib.pyplot  # noqa: F401

    import canwall.bench
    import canwall.cli
    import canwall.record.recorder
    import canwall.record.writer
    import canwall.study
    import canwall.sweep
    import canwall.workbench
    from canwall import config
    from canwall.record.pictures import warm_up
    from canwall.run import assembly, run
    from canwall.simdrive.communication import dictionary
    from canwall.sweep.plan import compute_piece, make_plan

    warm_up()
    assembly.load_eds = dictionary.load_eds = eds_read_once()  # type: ignore[attr-defined]
    forking = types.SimpleNamespace(**{**vars(subprocess), "Popen": PopenByFork})
    canwall.record.recorder.subprocess = forking  # type: ignore[attr-defined]
    for exchange in ("python-can", "native"):
        given = {"run.duration_s": 0.05, "bus.exchange": exchange}
        settings = config.load(config.shipped("config/sim.toml"), given)
        with tempfile.TemporaryDirectory() as folder:
            run(settings, Path(folder) / "run")
    one_strike = make_plan(settings, {"stiffness": 10.0, "speed": 1.0, "phase": 0.0})
    compute_piece(one_strike, 0)


def serve(requests: socket.socket) -> None:
    """Fork a process for each request, until there are no more of them."""
    while True:
        request, descriptors, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, _MOST_DESCRIPTORS)
        if not request:
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
            Program(**json.loads(request)).become(descriptors)
        os.waitpid(between, 0)
        requests.send(os.read(number, 64))
        for descriptor in (parted, part, number, tell, *descriptors):
            os.close(descriptor)


def _receive(requests: socket.socket) -> tuple[dict[str, Any] | None, list[int]]:
    data, descriptors, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, _MOST_DESCRIPTORS)
    return (json.loads(data) if data else None), descriptors


if __name__ == "__main__":
    del sys.path[0]  # this folder, which is of no program
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    load()
    # Without a socket, all that is wanted is that the code is compiled.
    if len(sys.argv) > 1:
        gc.collect()
        gc.freeze()
        serve(socket.socket(fileno=int(sys.argv[1])))
