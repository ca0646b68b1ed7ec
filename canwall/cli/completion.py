"""Completion of names in a shell: quick, because nothing that computes is imported for it.

A shell offers files itself where no name is offered.
"""

import re
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
_LAW = re.compile(r"^@(?:sampled_)?law\ndef (\w+)\(", re.MULTILINE)


def complete_law(incomplete: str) -> list[str]:
    """Return the laws that begin so."""
    return [name for name in law_names() if name.startswith(incomplete)]


def complete_config(incomplete: str) -> list[str]:
    """Return the configurations that come with canwall, and those of this folder."""
    from canwall.config import catalogue

    names = {*catalogue()} | {path.name for path in Path().glob("*.toml")}
    return sorted(name for name in names if name.startswith(incomplete))


def law_names() -> list[str]:
    """Return the names of all laws that come with canwall, read from the files that declare them.

    `canwall.walls.LAWS` has the same, but takes longer to import than a person waits for a word.
    """
    texts = [path.read_text(encoding="utf-8") for path in sorted((_PACKAGE / "walls").glob("*.py"))]
    return [name.replace("_deadbeat", "+deadbeat") for text in texts for name in _LAW.findall(text)]
