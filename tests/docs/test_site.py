"""The site: it builds without a warning, and its pages load nothing from elsewhere."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from commands import Record
from pages import DOCS

pytestmark = pytest.mark.slow

_LOADS = {"src", "srcset", "data", "poster"}
_AWAY = re.compile(r"\s*(?:https?:)?//")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as by scripts/docs."""
    folder = tmp_path_factory.mktemp("site")
    options = ["--quiet", "--fail-on-warning", "--keep-going", "-d", folder.with_name("doctrees")]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options, DOCS, folder],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


class Loading(HTMLParser):
    """Resources that a browser loads for a page; the targets of links are not among them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if value and (name in _LOADS or (tag == "link" and name == "href")):
                self.addresses.append(value)


def test_every_page_is_there(site: Path) -> None:
    pages = {page.relative_to(DOCS).with_suffix(".html") for page in DOCS.rglob("*.md")}
    assert pages <= {page.relative_to(site) for page in site.rglob("*.html")}


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    loaded = 0
    for page in site.rglob("*.html"):
        addresses = Loading(page.read_text(encoding="utf-8")).addresses
        assert not [a for a in addresses if _AWAY.match(a)], page
        loaded += len(addresses)
    assert loaded > 100
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        for address in re.findall(r"(?:url\(|@import)\s*[\"']?([^\"')]+)", text):
            assert not _AWAY.match(address), (style, address)


def test_equations_are_drawn(site: Path) -> None:
    text = (site / "laws.html").read_text(encoding="utf-8")
    drawn = re.findall(r'class="equation"[^>]*><svg [^>]*width="([\d.]+)em"', text)
    assert len(drawn) > 50
    assert all(float(width) > 0.2 for width in drawn)
    assert "$" not in text


def test_summary_has_the_keys_of_its_table(four_strikes: Record) -> None:
    text = (DOCS / "formats.md").read_text(encoding="utf-8")
    tables = text.partition("### summary.json")[2].partition("## Sweeps")[0]
    of_the_run, of_a_strike = (
        set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`[^|]+) \|", table, re.M))))
        for table in tables.split("Each entry of `strikes`:")
    )
    assert of_the_run == set(four_strikes.summary)
    assert of_a_strike == set(four_strikes.summary["strikes"][0])
