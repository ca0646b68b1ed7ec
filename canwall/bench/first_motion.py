"""First motion of a drive: a small torque to and fro, to see that the handle turns with it.

Pulses begin at 1 % of the rated torque and grow until the handle answers, to 10 % or
`limits.torque_nm` at the most. Each is followed by its opposite, so that the handle comes to
rest near where it was.
"""

from collections.abc import Generator, Iterator
from dataclasses import dataclass

from canwall.cycle import WallAxis

#: Torques that are tried, as parts of the rated torque; the limit in place of those beyond it.
_PARTS = (0.01, 0.02, 0.05, 0.1)
#: Duration of a pulse, and of the rest after a pair [s]; travel that ends a pulse [rad].
_PULSE_S, _REST_S, _FAR_RAD = 0.04, 0.15, 0.05
#: Travel that is an answer: in rad, and in counts of a coarse encoder.
_LEAST_RAD, _LEAST_COUNTS = 0.001, 4.0


@dataclass(frozen=True)
class Answer:
    """Answer of the handle to a pair of pulses.

    Attributes:
        torque_nm: Torque of the pulses.
        part: The same as a part of the rated torque.
        travel_rad: Half of the difference between the travels after a positive and a negative one;
            what moves the handle by itself is not in it.
        least_rad: Travel from which on it is an answer.
        shown: Part of the torque that 0x6077 showed; None if the TPDO does not carry it.
    """

    torque_nm: float
    part: float
    travel_rad: float
    least_rad: float
    shown: float | None

    @property
    def moved(self) -> bool:
        """True if the handle answered."""
        return abs(self.travel_rad) >= self.least_rad


class FirstMotion:
    """The pulses as an experiment on one axis.

    Attributes:
        answers: Answers to the torques that were tried, the last one being that of the handle.
    """

    def __init__(self, axis: WallAxis) -> None:
        self.answers: list[Answer] = []
        self._axis = axis
        period = axis.settings.bus.cycle_s
        self._pulse = max(2, round(_PULSE_S / period))
        self._rest = max(2, round(_REST_S / period))
        self._position = 0.0
        self._shown = 0.0
        self._torques = self._all()

    def excite(self) -> bool:
        """Set the torque of the next cycle; return False at the end."""
        row = self._axis.row[0]
        if row["received"]:
            self._position = float(row["position_rad"])
        torque = next(self._torques, None)
        self._axis.cycle["test_per_mille"] = torque or 0
        return torque is not None

    def note(self) -> None:
        """Note the torque that the drive shows; no row is kept."""
        self._shown = float(self._axis.row["torque_actual"][0])
        self._axis.ring.take_rows()

    def conclude(self) -> None:
        """Conclude; what was found is in `answers`."""

    def _all(self) -> Iterator[int]:
        """Yield the torque of each cycle [per mille of the rated torque]."""
        axis = self._axis
        nm_per_mille = axis.setup.units.nm_per_mille
        limit = int(axis.settings.limits.torque_nm / nm_per_mille)
        most = max(1, min(limit, round(1000.0 * _PARTS[-1])))
        yield from [0] * self._rest
        for part in (*_PARTS, most / 1000.0):
            per_mille = round(1000.0 * part)
            if per_mille > most:
                continue
            there, shown_there = yield from self._pair(per_mille)
            back, shown_back = yield from self._pair(-per_mille)
            torque = per_mille * nm_per_mille
            carries = any(field.index == 0x6077 for field in axis.setup.tpdo.fields)
            answer = Answer(
                torque,
                part,
                0.5 * (there - back),
                max(_LEAST_RAD, _LEAST_COUNTS * axis.setup.units.rad_per_count),
                0.5 * (shown_there - shown_back) / torque if carries else None,
            )
            self.answers.append(answer)
            if answer.moved or per_mille == most:
                return

    def _pair(self, per_mille: int) -> Generator[int, None, tuple[float, float]]:
        """Yield a pulse, its opposite and a rest; return travel and torque shown at its end."""
        begun, cycles = self._position, 0
        while cycles < self._pulse and abs(self._position - begun) < _FAR_RAD:
            yield per_mille
            cycles += 1
        travel, shown = self._position - begun, self._shown
        yield from [-per_mille] * cycles
        yield from [0] * self._rest
        return travel, shown
