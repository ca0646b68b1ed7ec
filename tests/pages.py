"""The pages of the documentation, and the code blocks on them."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])

#: Languages of blocks: three that are played, and text for the output of a program.
LANGUAGES = ("sh", "python", "toml", "text")
#: Words after the language of a block that is not played, and the reasons they stand for.
UNPLAYED = {
    "root": "changes the machine; tests/docs/test_system_commands.py checks the words",
    "interactive": "waits for a person",
    "socketcan": "needs vcan0; tests/vcan play the same",
    "long": "takes minutes",
    "development": "is a tool of the checkout itself",
}
#: Ends with exit code 1, and is played.
FAILS = "fails"


@dataclass(frozen=True)
class Block:
    """A fenced block: `line` is where its code begins, counted from 1."""

    page: Path
    line: int
    #: Headings before it on its page.
    section: int
    language: str
    remark: str
    #: Its file, for the commands after it.
    caption: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page that are code, in order; directives with other content are none."""
    section = 0
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        section += token.type == "heading_open"
        if token.type != "fence" or token.map is None:
            continue
        language, _, remark = token.info.partition(" ")
        line, text, caption = token.map[0] + 2, token.content, ""
        if language == "{code-block}":
            language, remark = remark, ""
            options = re.match(r":caption: (\S+)\n\n", text)
            assert options is not None, f"{page}:{line}: the file's name goes into :caption:"
            caption, text = options[1], text[options.end() :]
            line += 2
        if not language.startswith("{"):
            yield Block(page, line, section, language, remark, caption, text)


def inline_code(page: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of the code within the sentences of a page."""
    for token in MarkdownIt().enable("table").parse(page.read_text(encoding="utf-8")):
        for child in token.children or ():
            if child.type == "code_inline":
                yield (token.map or [0])[0] + 1, child.content
