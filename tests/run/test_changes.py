"""A wall that is changed from outside while it is rendered."""

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from commands import (
    COMMAND,
    ON_A_BUSY_MACHINE,
    Start,
    command,
    config_file,
    wait_for,
)
from rig import Loop, RigFactory, settings_with

from canwall import config
from canwall.config import ConfigError
from canwall.errors import RunFailedError
from canwall.record import Mailbox, RunFolder, read_signals
from canwall.run.changes import open_to_changes, post_change

PATIENCE_S = 60.0


def test_mailbox_hands_over_one_change_at_a_time() -> None:
    mailbox = Mailbox.create()
    taken: list[str] = []
    answers: list[int] = []

    def post(k: int) -> None:
        # Each sender opens it for itself, as processes do.
        other = Mailbox.open(mailbox.address)
        answers.append(other.post(f"change {k}", PATIENCE_S))
        other.close()

    senders = [threading.Thread(target=post, args=(k,)) for k in range(5)]
    for sender in senders:
        sender.start()
    while len(taken) < len(senders):
        if mailbox.waiting():
            taken.append(mailbox.take(100 + len(taken)))
    for sender in senders:
        sender.join()
    assert sorted(taken) == [f"change {k}" for k in range(5)]
    assert sorted(answers) == [100, 101, 102, 103, 104]
    assert not mailbox.waiting()
    other = Mailbox.open(mailbox.address)
    with pytest.raises(ValueError, match="4096 is the most"):
        other.post("x" * 5000, PATIENCE_S)
    with pytest.raises(TimeoutError):
        other.post("nobody takes this", 0.01)
    other.close()
    address = mailbox.address
    mailbox.close()
    with pytest.raises(OSError, match="No such file"):
        Mailbox.open(address)


def test_change_is_in_force_from_the_cycle_that_it_is_told(
    make_rig: RigFactory, tmp_path: Path
) -> None:
    settings = settings_with({"run.more_laws": ["midpoint"], "wall.law": "half_sample"})
    loop = Loop(make_rig(settings))
    folder = RunFolder(tmp_path)
    folder.config.write_text(settings.to_toml())
    told: list[int] = []
    wanted = [
        ["stiffness_nm_per_rad=20", "limits.torque_nm=1.5"],
        ["law=midpoint", "wall.position_rad = -0.01"],
    ]
    senders: list[threading.Thread] = []

    def post(assignments: list[str]) -> None:
        told.append(post_change(folder, assignments))

    def at(j: int) -> bool:
        if j in (300, 600):
            senders.append(threading.Thread(target=post, args=(wanted[len(senders)],)))
            senders[-1].start()
            while loop.axis.mailbox is None or not loop.axis.mailbox.waiting():
                time.sleep(0.001)
        return False

    with open_to_changes([loop.axis], [folder]):
        outcome = loop.run(1000, at)
    for sender in senders:
        sender.join()
    assert outcome.trips == []
    assert told == [300, 600]
    assert not folder.live.exists()
    rows = loop.rows()
    assert np.flatnonzero(np.diff(rows["stiffness"])).tolist() == [299]
    assert np.flatnonzero(np.diff(rows["wall_position_rad"])).tolist() == [599]
    assert np.flatnonzero(np.diff(rows["law"])).tolist() == [599]
    assert loop.laws[rows["law"][-1]].name == "midpoint"
    assert loop.record["torque_limit"][0] == 1.5


@pytest.mark.slow
def test_run_of_the_command_is_changed_by_the_command(start: Start, tmp_path: Path) -> None:
    embedded = {
        'interface = "unixcan"': 'interface = "virtual"',
        'channel = "/tmp/canwall.sock"': 'channel = "canwall"',
        "duration_s = 4.2": "# until Ctrl-C",
    }
    source = config.shipped("config/unixcan.toml")
    file = config_file(tmp_path / "c.toml", ON_A_BUSY_MACHINE | embedded, source)
    folder = tmp_path / "run"
    run = start(COMMAND, "run", file, "--output", folder)
    wait_for((folder / "live.json").exists)
    done = command("change", folder, "stiffness_nm_per_rad=12.5")
    assert done.stderr == ""
    assert done.stdout.startswith("in force from cycle ")
    cycle = int(done.stdout.split()[4])
    run.send_signal(signal.SIGINT)
    assert run.wait(PATIENCE_S) == 130
    stiffness = read_signals(folder / "signals.parquet")["stiffness"].to_numpy()
    assert stiffness[cycle] == 12.5
    assert stiffness[cycle - 1] == 2.0


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("stifness_nm_per_rad=1", "stifness_nm_per_rad: unknown key; did you mean stiffness_nm"),
        ("stiffness_nm_per_rad=-1", "stiffness_nm_per_rad: has to be greater than or equal to 0"),
        ("limits.torque=1", "limits.torque: unknown key; did you mean torque_nm?"),
        ("position_rad=7", "position_rad = 7 lies outside the run's limits.position_rad"),
        ("law=nothing", "law: unknown law 'nothing'"),
        ("law=midpoint", "law midpoint is not one of the run's: standard, half_sample; list it"),
    ],
)
def test_impossible_change_is_not_posted(tmp_path: Path, assignment: str, message: str) -> None:
    folder = RunFolder(tmp_path)
    folder.config.write_text(settings_with().to_toml())
    mailbox = Mailbox.create()
    folder.write_live(mailbox.address)
    with pytest.raises(ConfigError) as error:
        post_change(folder, [assignment])
    assert str(error.value).startswith(message)
    assert not mailbox.waiting()
    mailbox.close()


def test_run_that_is_over_takes_no_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(ConfigError, match="no run in progress"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
    folder.config.write_text(settings_with().to_toml())
    mailbox = Mailbox.create()
    folder.write_live(mailbox.address)
    monkeypatch.setattr("canwall.run.changes._PATIENCE_S", 0.01)
    with pytest.raises(RunFailedError, match="does not take the change"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
    mailbox.close()


def put_at(mailbox: Mailbox, path: Path) -> None:
    """Put another file where the mailbox was, as another process with its number has it."""
    with path.open("rb+") as file:
        os.dup2(file.fileno(), mailbox.address.descriptor)


def test_file_of_another_process_is_not_taken_for_the_mailbox(tmp_path: Path) -> None:
    folder, foreign = RunFolder(tmp_path), tmp_path / "thesis"
    foreign.write_bytes(bytes(10_000))
    folder.config.write_text(settings_with().to_toml())
    mailbox = Mailbox.create()
    folder.write_live(mailbox.address)
    put_at(mailbox, foreign)
    with pytest.raises(ConfigError, match="no run in progress"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
    # Nor is one that live.json names itself.
    folder.write_live(mailbox.address._replace(file=str(foreign)))
    with pytest.raises(ConfigError, match="no run in progress"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
    mailbox.close()
    # The same number in the next run of the same process.
    old = Mailbox.create()
    folder.write_live(old.address)
    old.close()
    new = Mailbox.create()
    assert new.address.descriptor == old._descriptor
    with pytest.raises(ConfigError, match="no run in progress"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
    new.close()
    assert foreign.read_bytes() == bytes(10_000)


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", "null", "5", '{"mailbox": "/proc/1/fd/1"}', "[" * 100_000, "\0"),
        '{"pid": "1", "descriptor": 3, "file": "x"}',
        '{"pid": 1, "descriptor": 3, "file": ["x"]}',
        '{"pid": 1, "descriptor": 3, "file": "x", "more": 1}',
        '{"pid": -1, "descriptor": 3, "file": "/memfd:canwall-mailbox-0 (deleted)"}',
        '{"pid": true, "descriptor": 3, "file": "\\u0000"}',
    ],
)
def test_live_file_that_is_something_else(tmp_path: Path, text: str) -> None:
    folder = RunFolder(tmp_path)
    folder.live.write_text(text)
    with pytest.raises(ConfigError, match="no run in progress; give the folder of one that is"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
