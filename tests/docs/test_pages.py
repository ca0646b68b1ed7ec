"""References of the documentation to the code and to itself, without building or running it."""

import re
import shlex
from typing import Any

import typer
from pages import DOCS, FAILS, LANGUAGES, PAGES, ROOT, UNPLAYED, blocks, inline_code

from canwall.cli import app
from canwall.walls import LAWS
from canwall.walls.interface import wall_with

COMMANDS: Any = typer.main.get_command(app)


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_blocks_say_what_they_are() -> None:
    for block in (block for page in PAGES for block in blocks(page)):
        assert block.language in LANGUAGES, block.where
        assert block.remark in ("", FAILS, *UNPLAYED), block.where


def test_links_lead_to_files() -> None:
    """Sphinx checks them for the site; the pages are also read as they are."""
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if not re.match(r"https?:", target):
                assert (page.parent / target).exists(), f"{page.relative_to(ROOT)}: {target}"


def test_commands_in_sentences_exist() -> None:
    """The changelog is about commands that were, too."""
    for page in PAGES:
        for line, code in inline_code(page):
            if code.startswith(("canwall ", "scripts/")) and page.name != "CHANGELOG.md":
                assert exists(code), f"{page.relative_to(ROOT)}:{line}: {code}"


def exists(command_line: str) -> bool:
    """Return True if the command and its options exist."""
    program, *words = shlex.split(command_line)
    if program != "canwall":
        return (ROOT / program).exists()
    command = COMMANDS
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        if words[0] not in command.commands:
            return False
        command = command.commands[words.pop(0)]
    options = {name for parameter in command.params for name in parameter.opts}
    return options >= {word for word in words if word.startswith("--")}


def test_every_command_has_its_line() -> None:
    for page in (ROOT / "README.md", DOCS / "commands.md"):
        named = {code.split()[1] for _, code in inline_code(page) if code.startswith("canwall ")}
        assert named == set(COMMANDS.commands), page


def test_every_law_has_its_equation() -> None:
    headings = re.findall(r"^### (\w+)$", (DOCS / "laws.md").read_text(encoding="utf-8"), re.M)
    assert {law for law in LAWS if "+" not in law} <= set(headings)


def test_fields_of_a_wall_exist() -> None:
    table = (DOCS / "laws.md").read_text(encoding="utf-8").partition("| field | unit |")[2]
    fields = [
        name
        for row in re.findall(r"^\| (`[^|]+) \|", table, re.M)
        for name in re.findall(r"`(\w+)`", row)
    ]
    assert len(fields) > 15
    assert set(fields) <= set(wall_with(["growth"]).names or ())
