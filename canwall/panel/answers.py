"""Tables of answers in a run's folder, written as they come."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from canwall.errors import InputError
from canwall.record.folder import synchronise


class AnswerTable:
    """A CSV file whose rows are on the disk as soon as they are written."""

    def __init__(self, path: Path, columns: Iterable[str]) -> None:
        """Create the file. Raises InputError if it cannot be written, or is there already."""
        self.path = path
        self._write("x", [list(columns)])

    @classmethod
    def create(cls, folder: Path, name: str, columns: Sequence[str]) -> "AnswerTable":
        """Create NAME.csv, or NAME-2.csv … if that is there already. Raises InputError."""
        number = 1
        while (path := folder / f"{name}{f'-{number}' if number > 1 else ''}.csv").exists():
            number += 1
        return cls(path, columns)

    def add(self, row: Iterable[object]) -> None:
        """Write a row through to the disk. Raises InputError if it cannot be written."""
        self._write("a", [list(row)])

    def _write(self, mode: str, rows: Iterable[Iterable[object]]) -> None:
        try:
            with self.path.open(mode, newline="", encoding="utf-8") as file:
                csv.writer(file).writerows(rows)
                synchronise(file)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None
