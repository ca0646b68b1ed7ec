"""`[[simulation.fault]]`: settings that are a fault, and messages for those that are none."""

import re
from pathlib import Path

import pytest
from commands import config_file

from canwall.config import ConfigError, load
from canwall.faults import KINDS, FaultKind

DOCUMENT = Path(__file__).parents[2] / "docs" / "faults.md"


def file_with(tmp_path: Path, *faults: str) -> Path:
    path = config_file(tmp_path / "faults.toml")
    path.write_text(path.read_text() + "".join(f"\n[[simulation.fault]]\n{f}\n" for f in faults))
    return path


def test_faults_are_read_and_written(tmp_path: Path) -> None:
    found = load(
        file_with(
            tmp_path,
            'kind = "lost"\nat_s = 2\nduration_s = 0.5\ncan_id = 0x185\nprobability = 1',
            'kind = "emcy"\nat_sync = 7\nduration_syncs = 3\namount = 0x8130',
        )
    )
    assert found.simulation is not None
    lost, emcy = found.simulation.fault
    assert (lost.at_s, lost.can_id, lost.direction) == (2.0, 0x185, None)
    assert (emcy.at_sync, emcy.amount) == (7, 0x8130)
    again = tmp_path / "again.toml"
    again.write_text(found.to_toml())
    assert load(again) == found


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ('kind = "lost"\nat_s = 1.0\nat_sync = 3', "at_s and at_sync say the same; keep one"),
        (
            'kind = "lost"\nduration_s = 1.0\nduration_syncs = 3',
            "duration_s and duration_syncs say the same; keep one",
        ),
        ('kind = "sto"\nprobability = 0.5', "probability: the kind sto has none; remove it"),
        ('kind = "silence"\ncan_id = 5', "can_id: the kind silence has none; remove it"),
        ('kind = "babbling"\ndirection = "sent"', "direction: the kind babbling has none"),
        ('kind = "lost"\namount = 1', "amount: the kind lost has none; remove it"),
        (
            'kind = "wrong_length"\namount = 9',
            "amount: has to be -8 to 8 [bytes more] for the kind wrong_length, not 9",
        ),
        ('kind = "lost"\nprobability = 1.5', "probability: has to be less than or equal to 1"),
        ('kind = "lost"\ncan_id = 0x800', "can_id: has to be less than or equal to 2047"),
        ('kind = "lots"', "kind: has to be 'lost', 'late'"),
        ('kind = "lost"\nat = 1.0', "at: unknown key; did you mean at_s?"),
        ("at_s = 1.0", "kind: is missing; add it"),
    ],
)
def test_what_is_no_fault(tmp_path: Path, fault: str, line: str) -> None:
    with pytest.raises(ConfigError) as error:
        load(file_with(tmp_path, fault))
    assert "simulation.fault.0" in str(error.value)
    assert line in str(error.value)


def test_every_kind_has_its_own_name_and_number() -> None:
    assert [kind.number for kind in KINDS.values()] == list(range(1, len(KINDS) + 1))
    declared = [kind for kind in FaultKind.__subclasses__() if "canwall." in kind.__module__]
    assert len(declared) == len(KINDS)


def row(kind: type[FaultKind]) -> str:
    """Return the kind's row in docs/faults.md."""
    assert kind.__doc__ is not None
    amount = ""
    if kind.amount:
        usual, lowest, highest = (
            kind.amount.shown(value).replace("-", "−")
            for value in (kind.amount.usual, kind.amount.lowest, kind.amount.highest)
        )
        amount = f"{usual}: {kind.amount.unit}, {lowest} to {highest}"
    what = " ".join(kind.__doc__.split())
    frames = ", ".join(f"`{key}`" for key in kind.frame_keys)
    cells = [str(kind.number), f"`{kind.name}`", what, frames, amount]
    return "|".join(["", *(f" {cell} " if cell else " " for cell in cells), ""])


def test_document_has_every_kind() -> None:
    lines = DOCUMENT.read_text(encoding="utf-8").splitlines()
    found = [line for line in lines if re.match(r"\| \d+ \|", line)]
    assert found == [row(kind) for kind in KINDS.values()]
