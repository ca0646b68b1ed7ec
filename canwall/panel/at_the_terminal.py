"""A blind comparison at a terminal, without a page (`canwall study comparison`)."""

import json
import threading
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from canwall.config import ConfigError, Settings
from canwall.errors import InputError, RunFailedError
from canwall.panel.comparison import Comparison, check_comparison
from canwall.record import RunFolder
from canwall.record.live import LiveRun
from canwall.run import RunResult, run
from canwall.study import SessionEndedError, Terminal

_POLL_S = 0.05


class Compared(NamedTuple):
    """End of a comparison at a terminal.

    Attributes:
        result: The run.
        found: What has been found, as `Comparison.state` has it; empty without a wall.
        interrupted: True if the run was interrupted, and not ended by the person's answers.
    """

    result: RunResult
    found: dict[str, Any]
    interrupted: bool


def compare_at_terminal(
    settings: Settings, folder: RunFolder, asked: Mapping[str, Any], terminal: Terminal
) -> Compared:
    """Render walls in one run while the person at the handle compares them.

    Args:
        settings: Configuration of the run.
        folder: Folder of its record.
        asked: Keys of `ComparisonRequest`.
        terminal: Terminal of the person.

    Raises:
        InputError: If a key is wrong; nothing has been enabled. Otherwise as `run` does.
    """
    check_comparison(asked, settings.wall)
    dialogue = _Dialogue(folder, asked, terminal)
    dialogue.start()
    try:
        result = run(settings, folder.path, stopped=dialogue.over.is_set)
        interrupted = result.outcome.interrupted and not dialogue.over.is_set()
    finally:
        found = dialogue.end()
    if dialogue.error is not None and not result.outcome.trips:
        raise dialogue.error
    return Compared(result, found, interrupted)


class _Dialogue(threading.Thread):
    """The dialogue, beside the run; it may wait for the person when the run has ended.

    Attributes:
        over: Set once there is nothing more to ask.
        error: What the comparison could not begin for.
    """

    def __init__(self, folder: RunFolder, asked: Mapping[str, Any], terminal: Terminal) -> None:
        super().__init__(daemon=True)
        self.over = threading.Event()
        self.error: InputError | RunFailedError | TimeoutError | None = None
        self._folder, self._asked, self._terminal = folder, asked, terminal
        self._comparison: Comparison | None = None

    def run(self) -> None:
        """Wait for the wall, and ask."""
        try:
            with self._wall() as live:
                self._ask(live)
        except SessionEndedError:
            pass
        except (InputError, RunFailedError, TimeoutError) as error:
            self.error = error
        finally:
            self.over.set()

    def end(self) -> dict[str, Any]:
        """End the dialogue after the run; return what it has found."""
        self.over.set()
        if self._comparison is None:
            return {}
        if self._comparison.active:
            self._comparison.end("the run has ended", restore=False)
        return self._comparison.state()

    def _wall(self) -> LiveRun:
        """Return the run once it renders its wall."""
        while not self.over.wait(_POLL_S):
            try:
                live = LiveRun.open(self._folder)
            except ConfigError:
                continue
            while live.status().phase != "rendering" and not self.over.is_set():
                time.sleep(_POLL_S)
            return live
        raise SessionEndedError

    def _ask(self, live: LiveRun) -> None:
        def note(mark: dict[str, Any]) -> None:
            live.request({"do": "mark", "text": json.dumps(mark)})

        comparison = self._comparison = Comparison(live.request, note, self._folder.path)
        comparison.begin(self._asked, live.settings().wall)
        try:
            while comparison.active and not self.over.is_set():
                self._step(comparison)
        except SessionEndedError:
            comparison.end("the person ended it")

    def _step(self, comparison: Comparison) -> None:
        """Show the other wall, or take an answer, as the person wishes."""
        state = comparison.state()
        answers = [answer["value"] for answer in state["answers"]]
        line = self._terminal.ask(
            f"Trial {state['trial']} of {state['trials']}, wall {state['wall']}. Enter: the other "
            f"wall. {state['question']} {', '.join(answers)}:",
            ("", *answers),
        )
        try:
            if line:
                comparison.answer(line)
            else:
                comparison.show("2" if state["wall"] == "1" else "1")
        except InputError as error:
            self._terminal.say(str(error))
