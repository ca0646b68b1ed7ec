"""From the configuration of a fault to its plan."""

import math

from canwall.config import Fault as FaultSettings
from canwall.faults import KINDS, POWER_ON, PlannedFault


def planned(settings: FaultSettings, period_s: float, real_time: bool) -> PlannedFault:
    """Return the fault that the configuration asks for, with every default filled in.

    Args:
        settings: entry of `[[simulation.fault]]`.
        period_s: SYNC period in seconds.
        real_time: True if times need not be whole SYNC periods.
    """

    def periods(syncs: int | None, seconds: float | None, open_end: float) -> float:
        if syncs is not None:
            return float(syncs)
        if seconds is None:
            return open_end
        exact = seconds / period_s
        return exact if real_time else float(round(exact))

    kind = KINDS[settings.kind]
    amount = settings.amount
    if amount is None:
        amount = kind.amount.usual if kind.amount else 0
    return PlannedFault(
        kind=kind,
        begin=periods(settings.at_sync, settings.at_s, POWER_ON),
        periods=periods(
            settings.duration_syncs, settings.duration_s, 0.0 if kind.momentary else math.inf
        ),
        can_id=settings.can_id,
        direction=settings.direction or kind.direction,
        probability=1.0 if settings.probability is None else settings.probability,
        amount=amount,
    )
