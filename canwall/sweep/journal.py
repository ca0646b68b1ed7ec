"""Journal of a sweep on disk, from which an interrupted one can be resumed.

A text file: its first line names the plan by its SHA-256, each further one holds a finished piece:
number, SHA-256 of plan, number and content, and the content in base64. A line that is not what was
written is passed over, and its piece computed again.
"""

import base64
import binascii
import errno
import fcntl
import hashlib
import os
import stat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canwall.errors import InputError

_TITLE = b"canwall sweep journal"


def how_to_go_on(output: Path) -> str:
    """Return as a suffix how a sweep that was ended goes on; empty if it begins anew."""
    return f"; --resume continues {output}" if journal_of(output).exists() else ""


def journal_of(output: Path) -> Path:
    """Return the path of the journal of a result."""
    return output.with_name(output.name + ".partial")


class Journal:
    """A file next to the result with the finished pieces of a plan, removed at the end.

    Each piece is on the disk when `put` returns: it survives however the process ends.
    """

    def __init__(self, output: Path, plan: str, resume: bool) -> None:
        """Create the journal of the result at `output`, or open it to resume.

        Args:
            output: Path of the result.
            plan: Text that identifies the plan; pieces of different plans do not mix.
            resume: Continue from an existing journal.

        Raises:
            InputError: If there is a result, a journal that is not to be resumed, of another plan
                or in use, or if the file cannot be written.
        """
        if os.path.lexists(output):
            raise InputError(f"{output}: exists already; choose another --output")
        self.path = journal_of(output)
        self._plan = hashlib.sha256(plan.encode()).digest()
        #: Place and length of the line of each finished piece.
        self._lines: dict[int, tuple[int, int]] = {}
        try:
            self._file = self._open(resume)
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            self._read_lines()
        except OSError as error:
            # An empty file would only stand in the way of the next attempt.
            (self.close if os.fstat(self._file).st_size else self.remove)()
            raise self._unwritable(error) from None
        except InputError:
            self.close()
            raise

    def _open(self, resume: bool) -> int:
        """Open the file for this process alone; never through a symbolic link."""
        flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            file = os.open(self.path, flags | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            try:
                file = os.open(self.path, flags)
            except OSError as error:
                if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
                    raise self._foreign() from None
                raise
            if not resume:
                begin = os.pread(file, len(_TITLE), 0) if _is_regular(file) else None
                os.close(file)
                if begin is None or not _TITLE.startswith(begin):
                    raise self._foreign() from None
                raise InputError(
                    f"{self.path}: holds an unfinished sweep; --resume continues it, or remove it"
                ) from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            raise InputError(f"{self.path}: another sweep is writing it; let that end") from None
        except OSError:
            pass  # a file system without locks
        return file

    def _read_lines(self) -> None:
        """Find the finished pieces, and cut off what follows the last whole line."""
        if not _is_regular(self._file):
            raise self._foreign()
        title = b"%s %s\n" % (_TITLE, self._plan.hex().encode())
        found = os.pread(self._file, len(title), 0)
        if found == title[: len(found)]:
            # New, or cut off in its first line.
            if len(found) < len(title):
                os.ftruncate(self._file, 0)
                self._append(title)
        elif len(found) == len(title) and found.startswith(_TITLE) and found.endswith(b"\n"):
            raise InputError(
                f"{self.path}: holds a sweep of another configuration or other axes; "
                "choose another --output"
            )
        else:
            raise self._foreign()
        with open(self._file, "rb", closefd=False) as lines:
            end = lines.seek(len(title))
            for line in lines:
                if not line.endswith(b"\n"):
                    break
                if (piece := self._parse(line)) is not None:
                    self._lines[piece[0]] = end, len(line)
                end += len(line)
        os.ftruncate(self._file, end)

    def done(self) -> list[int]:
        """Return the numbers of the finished pieces."""
        return list(self._lines)

    def put(self, number: int, piece: NDArray[np.void]) -> None:
        """Store a piece. Raises InputError if it cannot be written."""
        data = piece.tobytes()
        digest = self._digest(number, data).encode()
        line = b"%d %s %s\n" % (number, digest, base64.b64encode(data))
        try:
            self._lines[number] = self._append(line), len(line)
        except OSError as error:
            raise self._unwritable(error) from None

    def get(self, number: int, dtype: np.dtype[np.void]) -> NDArray[np.void]:
        """Return a finished piece, shape (n,). Raises InputError if it has been damaged."""
        place, length = self._lines[number]
        piece = self._parse(os.pread(self._file, length, place))
        if piece is None or piece[0] != number or len(piece[1]) % dtype.itemsize:
            raise InputError(f"{self.path}: piece {number} is damaged; --resume computes it again")
        return np.frombuffer(piece[1], dtype)

    def close(self) -> None:
        """Close the file and keep it."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def remove(self) -> None:
        """Close and delete the file."""
        self.close()
        self.path.unlink(missing_ok=True)

    def _append(self, line: bytes) -> int:
        """Write a line at the end, whole or not at all, and return its place."""
        place = os.lseek(self._file, 0, os.SEEK_END)
        try:
            rest = memoryview(line)
            while rest:
                rest = rest[os.write(self._file, rest) :]
            os.fsync(self._file)
        except OSError:
            os.ftruncate(self._file, place)
            raise
        return place

    def _parse(self, line: bytes) -> tuple[int, bytes] | None:
        """Return number and content of a line, None unless it is as it was written."""
        try:
            number, digest, content = line.removesuffix(b"\n").split(b" ")
            data = base64.b64decode(content, validate=True)
            piece = int(number), data
        except (ValueError, binascii.Error):
            return None
        return piece if digest == self._digest(*piece).encode() else None

    def _digest(self, number: int, data: bytes) -> str:
        return hashlib.sha256(self._plan + b"%d " % number + data).hexdigest()

    def _foreign(self) -> InputError:
        return InputError(
            f"{self.path}: holds no unfinished sweep; remove it, or choose another --output"
        )

    def _unwritable(self, error: OSError) -> InputError:
        return InputError(f"{self.path}: cannot be written: {error.strerror}")


def _is_regular(file: int) -> bool:
    return stat.S_ISREG(os.fstat(file).st_mode)
