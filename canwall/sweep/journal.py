"""The pieces of work that are done, on disk as they come: what an interruption leaves."""

import sqlite3
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canwall.errors import InputError


class Journal:
    """A file beside the result, with the plan and every piece that is done; gone at the end.

    A transaction for each piece: however a sweep ends, what was put in is there.
    """

    def __init__(self, output: Path, plan: str, resume: bool) -> None:
        """plan: what has to be the same for pieces to fit together. Raises InputError."""
        if output.exists():
            raise InputError(f"{output}: exists already; choose another --output")
        self.path = output.with_name(output.name + ".partial")
        if self.path.exists() and not resume:
            raise InputError(
                f"{self.path}: holds an unfinished sweep; --resume goes on with it, or remove it"
            )
        try:
            self._base = sqlite3.connect(self.path, timeout=1.0, isolation_level=None)
            self._base.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._base.execute("CREATE TABLE IF NOT EXISTS plan (text TEXT)")
            self._base.execute(
                "CREATE TABLE IF NOT EXISTS pieces (number INTEGER PRIMARY KEY, data BLOB)"
            )
            known = self._base.execute("SELECT text FROM plan").fetchone()
            if known is None:
                self._base.execute("INSERT INTO plan VALUES (?)", (plan,))
        except sqlite3.OperationalError as error:
            raise InputError(f"{self.path}: cannot be written: {error}") from None
        except sqlite3.DatabaseError:
            raise InputError(
                f"{self.path}: holds no unfinished sweep; remove it, or choose another --output"
            ) from None
        if known is not None and known[0] != plan:
            self._base.close()
            raise InputError(
                f"{self.path}: holds a sweep of another configuration or other axes; "
                "choose another --output"
            )

    def done(self) -> list[int]:
        """Numbers of the pieces that are there."""
        return [number for (number,) in self._base.execute("SELECT number FROM pieces")]

    def put(self, number: int, found: NDArray[np.void]) -> None:
        """Keep a piece. Raises InputError where the disk does not take it."""
        try:
            self._base.execute(
                "INSERT OR REPLACE INTO pieces VALUES (?, ?)", (number, found.tobytes())
            )
        except sqlite3.Error as error:
            raise InputError(f"{self.path}: cannot be written: {error}") from None

    def get(self, number: int, dtype: np.dtype[np.void]) -> NDArray[np.void]:
        """A piece that is done; shape (n,)."""
        (data,) = self._base.execute(
            "SELECT data FROM pieces WHERE number = ?", (number,)
        ).fetchone()
        return np.frombuffer(data, dtype)

    def close(self) -> None:
        """Leave the file for another time."""
        self._base.close()

    def remove(self) -> None:
        """The result is written: the journal has done its work."""
        self.close()
        self.path.unlink(missing_ok=True)
