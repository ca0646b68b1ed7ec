"""`restore` undoes the changes of the set-up, and reports those that cannot be undone."""

import contextlib
from types import SimpleNamespace
from typing import cast

import pytest
from canopen.objectdictionary import ODVariable
from rig import Rig, RigFactory, settings_with

from canwall.cycle import WallAxis, run_laws
from canwall.drive import DriveError, DriveNode
from canwall.record import Ring
from canwall.run import make_axis, restoring_drives

READ_ONLY = 0x06010002
COMMANDS = ((0x6040, 0), (0x6041, 0), (0x6071, 0))


def everything(rig: Rig) -> dict[tuple[int, int], int]:
    """All that can be written, and has a value; but commands."""
    found = {}
    for item in rig.node.dictionary.values():
        variables = [item] if isinstance(item, ODVariable) else item.subindices.values()
        for variable in variables:
            key = variable.index, variable.subindex
            if variable.access_type in ("rw", "rww") and key not in COMMANDS:
                with contextlib.suppress(DriveError):
                    found[key] = rig.node.read(*key)
    return found


def test_everything_is_as_before(make_rig: RigFactory) -> None:
    changes = {"drive.parameters": {"0x6072": 2000, "0x605A": 6}, "drive.mode": "pt"}
    rig = make_rig(settings_with(changes))
    rig.node.write(0x1800, 1, 0xC0000185)
    rig.node.write(0x1800, 3, 300)
    rig.node.write(0x1A00, 0, 0)
    rig.node.write(0x1A00, 1, 0x606C0020, size=4)
    rig.node.write(0x1A00, 0, 1)
    rig.node.write(0x1800, 1, 0x40000185)
    before = everything(rig)
    rig.set_up()
    during = everything(rig)
    assert during != before
    assert during[(0x6072, 0)] == 2000
    assert rig.node.restore() == []
    assert everything(rig) == before
    assert rig.node.restore() == []


def test_interrupted_after_the_set_up(
    make_rig: RigFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while the compiled code of the wall is loaded."""
    settings = settings_with({"drive.restore": True})
    rig = make_rig(settings)
    rig.rings.append(ring := Ring.create())
    before = everything(rig)
    during = []

    def interrupted(node: DriveNode, *_: object) -> None:
        rig.node = node
        during.append(everything(rig))
        raise KeyboardInterrupt

    monkeypatch.setitem(make_axis.__globals__, "WallAxis", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_axis(rig.link, settings, rig.node.dictionary, run_laws(settings), ring)
    assert before not in during
    assert everything(rig) == before


def test_what_cannot_be_put_back_is_said(make_rig: RigFactory) -> None:
    rig = make_rig()
    rig.set_up()
    rig.tampering.read_only[(0x6007, 0)] = READ_ONLY
    (failure,) = rig.node.restore()
    assert "writing 0x1 to 0x6007:00 failed" in failure


def test_many_that_cannot_be_put_back_are_one_line(make_rig: RigFactory) -> None:
    rig = make_rig()
    rig.set_up()
    with restoring_drives() as (axes, not_restored):
        settings = settings_with({"drive.restore": True})
        axis = SimpleNamespace(name="the drive", node=rig.node, settings=settings)
        axes.append(cast(WallAxis, axis))
        rig.tampering.read_only |= {(0x6007, 0): READ_ONLY, (0x1800, 2): READ_ONLY}
    (line,) = not_restored["the drive"]
    assert line.startswith("node 5: not restored: writing 0x")
    assert line.count("node 5") == 1
    assert line.endswith(", and 1 more; switch the drive off and on")


def test_parameters_come_before_what_depends_on_them(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"drive.parameters": {"0x6072": 1500}}))
    assert rig.set_up().torque_limit_nm == pytest.approx(1.5 * 0.637)


def test_nothing_is_stored(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with({"drive.parameters": {"0x6072": 2000}}))
    rig.set_up()
    rig.node.restore()
    written = [d[1:3] for i, d in rig.frames if i == 0x605 and d[0] >> 5 == 1]
    assert b"\x10\x10" not in written
