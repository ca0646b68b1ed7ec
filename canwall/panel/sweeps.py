"""Sweeps as a page shows them: maps at one condition, and their strikes simulated again.

xarray and compiled code are imported once a sweep is opened.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from canwall.errors import InputError
from canwall.extras import need
from canwall.panel.frames import SIGNALS, signals_frame
from canwall.panel.held import Held
from canwall.panel.pyramid import Pyramid
from canwall.panel.shelf import Shelf
from canwall.strict_json import as_json

if TYPE_CHECKING:
    import xarray as xr

    from canwall.sweep.plan import Plan

#: Sweeps that are held in memory, and maps of each: the exact limits take a second.
_HELD, _CONDITIONS = 3, 100
#: The most points of a strike.
_POINTS = 20_000
#: Columns of a strike: those of a run, the mean force on the hand over the period [N·m], and
#: position [rad] and force on the hand of the continuous referent.
_COLUMNS = (*SIGNALS, "felt", "referent_y", "referent_felt")
#: Relative difference up to which a measure is the one that the sweep has: the last digits may
#: differ on another processor.
_SAME = 1e-6


class Sweeps:
    """Sweeps below a folder, the last ones that were opened in memory."""

    def __init__(self, shelf: Shelf) -> None:
        self._shelf = shelf
        self._held = Held["_Sweep"](_HELD)

    def map(self, word: str, chosen: Mapping[str, int]) -> dict[str, Any]:
        """Return a sweep at one condition, as JSON.

        Of a map these are the walls that chatter, over stiffness and damping, and the analytic
        limits of a spring and damper; of a search the K-limits over damping.

        Args:
            word: Word of the sweep.
            chosen: Index of the condition on each axis but those of the wall and of the strike;
                0 where there is none.

        Raises:
            InputError: If there is no such sweep or no such condition, or the file is none.
        """
        sweep = self._open(word)
        return {**self._shelf.entry(sweep.path), **sweep.at(chosen)}

    def strike(self, word: str, indices: Mapping[str, int]) -> bytes:
        """Simulate the strike of one point again, as the sweep did.

        Args:
            word: Word of the sweep.
            indices: Index of the point on each axis; 0 where there is none.

        Returns:
            The length of a text, 4 bytes, little-endian; the text, JSON, filled up with blanks to a
            multiple of 8 bytes, length included; a frame of signals.

        Raises:
            InputError: If there is no such sweep or point, or its configuration cannot be used.
            RunFailedError: If the law does not return.
        """
        return self._open(word).strike(indices)

    def _open(self, word: str) -> "_Sweep":
        need("sweep")
        path = self._shelf.sweep(word)
        found = path.stat()
        key = path, found.st_mtime_ns, found.st_size
        return self._held.get(key, lambda: _Sweep.read(path))


class _Sweep:
    def __init__(self, path: Path, dataset: "xr.Dataset", plan: "Plan") -> None:
        self.path, self._dataset, self._plan = path, dataset, plan
        self._conditions = Held[dict[str, Any]](_CONDITIONS)

    @classmethod
    def read(cls, path: Path) -> "_Sweep":
        from canwall.sweep import plan_of, read_sweep

        dataset = read_sweep(path)
        try:
            return cls(path, dataset, plan_of(dataset))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def at(self, chosen: Mapping[str, int]) -> dict[str, Any]:
        at = self._indices(chosen, [axis.name for axis in self._plan.conditions])
        return self._conditions.get(tuple(at.items()), lambda: self._described(at))

    def _described(self, conditions: dict[str, int]) -> dict[str, Any]:
        from canwall.sweep.axes import STRIKES
        from canwall.sweep.labels import shared_parameters

        plan = self._plan
        dataset = self._dataset.isel(conditions)
        described = {
            "kind": "limits" if plan.stiffness is None else "map",
            "parameters": shared_parameters(dataset),
            "axes": [
                {
                    "name": axis.name,
                    **_words(axis.name),
                    "values": axis.values,
                    "shown": [_shown(value) for value in axis.values],
                }
                for axis in plan.axes
            ],
            "chosen": conditions,
            "strike_axes": list(STRIKES),
        }
        if plan.stiffness is None:
            return described | {
                "x": plan.damping.name,
                "y": None,
                "worst": dataset["worst"].values,
                "open_ended": dataset["open_ended"].all(STRIKES).values,
            }
        from canwall.sweep.limit_lines import limit_lines

        walls = dataset["chatters"].transpose(..., plan.damping.name, plan.stiffness.name)
        share = walls.mean(STRIKES).values
        return described | {
            "x": plan.stiffness.name,
            "y": plan.damping.name,
            "chatters": (share > 0.0).astype(int),
            "share": share,
            "limits": [
                {
                    "kind": line.limit.name.lower(),
                    "label": str(line.limit),
                    "x": line.stiffness,
                    "y": line.damping,
                }
                for line in limit_lines(dataset)
            ],
        }

    def strike(self, indices: Mapping[str, int]) -> bytes:
        from canwall.sweep import repeat_strike

        plan = self._plan
        at = self._indices(indices, [axis.name for axis in plan.axes])
        point = self._dataset.isel(at)
        searched = float(point["worst"]) if plan.stiffness is None else None
        if searched is not None and not searched > 0.0:
            raise InputError(f"{self.path}: no wall is free of chatter there: no strike to show")
        stiffness, damping, motion = repeat_strike(plan, at, searched)
        found = {name: motion.measures[name].item() for name in motion.measures.dtype.names or ()}
        stored = {name: point[name].item() for name in found if name in point}
        columns = [motion.rows[name] for name in SIGNALS]
        columns += [motion.felt, motion.referent, motion.referent_felt]
        # A law may ask for any force; what is shown is then infinite.
        with np.errstate(over="ignore"):
            shown = np.array(columns, np.float32)
        pyramid = Pyramid(np.ascontiguousarray(motion.rows["t_s"]), shown)
        text = {
            "columns": _COLUMNS,
            "cycle_s": point["period"].item(),
            "title": ", ".join(
                f"{axis.name} {_shown(axis.values[at[axis.name]])}" for axis in plan.axes
            ),
            "stiffness": stiffness,
            "damping": damping,
            "found": found,
            "stored": stored,
            "same": all(_is_same(found[name], stored[name]) for name in stored),
        }
        frame = signals_frame(*pyramid.between(-math.inf, math.inf, _POINTS))
        return _with_length(as_json(text).encode()) + frame

    def _indices(self, given: Mapping[str, int], axes: Sequence[str]) -> dict[str, int]:
        """Return an index for each of the axes. Raises InputError for one that does not exist."""
        for name, index in given.items():
            if name not in axes:
                raise InputError(f"{name}: no axis to choose from; there are {', '.join(axes)}")
            if not 0 <= index < self._dataset.sizes[name]:
                raise InputError(f"{name} = {index}: has to be below {self._dataset.sizes[name]}")
        return {name: given.get(name, 0) for name in axes}


def _words(name: str) -> dict[str, str]:
    """Return label and unit of an axis, as figures have them."""
    from canwall.sweep.axes import NAMED
    from canwall.sweep.labels import LABELS

    unit, described = NAMED.get(name, ("", name))
    label, _, shown = LABELS.get(name, described.partition(",")[0]).partition(" [")
    plain = "" if unit == "1" else unit.replace("*", "·")
    return {"label": label, "unit": shown.removesuffix("]") or plain}


def _with_length(text: bytes) -> bytes:
    text += b" " * (-(4 + len(text)) % 8)
    return struct.pack("<I", len(text)) + text


def _is_same(one: float, other: float) -> bool:
    return (math.isnan(one) and math.isnan(other)) or math.isclose(one, other, rel_tol=_SAME)


def _shown(value: Any) -> str:
    from canwall.sweep.labels import value_text

    return value_text(value)
