"""Commands of the pages that configure a machine, as far as they can be checked without one.

Blocks marked `root` are not played. Here `ip` reads their words in a network namespace of its own,
where the kernel refuses what needs an adapter; tests/vcan/test_bench_guide.py brings up an emulated
one as the bench guide says. Options of other programs are looked up in their usage.
"""

import re
import shutil
import subprocess

import pytest
from pages import PAGES, blocks
from test_blocks import commands

ROOT_COMMANDS = [
    pytest.param(words, id=where)
    for page in PAGES
    for block in blocks(page)
    if block.remark == "root"
    for where, words in commands(block)
]
#: What the kernel of a namespace without an adapter says of words that ip has understood.
REFUSALS = {
    "RTNETLINK answers: Operation not supported",
    "Error: Unknown device type.",
}


def complaints(words: list[str]) -> list[str]:
    """Lines of ip about the words of its command, in a namespace with lo alone."""
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        pytest.skip("ip or unshare is not installed (Debian: iproute2, util-linux)")
    # The interface is looked up before other words are read.
    on_lo = ["lo" if word == "can0" else word for word in words]
    unshare = ["unshare", "--map-root-user", "--net"]
    if subprocess.run([*unshare, "true"], capture_output=True, check=False).returncode != 0:
        pytest.skip("no network namespaces here")
    done = subprocess.run([*unshare, *on_lo], capture_output=True, text=True, check=False)
    said = set(done.stderr.splitlines()) - REFUSALS - {'Cannot find device "vcan0"'}
    return sorted(said)


@pytest.mark.parametrize("words", ROOT_COMMANDS)
def test_words_are_understood(words: list[str]) -> None:
    if words[0] == "ip":
        assert complaints(words) == []
        return
    assert words[0] == "slcand", "not known to this test"
    if shutil.which("slcand") is None:
        pytest.skip("slcand is not installed (Debian: can-utils)")
    usage = subprocess.run(["slcand", "-h"], capture_output=True, text=True, check=False)
    known = set(re.findall(r"^\s+-(\w)\b", usage.stdout + usage.stderr, re.MULTILINE))
    assert {word[1] for word in words if word.startswith("-")} <= known


@pytest.mark.parametrize(
    "line",
    [
        "ip link set can0 type can bitrate 1000000 restart-msec 100",
        "ip link set can0 txqueuelength 128",
        "ip link set can0 type can berr-reporting yes",
    ],
)
def test_a_word_that_ip_does_not_know_is_found(line: str) -> None:
    assert complaints(line.split())
