"""The cases of doctor_cases.txt: on a bench with one thing wrong, the verdict names the cause."""

import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple, cast

import pytest
from rig import IDEAL_CONFIG, Object, Rig, RigFactory

from canwall import config, simdrive
from canwall.bench import Findings, examine
from canwall.config import Settings, with_overrides
from canwall.drive import REQUIRED_OBJECTS
from canwall.faults import KINDS

CASES = Path(__file__).with_name("doctor_cases.txt")
VENDORS = Path(__file__).parents[3] / "shared" / "vendor-eds"
QUICK = {
    "bus.pace": "real_time",
    "drive.wait_s": 0.0,
    "drive.sdo_timeout_s": 0.2,
}
#: Watchdog where it is tested, and where it is not to react to a pause of the master [s].
TESTED_S, PATIENT_S = 1.5, 2.0
#: A handle on which 1 % of the rated torque shows, and a wall as `canwall init` would make it.
FREE = {
    "simulation.coulomb_nm": 0.0,
    "simulation.hand.strikes": 0,
    "wall.stiffness_nm_per_rad": 0.5,
    "limits.torque_nm": 0.063,
}


class Case(NamedTuple):
    drive: str
    drive_is: str
    told: str
    verdict: str
    words: str


def cases() -> list[Case]:
    lines = [line for line in CASES.read_text().splitlines() if line and line[0] != "#"]
    return [Case(*re.split(r" {2,}", line)) for line in lines]


def base(name: str, watchdog_s: float = TESTED_S) -> Settings:
    quick = QUICK | {"drive.watchdog_s": watchdog_s}
    if name == "own":
        return with_overrides(config.load(IDEAL_CONFIG), quick | FREE)
    path = config.catalogue()[name]
    eds = VENDORS / config.load(path).drive.eds.name
    if not eds.is_file():
        pytest.skip(f"{VENDORS} has no {eds.name}")
    return config.load(path, quick | {"drive.eds": eds})


def value_of(text: str) -> Any:
    if "," in text:
        return tuple(float(part) for part in text.split(","))
    return tomllib.loads(f"x = {text}")["x"] if text else None


def object_of(text: str) -> Object:
    index, _, subindex = text.partition(":")
    return int(index, 16), int(subindex or "0", 16)


def made(make_rig: RigFactory, case: Case) -> Rig:
    """The bench: a drive as `is` says."""
    watchdog_s = TESTED_S if case.verdict in ("ready", "watchdog") else PATIENT_S
    settings = base(case.drive, watchdog_s)
    objects, says = dict[str, int](), dict[Object, int]()
    fault: dict[str, Any] = {}
    for word in case.drive_is.split():
        key, _, value = word.partition("=")
        if key.startswith("says:"):
            says[object_of(key.removeprefix("says:"))] = int(value, 0)
        elif key.startswith("0x"):
            objects[key] = int(value, 0)
        elif word in KINDS:
            fault["kind"] = word
        elif fault:
            fault[key] = value if value.isalpha() else int(value, 0)
    changes: dict[str, Any] = {"simulation.objects": objects}
    if fault:
        changes["simulation.fault"] = (fault,)
    rig = make_rig(with_overrides(settings, changes))
    rig.tampering.lies.update(says)
    drive = cast(simdrive.ServoDrive, rig.tampering)
    rig.runner = simdrive.BusRunner(drive, rig.drive_bus, error_frames=True)
    rig.link.idle = rig.runner.poll
    if "deaf_to_time" in case.drive_is:
        while rig.node.read(0x6041) & 0x6F != 0x40:
            pass
        rig.tampering.drive.tick = lambda dt: []  # type: ignore[method-assign]
    return rig


def master(case: Case, settings: Settings) -> tuple[Settings, bool]:
    """The configuration of the master, and whether the handle may be moved."""
    changes = {}
    for word in case.told.split():
        key, equals, value = word.partition("=")
        if key == "file":
            changes["drive.eds"] = base(value).drive.eds
        elif equals:
            changes[key] = {} if key == "drive.parameters" else value_of(value)
    return with_overrides(settings, changes), "--move" in case.told


def named(case: Case) -> str:
    return " ".join((case.drive, case.drive_is, case.told, case.words))[:80]


@pytest.mark.slow
@pytest.mark.usefixtures("_hasty_doctor")
@pytest.mark.parametrize("case", cases(), ids=named)
def test_verdict_names_the_cause(case: Case, make_rig: RigFactory) -> None:
    rig = made(make_rig, case)
    settings, move = master(case, rig.settings)
    findings = Findings()
    examine(rig.link, settings, REQUIRED_OBJECTS, lambda step: None, findings, move)
    told = "\n".join(
        f"{line.section}: {line.what}: {line.found} → {line.do}" for line in findings.lines
    )
    sections = list(dict.fromkeys(line.section.replace(" ", "_") for line in findings.troubles))
    assert " ".join(sections) == case.verdict.replace("ready", ""), told
    words = ".*".join(re.escape(part) for part in re.split(r" ?… ?", case.words))
    assert re.search(words, told, re.DOTALL), told


def test_every_kind_of_fault_of_a_bench_has_a_case() -> None:
    """Faults that come and go, or that no master could tell from a hand, have none."""
    tried = {word for case in cases() for word in case.drive_is.split()}
    passing = {"late", "wrong_length", "reboot", "encoder_jump"}
    assert set(KINDS) - tried == passing
