"""A wall that is changed from outside while it is rendered."""

import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

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
from rig import IDEAL_CONFIG, Loop, RigFactory, settings_with

from canwall import config
from canwall.config import ConfigError, WallChange
from canwall.cycle import Offer, Outcome, WallAxis, WallStage
from canwall.errors import RunFailedError
from canwall.record import Mailbox, Ring, RunFolder, read_signals
from canwall.record.live import LiveMemory
from canwall.record.shared_memory import LiveAddresses, MemoryAddress
from canwall.run import changes
from canwall.run.changes import open_to_changes, post_change

PATIENCE_S = 60.0


def test_mailbox_hands_over_one_change_at_a_time() -> None:
    mailbox = Mailbox.create()
    taken: list[bytes] = []
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
            taken.append(mailbox.text())
            mailbox.accept(100 + len(taken))
    for sender in senders:
        sender.join()
    assert sorted(taken) == [f"change {k}".encode() for k in range(5)]
    assert sorted(answers) == [101, 102, 103, 104, 105]
    assert not mailbox.waiting()
    other = Mailbox.open(mailbox.address)
    with pytest.raises(ConfigError, match="4096 is the most"):
        other.post("x" * 5000, PATIENCE_S)
    other.close()
    address = mailbox.address
    mailbox.close()
    with pytest.raises(OSError, match="No such file"):
        Mailbox.open(address)


@contextmanager
def answering(answer: Callable[[Mailbox], None]) -> Iterator[Mailbox]:
    """Yield a sender's mailbox; the answer is given once a change waits in the owner's."""
    mailbox = Mailbox.create()

    def wait_and_answer() -> None:
        wait_for(mailbox.waiting)
        answer(mailbox)

    owner = threading.Thread(target=wait_and_answer)
    owner.start()
    sender = Mailbox.open(mailbox.address)
    yield sender
    owner.join()
    sender.close()
    mailbox.close()


def test_refusal_reaches_the_sender() -> None:
    def refuse(mailbox: Mailbox) -> None:
        mailbox.refuse(f"{mailbox.text().decode()}? No")

    with (
        answering(refuse) as sender,
        pytest.raises(ConfigError, match=re.escape("a change? No")),
    ):
        sender.post("a change", PATIENCE_S)


def test_change_that_is_not_taken_in_time_is_withdrawn() -> None:
    def drop(mailbox: Mailbox) -> None:
        wait_for(mailbox.withdrawn)
        mailbox.refuse("too late")

    with answering(drop) as sender, pytest.raises(TimeoutError):
        sender.post("a change", 0.01)


def test_change_that_is_taken_as_it_is_withdrawn_is_in_force() -> None:
    def take(mailbox: Mailbox) -> None:
        wait_for(mailbox.withdrawn)
        mailbox.accept(7)

    with answering(take) as sender:
        assert sender.post("a change", 0.01) == 7


def test_text_and_answer_lie_between_fences(monkeypatch: pytest.MonkeyPatch) -> None:
    """The text before the number that announces it, for sender and owner."""
    mailbox = Mailbox.create()
    states: list[tuple[bytes, bool]] = []

    def note() -> None:
        states.append((mailbox._text(), mailbox.waiting()))

    monkeypatch.setattr("canwall.record.mailbox.fence", note)
    sender = threading.Thread(target=mailbox.post, args=("a change", PATIENCE_S))
    sender.start()
    wait_for(mailbox.waiting)
    assert states == [(b"a change", False)]
    assert mailbox.text() == b"a change"
    mailbox.accept(3)
    sender.join()
    assert states[1:] == [(b"a change", True), (b"", True), (b"", False)]
    mailbox.close()


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
            wait_for(lambda: bool(loop.axis.offers))
        return False

    with open_to_changes([loop.axis], [folder], loop.exchange, Outcome()):
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


@contextmanager
def live_memory(folder: RunFolder) -> Iterator[LiveMemory]:
    """Yield the memory of a run that is written to a folder, without a run."""
    folder.path.mkdir(exist_ok=True)
    with closing(Ring.create()) as ring, closing(LiveMemory(ring)) as memory:
        folder.write_live(memory.addresses)
        yield memory


class Bench:
    """A run that is open to changes, and a person who asks for them."""

    def __init__(
        self,
        make_rig: RigFactory,
        path: Path,
        values: dict[str, Any],
        source: Path = IDEAL_CONFIG,
        **wall: Any,
    ) -> None:
        settings = config.load(source, values)
        of_wall = settings.wall.model_copy(update=wall)
        self.settings = settings.model_copy(update={"schedule": (), "wall": of_wall})
        self.loop = Loop(make_rig(self.settings))
        self.folder = RunFolder(path)
        self.answers: list[int | str] = []
        self._sender: threading.Thread | None = None

    def ask(self, *assignments: str) -> None:
        """Ask for a change, and wait until it is offered to the loop or refused."""

        def post() -> None:
            try:
                self.answers.append(post_change(self.folder, assignments))
            except (ConfigError, RunFailedError) as error:
                self.answers.append(str(error))

        if self._sender is not None:
            self._sender.join()
        answered = len(self.answers)
        self._sender = threading.Thread(target=post)
        self._sender.start()
        wait_for(lambda: bool(self.loop.axis.offers) or len(self.answers) > answered)

    def run(self, requests: dict[int, Callable[[], None]], **of_run: Any) -> Outcome:
        """Run, and do something between two cycles."""

        def at(j: int) -> bool:
            if j in requests:
                requests[j]()
            return False

        with open_to_changes([self.loop.axis], [self.folder], self.loop.exchange, Outcome()):
            outcome = self.loop.run(1000, at, **of_run)
        if self._sender is not None:
            self._sender.join()
        return outcome


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (["position_rad=7"], "position_rad = 7 lies outside the run's limits.position_rad"),
        (["law=nothing"], "law: unknown law 'nothing'"),
        (["cap"], "'cap': has to be KEY=VALUE"),
        (["=80"], "'=80': has to be KEY=VALUE"),
        (["cap=0.1", "wall.cap=0.2"], "wall.cap: is given twice; keep one of them"),
        (["law=midpoint"], "law midpoint is not one of the run's: exponential, standard; list it"),
        (["law=mine.py:mine"], "is not one of the run's: exponential, standard; list it"),
        (["options.length=0.01"], "law: law standard has no option 'length'; it has none"),
        (["deadbeat=true"], "law: law standard has no deadbeat compensation; half_sample,"),
        (["law=standard", "options.length=0.01"], "law: law standard has no option 'length'"),
    ],
)
def test_change_that_the_wall_in_force_does_not_allow_is_refused(
    make_rig: RigFactory, tmp_path: Path, assignments: list[str], message: str
) -> None:
    """The wall in force is the standard one, although the run began with the exponential."""
    bench = Bench(
        make_rig,
        tmp_path,
        {"wall.law": "exponential", "run.more_laws": ["standard"], "run.blend_s": 0.02},
    )
    requests = {
        300: lambda: bench.ask("options.length=0.01"),
        400: lambda: bench.ask("law=standard"),
        500: lambda: bench.ask(*assignments),
        600: lambda: bench.ask("stiffness_nm_per_rad=33"),
    }
    outcome = bench.run(requests)
    assert outcome.trips == []
    assert bench.answers[:2] == [300, 400]
    assert message in str(bench.answers[2])
    assert bench.answers[3:] == [600]


@pytest.mark.parametrize(
    ("position", "change"),
    [
        (0.0, "stiffness_nm_per_rad=3"),
        (0.002, "stiffness_nm_per_rad=20"),
        (0.002, "wall.position_rad=-0.004"),
    ],
)
def test_change_under_a_handle_that_sticks(
    make_rig: RigFactory, tmp_path: Path, position: float, change: str
) -> None:
    """The torque that is held there is that of the wall before: it says no more where y is."""
    wall = {"wall.stiffness_nm_per_rad": 12.5, "wall.position_rad": position}
    bench = Bench(make_rig, tmp_path, wall, config.shipped("config/sim.toml"))
    held: list[float] = []

    def ask() -> None:
        held.append(float(bench.loop.record["bank"]["held"][0, 0]))
        bench.ask(change)

    assert bench.run({700: ask}).trips == []
    assert bench.answers == [700]
    assert held[0] > 0.2
    rows = bench.loop.rows()
    count = bench.loop.record["rad_per_count"][0]
    assert np.abs(rows["y_est"] - rows["y"])[690:704].max() < count


def test_divider_is_judged_as_that_of_a_configuration(make_rig: RigFactory, tmp_path: Path) -> None:
    """The bound of a cap on an elastic shaft is that of a law in every cycle."""
    shaft = {"mechanics.shaft_hz": 300.0, "mechanics.rotor_inertia_kg_m2": 1e-5}
    bench = Bench(make_rig, tmp_path, shaft | {"simulation.ideal": False})
    requests = {
        300: lambda: bench.ask("divider=2"),
        400: lambda: bench.ask("cap=0.8"),
        500: lambda: bench.ask("divider=1", "cap=0.8"),
    }
    assert bench.run(requests).trips == []
    assert bench.answers[0] == 300
    assert "wall.divider: has to be 1 with mechanics.shaft_hz and" in str(bench.answers[1])
    assert bench.answers[2] == 500


def test_nothing_is_read_or_judged_in_the_loop(
    make_rig: RigFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(make_rig, tmp_path, {})
    readers, judges, loops = set[int](), set[int](), set[int]()
    text, judge = Mailbox.text, changes.judged

    def noted_text(mailbox: Mailbox) -> str:
        readers.add(threading.get_ident())
        return text(mailbox)

    def noted_judged(axis: WallAxis, change: WallChange) -> Offer:
        judges.add(threading.get_ident())
        return judge(axis, change)

    def ask() -> None:
        loops.add(threading.get_ident())
        bench.ask("stiffness_nm_per_rad=20")

    monkeypatch.setattr(Mailbox, "text", noted_text)
    monkeypatch.setattr(changes, "judged", noted_judged)
    bench.run({300: ask})
    assert bench.answers == [300]
    assert readers == judges
    assert len(readers | loops) == 2


def test_options_of_one_law_are_refused_while_others_alternate(
    make_rig: RigFactory, tmp_path: Path
) -> None:
    bench = Bench(make_rig, tmp_path, {"wall.law": "exponential"}, alternate=("standard",))
    outcome = bench.run({300: lambda: bench.ask("options.length=0.01")})
    assert outcome.trips == []
    assert bench.answers == ["law: law standard has no option 'length'; it has none"]


def test_change_is_judged_anew_when_another_one_comes_first(
    make_rig: RigFactory, tmp_path: Path
) -> None:
    """The schedule exchanges the law while a change of the former law's options is on its way."""
    bench = Bench(
        make_rig,
        tmp_path,
        {"wall.law": "exponential", "run.more_laws": ["standard"], "run.blend_s": 0.02},
    )
    standard = bench.settings.wall.model_copy(update={"law": "standard", "options": {}})
    stages = [WallStage(300, standard, bench.settings.limits)]
    outcome = bench.run({300: lambda: bench.ask("options.length=0.01")}, changes=stages)
    assert outcome.trips == []
    assert bench.answers == ["law: law standard has no option 'length'; it has none"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"law": 3}', '{"nothing": 1}', "\0" * 4096])
def test_rubbish_in_the_mailbox_is_refused(make_rig: RigFactory, tmp_path: Path, text: str) -> None:
    bench = Bench(make_rig, tmp_path, {})
    refused: list[str] = []

    def post() -> None:
        mailbox = Mailbox.open(bench.folder.read_live().mailbox)
        with pytest.raises(ConfigError) as error:
            mailbox.post(text, PATIENCE_S)
        refused.append(str(error.value))
        mailbox.close()

    assert bench.run({300: post}).trips == []
    assert len(refused) == 1


def test_change_that_waits_at_the_end_of_the_run_is_refused(
    make_rig: RigFactory, tmp_path: Path
) -> None:
    bench = Bench(make_rig, tmp_path, {})
    with open_to_changes([bench.loop.axis], [bench.folder], bench.loop.exchange, Outcome()):
        bench.ask("stiffness_nm_per_rad=20")
    wait_for(lambda: bool(bench.answers))
    assert bench.answers == ["the run has ended"]
    assert bench.loop.axis.offers == []


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (
            ["stifness_nm_per_rad=1"],
            "stifness_nm_per_rad: unknown key; did you mean stiffness_nm",
        ),
        (["stiffness_nm_per_rad=-1"], "stiffness_nm_per_rad: has to be greater than or equal to 0"),
        (["limits.torque=1"], "limits.torque: unknown key; did you mean torque_nm?"),
        (["do=end"], "do: unknown key"),
        (["options=1", "options.length=2"], "options.length: options has a value of its own"),
    ],
)
def test_impossible_change_is_not_posted(
    tmp_path: Path, assignments: list[str], message: str
) -> None:
    folder = RunFolder(tmp_path)
    with live_memory(folder) as memory:
        with pytest.raises(ConfigError) as error:
            post_change(folder, assignments)
        assert str(error.value).startswith(message)
        assert not memory.mailbox.waiting()


def test_run_that_is_over_takes_no_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(ConfigError, match="no run in progress"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
    monkeypatch.setattr(changes, "_PATIENCE_S", 0.01)
    monkeypatch.setattr("canwall.record.mailbox._LAST_ANSWER_S", 0.01)
    with live_memory(folder) as memory:
        with pytest.raises(RunFailedError, match="does not take the change"):
            post_change(folder, ["stiffness_nm_per_rad=1"])
        assert memory.mailbox.withdrawn()


def put_at(address: MemoryAddress, path: Path) -> None:
    """Put another file where a block of memory was, as another process with its number has it."""
    with path.open("rb+") as file:
        os.dup2(file.fileno(), address.descriptor)


@pytest.mark.parametrize("block", LiveAddresses._fields)
def test_file_of_another_process_is_not_taken_for_the_memory(tmp_path: Path, block: str) -> None:
    folder, foreign = RunFolder(tmp_path), tmp_path / "thesis"
    foreign.write_bytes(bytes(10_000))
    with live_memory(folder) as memory:
        addresses = memory.addresses
        address = getattr(addresses, block)
        kept = os.dup(address.descriptor)
        put_at(address, foreign)
        # Nor is one that live.json names itself.
        for named in (address, address._replace(file=str(foreign))):
            folder.write_live(addresses._replace(**{block: named}))
            with pytest.raises(ConfigError, match="no run in progress"):
                post_change(folder, ["stiffness_nm_per_rad=1"])
        os.dup2(kept, address.descriptor)
        os.close(kept)
    # The same number in the next run of the same process.
    folder.write_live(addresses)
    with live_memory(RunFolder(tmp_path / "next")), pytest.raises(ConfigError, match="no run in"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
    assert foreign.read_bytes() == bytes(10_000)


def test_nobody_can_cut_the_memory_off(tmp_path: Path) -> None:
    with live_memory(RunFolder(tmp_path)) as memory:
        for address in memory.addresses:
            path = f"/proc/{address.pid}/fd/{address.descriptor}"
            with open(path, "rb+", buffering=0) as file, pytest.raises(PermissionError):
                file.truncate(0)


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", "null", "5", '{"mailbox": "/proc/1/fd/1"}', "[" * 100_000, "\0"),
        '{"pid": 1, "descriptor": 3, "file": "x"}',
        *(
            "{" + ", ".join(f'"{block}": {address}' for block in LiveAddresses._fields) + "}"
            for address in (
                "1",
                '{"pid": "1", "descriptor": 3, "file": "x"}',
                '{"pid": 1, "descriptor": 3, "file": ["x"]}',
                '{"pid": 1, "descriptor": 3, "file": "x", "more": 1}',
                '{"pid": -1, "descriptor": 3, "file": "/memfd:canwall-mailbox-0 (deleted)"}',
                '{"pid": true, "descriptor": 3, "file": "\\u0000"}',
                '{"pid": 1, "descriptor": 3, "file": "/memfd:canwall-mailbox-\\u0000"}',
            )
        ),
    ],
)
def test_live_file_that_is_something_else(tmp_path: Path, text: str) -> None:
    folder = RunFolder(tmp_path)
    folder.live.write_text(text)
    with pytest.raises(ConfigError, match="no run in progress; give the folder of one that is"):
        post_change(folder, ["stiffness_nm_per_rad=1"])
