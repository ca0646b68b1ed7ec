"""`[drive]`: the node, its object dictionary, and its set-up."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from canwall.config.section import FilePath, NonNegative, Positive, Section, Torque

_OBJECT = re.compile(r"0x([0-9A-Fa-f]{4})(?::([0-9A-Fa-f]{1,2}))?")


def _check_object_names(value: dict[str, int]) -> dict[str, int]:
    for name in value:
        if _OBJECT.fullmatch(name) is None:
            raise ValueError(f"{name!r} is not an object; write e.g. '0x6072' or '0x608F:01'")
    return value


#: Unit of 0x6076 in CiA 402-2 [N·m].
MILLI_NM = 1e-3

#: Values of objects, by "0xINDEX" or "0xINDEX:SUB".
Objects = Annotated[dict[str, int], AfterValidator(_check_object_names)]


def by_index(objects: dict[str, int]) -> dict[tuple[int, int], int]:
    """Return the values of objects by index and sub-index instead of name."""
    values = {}
    for name, value in objects.items():
        match = _OBJECT.fullmatch(name)
        assert match is not None
        values[int(match[1], 16), int(match[2] or "0", 16)] = value
    return values


class Drive(Section):
    """`[drive]`: a node, its object dictionary, and values that the drive does not provide.

    A key without a value is read from the drive. mode: "cst", "pt", or "auto" for the first of
    them that the drive has. torque_pdo: a torque acts at the next SYNC, or on reception
    ("immediate"). parameters: written at the set-up. download_dcf: write the values of the DCF
    first. restore: undo all changes at the end. watchdog_s: silence of the master after which the
    drive disables itself. wait_s: how long to wait for the drive to answer. sdo_timeout_s: how
    long to wait for the answer to one SDO request. rated_torque_unit_nm: unit of 0x6076 in N·m;
    CiA 402 has 1e-3, some manufacturers 1e-6. drive_cycle_s, current_bandwidth_hz: the drive's own
    cycle, and the bandwidth of its current loop, as the model of the laws has them; 0: not known.
    """

    node_id: int = Field(ge=1, le=127)
    eds: FilePath
    mode: Literal["auto", "cst", "pt"] = "auto"
    torque_pdo: Literal["sync", "immediate"] = "sync"
    rated_torque_nm: Torque | None = None
    rated_torque_unit_nm: Annotated[Positive, Field(ge=1e-9, le=1.0)] | None = None
    counts_per_rev: Annotated[Positive, Field(ge=1.0, le=2.0**32)] | None = None
    gear_ratio: Annotated[Positive, Field(ge=1e-6, le=1e6)] | None = None
    drive_cycle_s: NonNegative = 0.0
    current_bandwidth_hz: NonNegative = 0.0
    parameters: Objects = Field(default_factory=dict)
    download_dcf: bool = False
    restore: bool = False
    watchdog_s: Annotated[Positive, Field(ge=0.003, le=60.0)] = 0.1
    accept_no_watchdog: bool = False
    wait_s: NonNegative = 5.0
    sdo_timeout_s: Annotated[Positive, Field(ge=0.001, le=10.0)] = 0.5

    @property
    def parameters_by_index(self) -> dict[tuple[int, int], int]:
        """`parameters` by index and sub-index."""
        return by_index(self.parameters)
