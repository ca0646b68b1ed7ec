"""Journal of a sweep on disk, from which an interrupted one can be resumed."""

import sqlite3
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canwall.errors import InputError


class Journal:
    """A file next to the result with the plan and the finished pieces, removed at the end.

    Each piece is a transaction: it survives however the process ends.
    """

    def __init__(self, output: Path, plan: str, resume: bool) -> None:
        """Create the journal of the result at `output`, or open it to resume.

        Args:
            output: Path of the result.
            plan: Text that identifies the plan; pieces of different plans do not mix.
            resume: Continue from an existing journal.

        Raises:
            InputError: If there is a result, a journal that is not to be resumed or of another
                plan, or if the file cannot be written.
        """
        if output.exists():
            raise InputError(f"{output}: exists already; choose another --output")
        self.path = output.with_name(output.name + ".partial")
        if self.path.exists() and not resume:
            raise InputError(
                f"{self.path}: holds an unfinished sweep; --resume continues it, or remove it"
            )
        try:
            self._database = sqlite3.connect(self.path, timeout=1.0, isolation_level=None)
            self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._database.execute("CREATE TABLE IF NOT EXISTS plan (text TEXT)")
            self._database.execute(
                "CREATE TABLE IF NOT EXISTS pieces (number INTEGER PRIMARY KEY, data BLOB)"
            )
            known = self._database.execute("SELECT text FROM plan").fetchone()
            if known is None:
                self._database.execute("INSERT INTO plan VALUES (?)", (plan,))
        except sqlite3.OperationalError as error:
            raise InputError(f"{self.path}: cannot be written: {error}") from None
        except sqlite3.DatabaseError:
            raise InputError(
                f"{self.path}: holds no unfinished sweep; remove it, or choose another --output"
            ) from None
        if known is not None and known[0] != plan:
            self._database.close()
            raise InputError(
                f"{self.path}: holds a sweep of another configuration or other axes; "
                "choose another --output"
            )

    def done(self) -> list[int]:
        """Return the numbers of the finished pieces."""
        return [number for (number,) in self._database.execute("SELECT number FROM pieces")]

    def put(self, number: int, piece: NDArray[np.void]) -> None:
        """Store a piece. Raises InputError if it cannot be written."""
        try:
            self._database.execute(
                "INSERT OR REPLACE INTO pieces VALUES (?, ?)", (number, piece.tobytes())
            )
        except sqlite3.Error as error:
            raise InputError(f"{self.path}: cannot be written: {error}") from None

    def get(self, number: int, dtype: np.dtype[np.void]) -> NDArray[np.void]:
        """Return a finished piece, shape (n,)."""
        (data,) = self._database.execute(
            "SELECT data FROM pieces WHERE number = ?", (number,)
        ).fetchone()
        return np.frombuffer(data, dtype)

    def close(self) -> None:
        """Close the file and keep it."""
        self._database.close()

    def remove(self) -> None:
        """Close and delete the file."""
        self.close()
        self.path.unlink(missing_ok=True)
