"""Findings of the doctor: what was checked, what was found, and what to do about it."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import can

from canwall.errors import RunFailedError

#: Before what has to be done, at the end of an error's text.
_REMEDY = re.compile(
    r"(?:; |: )(?=(?:give|is it|is the drive|is drive\.|raise|clear|correct|end it|look|let)\b)"
)
#: Of objects that the file has and the drive has not, and what to do about it.
DIFFERENT_FILE = "file and drive differ"
OWN_FILE = "give the EDS of this drive and firmware (drive.eds, --eds)"


@dataclass(frozen=True)
class Finding:
    """One line of the examination.

    Attributes:
        section: Part of the bench.
        what: What was checked.
        found: What was found.
        well: False if it stands in the way of a run.
        do: What to do about it; empty if nothing.
    """

    section: str
    what: str
    found: str
    well: bool = True
    do: str = ""


@dataclass
class Findings:
    """Findings in their order."""

    lines: list[Finding] = field(default_factory=list)

    @property
    def well(self) -> bool:
        """True if a run may be tried."""
        return not self.troubles

    @property
    def troubles(self) -> list[Finding]:
        """Findings that stand in the way of a run."""
        return [line for line in self.lines if not line.well]

    def add(self, section: str, what: str, found: str, well: bool = True, do: str = "") -> None:
        """Note one finding."""
        self.lines.append(Finding(section, what, found, well, do))

    def add_trouble(self, section: str, what: str, text: str, do: str = "") -> None:
        """Note a trouble by the text of an error, in which what to do about it comes last."""
        remedy = None if do else _REMEDY.search(text)
        if DIFFERENT_FILE in text:
            do = OWN_FILE
        elif remedy is not None:
            text, do = text[: remedy.start()], text[remedy.end() :]
        self.add(section, what, text, well=False, do=do)


@contextmanager
def noted(findings: Findings, section: str, what: str) -> Iterator[None]:
    """Turn what drive or bus fails at into findings."""
    try:
        yield
    except RunFailedError as error:
        for text in getattr(error, "troubles", (str(error),)):
            findings.add_trouble(section, what, text)
    except can.CanError as error:
        findings.add_trouble("bus", what, f"the bus failed: {error}")
