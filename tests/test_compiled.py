"""Code that was compiled before a change of the sources is not used afterwards."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import canwall
from canwall.compiled import data_to_number, number_to_data

FALL = """
from canwall.physics import advance, make_plant
print(advance(make_plant(2.0)[0], 1.0, 0.0, -4.0, 0.0, 1.0))
"""


def fall(package: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", FALL],
        cwd=package.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.mark.slow
def test_change_in_another_file_is_noticed(tmp_path: Path) -> None:
    source = Path(canwall.__file__).parent
    package = tmp_path / "canwall"
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__"))
    assert fall(package) == "(0.0, -2.0, False)"
    oscillator = package / "physics" / "oscillator.py"
    text = oscillator.read_text()
    assert text.count("    a0 = (u0 - spring * y) / mass\n") == 1
    oscillator.write_text(
        text.replace(
            "    a0 = (u0 - spring * y) / mass\n", "    a0 = 0.5 * (u0 - spring * y) / mass\n"
        )
    )
    assert fall(package) == "(0.5, -1.0, False)"


def test_data_survive_the_way_through_a_number() -> None:
    for data in (b"", b"\x01", bytes(range(248, 256)), b"\x00\xff", bytes(8)):
        assert number_to_data(data_to_number(data), len(data)) == data
