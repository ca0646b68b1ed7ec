"""`canwall doctor`: what it finds, what it tests, and that nothing of it stays."""

import json
import re
from pathlib import Path

import pytest
from commands import command, config_file
from rig import SIM_CONFIG, Rig, RigFactory, settings_with

from canwall.bench import Findings, examine
from canwall.bench.doctor import diagnose
from canwall.cycle import Exchange
from canwall.drive import REQUIRED_OBJECTS, DriveNode

pytestmark = pytest.mark.usefixtures("_hasty_doctor")

SETTINGS = {"drive.wait_s": 0.0, "drive.watchdog_s": 0.4}


def examined(rig: Rig) -> tuple[Findings, list[str]]:
    findings, announced = Findings(), list[str]()
    try:
        examine(rig.link, rig.settings, REQUIRED_OBJECTS, announced.append, findings)
    finally:
        # The doctor's node took the place of the rig's on the link.
        rig.node = DriveNode(rig.link, 5, rig.node.dictionary)
    return findings, announced


def found(findings: Findings, section: str, what: str) -> str:
    (line,) = (line for line in findings.lines if (line.section, line.what) == (section, what))
    return line.found


@pytest.fixture
def rig(make_rig: RigFactory) -> Rig:
    return make_rig(settings_with(SETTINGS))


def test_all_is_well(rig: Rig) -> None:
    findings, announced = examined(rig)
    assert [line for line in findings.lines if not line.well] == []
    assert "cyclic synchronous torque (10)" in found(findings, "mode", "0x6060")
    assert found(findings, "units", "0x608F") == "131072 counts per turn of the shaft"
    assert found(findings, "PDO", "TPDO, with every SYNC").startswith("0x185: 0x6064:00 (32 bits)")
    budget = [line.what for line in findings.lines if line.section == "bus budget"]
    assert budget == [
        "SYNC 0x080, 0 bytes",
        "TPDO 0x185, 8 bytes",
        "TPDO 0x385, 6 bytes",  # the dictionary has it on, whether the wall needs it or not
        "RPDO 0x205, 4 bytes",
        "cycle of 1 ms at 1000 kbit/s",
    ]
    # 55, 135, 115 and 95 bits.
    assert found(findings, "bus budget", budget[-1]).startswith("40.0% used of 80%")
    assert found(findings, "bus budget", budget[-1]).endswith("is 2000 Hz")
    assert found(findings, "watchdog", "set").startswith("RPDO event timer, 400 ms")
    assert "SWITCH ON DISABLED" in found(findings, "watchdog", "tested")
    assert "after the last sign of life" in found(findings, "watchdog", "tested")
    # What is done to the drive is said before it is done.
    assert [text.split()[0] for text in announced] == [
        "asking",
        "setting",
        "enabling",
        "falling",
        "putting",
    ]
    # A drive that has fallen silent makes it long.
    patience = f"{rig.settings.drive.sdo_timeout_s:g} s for each if the drive does not answer"
    assert re.search(rf" [1-9]\d* values, {re.escape(patience)}$", announced[-1])


def test_torque_is_zero_all_the_time(rig: Rig) -> None:
    examined(rig)
    assert rig.rpdos()
    assert all(torque == 0 for _, torque in rig.rpdos())
    enabled = [word for word, _ in rig.rpdos()]
    assert 0x0F in enabled
    assert rig.node.read(0x6040) == 0


def test_nothing_stays(rig: Rig) -> None:
    before = rig.node.read(0x1A00, 0), rig.node.read(0x1400, 5), rig.node.read(0x6007)
    findings, _ = examined(rig)
    after = rig.node.read(0x1A00, 0), rig.node.read(0x1400, 5), rig.node.read(0x6007)
    assert after == before
    assert rig.node.read(0x6041) & 0x6F == 0x40
    assert found(findings, "put back", "changes") == "all undone; nothing was stored"


@pytest.mark.parametrize(
    ("missing", "kind"), [((0x1400,), "consumer heartbeat"), ((0x1400, 0x1016), "life guarding")]
)
def test_every_watchdog_bites(rig: Rig, missing: tuple[int, ...], kind: str) -> None:
    for index in missing:
        for subindex in (5,) if index == 0x1400 else range(1, 3):
            rig.tampering.read_only[(index, subindex)] = 0x06010002
    findings, _ = examined(rig)
    assert found(findings, "watchdog", "set").startswith(kind)
    assert "SWITCH ON DISABLED" in found(findings, "watchdog", "tested")
    assert findings.well


@pytest.mark.slow
def test_watchdog_that_does_not_bite(rig: Rig) -> None:
    """A drive that takes the deadline, and forgets about it."""
    while rig.node.read(0x6041) & 0x6F != 0x40:
        pass
    rig.tampering.drive.tick = lambda dt: []  # type: ignore[method-assign]
    findings, _ = examined(rig)
    assert not findings.well
    assert "no reaction within" in found(findings, "watchdog", "tested")
    assert rig.node.read(0x6041) & 0x6F == 0x40


def test_limit_beyond_what_the_drive_gives(make_rig: RigFactory) -> None:
    rig = make_rig(settings_with(SETTINGS | {"drive.parameters": {"0x6072": 100}}))
    findings, _ = examined(rig)
    assert not findings.well
    assert "more than the drive gives" in found(findings, "limits", "limits.torque_nm")


@pytest.mark.slow
def test_a_drive_that_fails_is_put_back_as_well(rig: Rig) -> None:
    before = rig.node.read(0x6007)
    rig.tampering.mute.add(0x185)
    findings, announced = examined(rig)
    assert "no TPDO within" in found(findings, "enabling", "0x6041")
    assert "asking the drive for the cause of its end" in announced
    assert rig.node.read(0x6007) == before


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_cycle_that_fails_leaves_the_drive_disabled(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, kind: type[BaseException]
) -> None:
    cycle = Exchange.cycle

    def failing(exchange: Exchange, most: int = 1) -> None:
        if exchange.axes[0].cycle["statusword"][0] & 0x6F == 0x27:
            raise kind("of the test")
        cycle(exchange, most)

    monkeypatch.setattr(Exchange, "cycle", failing)
    with pytest.raises(kind, match="of the test"):
        examined(rig)
    assert rig.node.read(0x6041) & 0x6F == 0x40
    assert rig.node.read(0x6071) == 0


def test_sync_of_another_period_is_a_trouble(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Exchange, "other_period_s", property(lambda exchange: 0.00125))
    findings, _ = examined(rig)
    assert found(findings, "latency", "SYNC") == "comes every 1.25 ms, but bus.cycle_s is 1 ms"
    assert not findings.well


@pytest.mark.slow
def test_command_in_plain_lines(tmp_path: Path) -> None:
    # On a machine in use 0.1 s of silence come about by themselves.
    patient = {"watchdog_s = 0.1 ": "watchdog_s = 1.0 "}
    done = command("doctor", config_file(tmp_path / "sim.toml", patient))
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("bus: adapter: virtual has no wire")
    assert any(line.startswith("drive: 0x1000, 0x1018: device type 0x20192") for line in lines)
    assert lines[-1] == f"ready: canwall run {tmp_path / 'sim.toml'}"
    assert any(line.startswith("watchdog: tested: ") for line in lines)
    assert not any("│" in line for line in lines)
    assert "doctor: falling silent, as a dead master would" in done.stderr


@pytest.mark.slow
def test_command_on_a_drive_without_watchdog(tmp_path: Path) -> None:
    text = SIM_CONFIG.parent.parent.joinpath("eds", "canwall-drive.eds").read_text()
    kept, keep = [], True
    for line in text.splitlines():
        if line.startswith("["):
            name = line.strip("[]")
            keep = name.split("sub")[0] not in ("1016", "100C") and not (
                name.startswith("140") and name.endswith("sub5")
            )
        if keep:
            kept.append(line)
    eds = tmp_path / "without.eds"
    eds.write_text("\n".join(kept))
    file = config_file(tmp_path / "c.toml")
    done = command("doctor", file, "--eds", eds)
    assert done.returncode == 1
    assert "watchdog: set: TROUBLE: none" in done.stdout
    assert "not ready; to mend:\n 1. watchdog, set: none" in done.stdout
    done = command("run", file, "--eds", eds, "--output", tmp_path / "run")
    assert done.returncode == 1
    assert "--accept-no-watchdog accepts that" in done.stderr
    done = command("doctor", file, "--eds", eds, "--accept-no-watchdog", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["ready"]
    assert {"section", "what", "found", "well", "do"} == set(told["findings"][0])


def test_what_cannot_be_put_back_is_a_trouble(rig: Rig) -> None:
    findings = Findings()

    def announce(what: str) -> None:
        if what.startswith("putting"):
            rig.tampering.read_only[(0x6007, 0)] = 0x06010002

    examine(rig.link, rig.settings, REQUIRED_OBJECTS, announce, findings)
    assert not findings.well
    assert "writing 0x1 to 0x6007:00 failed" in found(findings, "put back", "not done")


def test_rated_torque_that_is_not_the_drive_s_is_doubted(make_rig: RigFactory) -> None:
    """By a slipped decimal, say."""
    simulated = {"simulation.rated_torque_nm": 0.637}
    for given, doubted in ((6.37, True), (0.6, False)):
        told = {"drive.rated_torque_nm": given}
        rig = make_rig(settings_with(SETTINGS | simulated | told))
        findings, _ = examined(rig)
        said = [line.found for line in findings.lines if line.what == "0x6076"]
        doubt = f"637, 0.637 N·m, but drive.rated_torque_nm is {given:g}"
        assert said == ([doubt] if doubted else [])


def test_simulated_drive_is_loaded_before_it_is_examined(monkeypatch: pytest.MonkeyPatch) -> None:
    """The doctor keeps real time, whatever the configuration does, and a watchdog does not wait."""
    loaded: list[bool] = []
    monkeypatch.setattr("canwall.simdrive.load_compiled_code", loaded.append)

    def begins(step: str) -> None:
        assert loaded == [False], step

    settings = settings_with(SETTINGS | {"bus.pace": "simulated"})
    diagnose(settings, REQUIRED_OBJECTS, begins, Findings())
    assert loaded == [False]
