"""Requests of the pages to one run, carried out one at a time, in a thread that may wait for it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from canwall.config import ConfigError, Request, Wall, WallChange
from canwall.errors import InputError
from canwall.panel.ab import AB
from canwall.panel.comparison import Comparison
from canwall.panel.follower import Live
from canwall.panel.presets import Presets

#: Requests that would tell which wall is in force, or change it, in a blind comparison.
_NOT_BLIND = ("change", "take_turns", "preset_save", "preset_use", "ab_set", "ab_use", "ab_auto")


class RunRequests:
    """Wall, A and B, blind comparison and presets of a run in progress."""

    def __init__(
        self, folder: Path, live: Live, presets: Presets, tell: Callable[..., None]
    ) -> None:
        """Take a run.

        Args:
            folder: Its folder.
            live: The run.
            presets: Presets of the user.
            tell: Tells the pages of an event.
        """
        self._live = live
        self._presets = presets
        self._tell = tell
        self._ab = AB(live.request)
        self.comparison = Comparison(live.request, self._note, folder)

    def carry_out(self, do: str, content: Any) -> dict[str, Any]:
        """Carry out a request; return what its answer has beside `ok`.

        Raises:
            InputError: If it is wrong, or the run refuses it.
            RunFailedError: If the run does not take it in time.
        """
        if do in _NOT_BLIND and self.comparison.active:
            raise ConfigError("a blind comparison is in progress; end it first")
        if isinstance(content, Request):
            if do == "watch_beat":
                self._live.beat()  # the time until the first one begins now
            return _at(self._live.request(content))
        kind = do.partition("_")[0]
        try:
            return {"preset": self._preset, "ab": self._a_or_b, "blind": self._blind}[kind](
                do, content
            )
        finally:
            if kind != "preset":
                self.tell()

    def tell(self) -> None:
        """Tell the pages how A and B and the blind comparison are."""
        if self.comparison.active:
            self._tell("ab", a=None, b=None, which=None, auto=False)
        else:
            self._tell("ab", **self._ab.state())
        self._tell("blind", **self.comparison.state())

    def strike_ended(self, began: int) -> None:
        """Show the other wall of a blind comparison, if each strike is to do so."""
        if self.comparison.active:
            self.comparison.strike_ended(began)
            self.tell()

    def run_ended(self) -> None:
        """End a blind comparison with its run."""
        if self.comparison.active:
            self.comparison.end("the run has ended", restore=False)
            self.tell()

    def _note(self, content: dict[str, Any]) -> None:
        self._live.request({"do": "mark", "text": json.dumps(content, ensure_ascii=False)})

    @property
    def _wall(self) -> Wall:
        """The wall in force."""
        wall: Wall = self._live.settings().wall
        return wall

    def _preset(self, do: str, content: Any) -> dict[str, Any]:
        if do == "preset_use":
            change = self._presets.get(content.name)
            return _at(self._live.request(_request(change)))
        if do == "preset_save":
            self._presets.save(content.name, _as_change(self._wall))
        else:
            self._presets.remove(content.name)
        tell_presets(self._presets, self._tell)
        return {}

    def _a_or_b(self, do: str, content: Any) -> dict[str, Any]:
        if do == "ab_set":
            a, b = (each.model_dump(exclude_none=True) for each in (content.a, content.b))
            self._ab.set(a, b, self._wall, self._live.settings().laws)
            return {}
        return _at(self._ab.use(content.which) if do == "ab_use" else self._ab.auto(content.on))

    def _blind(self, do: str, content: dict[str, Any]) -> dict[str, Any]:
        comparison = self.comparison
        if do == "blind_begin":
            if not comparison.active:
                self._ab.auto(False)
            comparison.begin(content, self._wall)
        elif do == "blind_show":
            return _at(comparison.show(content.get("which", "")))
        elif do == "blind_answer":
            comparison.answer(content.get("answer", ""))
        else:
            comparison.end()
        return {}


def tell_presets(presets: Presets, tell: Callable[..., None]) -> None:
    """Tell the pages of all presets, or why there are none."""
    try:
        found = presets.all()
    except InputError as error:
        tell("presets", presets=[], error=str(error))
        return
    content = [
        {"name": name, "change": change.model_dump(mode="json", exclude_none=True)}
        for name, change in found.items()
    ]
    tell("presets", presets=content)


def _at(cycle: int | None) -> dict[str, Any]:
    return {} if cycle is None else {"cycle": cycle}


def _request(change: WallChange) -> dict[str, Any]:
    return {"do": "change"} | change.model_dump(mode="json", exclude_none=True)


def _as_change(wall: Wall) -> WallChange:
    """Return the change that leads to a wall from any other."""
    known = wall.model_dump(exclude_none=True)
    if wall.damping_ratio:
        del known["damping_nm_s_per_rad"]
    keys = set(WallChange.model_fields)
    return WallChange.model_validate({key: known[key] for key in known if key in keys})
