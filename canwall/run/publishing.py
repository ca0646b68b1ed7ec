"""State of a run, published for other processes some 30 times a second.

It is done by a thread beside the loop, which must not hold the interpreter for long: numbers are
copied, and what takes computing is left to the readers.
"""

import math

import numpy as np

from canwall.compiled import fields
from canwall.cycle import Exchange, Outcome, WallAxis
from canwall.drive import status_text
from canwall.record import RunFolder
from canwall.record.live import LiveLaw, LiveMemory, LiveOption, LiveSettings
from canwall.record.status import EMCY, STATE, STATUS, TRIP


class Publisher:
    """Publishes one axis."""

    def __init__(
        self, axis: WallAxis, exchange: Exchange, outcome: Outcome, folder: RunFolder
    ) -> None:
        self._axis = axis
        self._config = str(folder.config.resolve())
        self._exchange = exchange
        self._outcome = outcome
        self._record = np.zeros(1, STATUS)
        self._cycle = fields(axis.cycle)
        self._published = -1
        self._statusword = -1
        self._emergencies = 0
        status, settings = self._record[0], axis.settings
        status["cycle_s"] = settings.bus.cycle_s
        status["real_time"] = settings.real_time
        status["emcy_code"] = -1
        status["hand_damping_nm_s_per_rad"] = math.nan
        status["hand_stiffness_nm_per_rad"] = math.nan

    def publish(self, memory: LiveMemory, ended: bool) -> None:
        """Publish the status, and the settings if they have changed."""
        self._fill(ended)
        revision = self._axis.revision  # first: what changes meanwhile is published again
        if revision != self._published:
            memory.publish_settings(self._settings(revision))
            self._published = revision
        memory.publish(self._record)

    def _fill(self, ended: bool) -> None:
        axis, status, cycle = self._axis, self._record[0], self._cycle
        estimator, guard = cycle.estimator[0], cycle.guard[0]
        status["cycle"] = cycle.j
        status["phase"] = cycle.phase
        status["ended"] = ended
        status["trip"] = _cut("; ".join(self._outcome.trips) or axis.reported, TRIP)
        if cycle.statusword != self._statusword:
            self._statusword = cycle.statusword
            status["drive_state"] = _cut(status_text(self._statusword), STATE)
        if len(axis.node.emergencies) != self._emergencies:
            self._emergencies = len(axis.node.emergencies)
            latest = axis.node.emergencies[-1]
            status["emcy_code"] = latest.code
            status["emcy"] = _cut(latest.get_desc() or "no description", EMCY)
        status["mass_kg_m2"] = estimator.mass
        status["mass_spread"] = spread = cycle.bank[0].spread
        hand = estimator.viscous - axis.settings.mechanics.viscous_nm_s_per_rad
        status["hand_damping_nm_s_per_rad"] = hand if spread else math.nan
        status["delay_cycles"] = axis.delay + cycle.lag
        status["guard_factor"] = guard.factor
        status["guard_alarms"] = guard.alarms
        status["guard_lowest"] = guard.lowest
        status["energy_j"] = cycle.energy_out
        status["missed_tpdo"] = cycle.missed_tpdo
        status["late_rpdo"] = axis.late_rpdo
        status["rows_lost"] = axis.ring.header["rows_lost"][0]
        status["frames_lost"] = axis.ring.header["frames_lost"][0]
        status["revision"] = axis.revision
        status["beat_timeout_s"] = axis.beat_timeout_s
        status["sync_interval_max_s"] = self._exchange.sync_interval["largest_ns"][0] * 1e-9
        status["latency"] = axis.latency
        status["sync_to_rpdo"] = axis.sync_to_rpdo

    def _settings(self, revision: int) -> LiveSettings:
        axis, settings, units = self._axis, self._axis.settings, self._axis.setup.units
        torque_limit = axis.setup.torque_limit_nm
        laws = [
            LiveLaw(
                name=law.name,
                options=tuple(
                    LiveOption(name=name, default=float(value))
                    for name, value in law.options.items()
                ),
            )
            for law in axis.laws
        ]
        return LiveSettings(
            revision=revision,
            wall=axis.wall,
            limits=axis.limits,
            guard=axis.guard,
            operator=axis.operator,
            turns=tuple(axis.turns),
            laws=tuple(laws),
            config=self._config,
            rated_torque_nm=units.rated_torque_nm,
            torque_limit_nm=torque_limit if math.isfinite(torque_limit) else None,
            count_rad=units.rad_per_count,
            cycle_s=settings.bus.cycle_s,
            handle_radius_m=settings.mechanics.handle_radius_m,
            side=axis.wall.side,
            node_id=settings.drive.node_id,
            bus=f"{settings.bus.interface} {settings.bus.channel}",
        )


def _cut(text: str, most: int) -> bytes:
    """Return a text of at most so many bytes."""
    return text.encode(errors="replace")[:most]
