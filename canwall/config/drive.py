"""`[drive]`: which node, described by which EDS or DCF, and how it is to be set up."""

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator

from canwall.config.section import NonNegative, Positive, Section

_OBJECT = re.compile(r"0x([0-9A-Fa-f]{4})(?::([0-9A-Fa-f]{1,2}))?")


def _named_objects(value: dict[str, int]) -> dict[str, int]:
    for name in value:
        if _OBJECT.fullmatch(name) is None:
            raise ValueError(f"{name!r} names no object; write e.g. '0x6072' or '0x608F:01'")
    return value


#: Values of objects, by "0xINDEX" or "0xINDEX:SUB".
Objects = Annotated[dict[str, int], AfterValidator(_named_objects)]


def by_index(objects: dict[str, int]) -> dict[tuple[int, int], int]:
    """The same by index and sub-index."""
    found = {}
    for name, value in objects.items():
        match = _OBJECT.fullmatch(name)
        assert match is not None
        found[int(match[1], 16), int(match[2] or "0", 16)] = value
    return found


class Drive(Section):
    """`[drive]`: a node, its dictionary, and what the drive cannot say of itself."""

    node_id: int = Field(ge=1, le=127)
    eds: Path
    mode: Literal["auto", "cst", "pt"] = "auto"
    torque_pdo: Literal["sync", "immediate"] = "sync"
    rated_torque_nm: Positive | None = None
    counts_per_rev: Positive | None = None
    gear_ratio: Positive | None = None
    parameters: Objects = Field(default_factory=dict)
    download_dcf: bool = False
    restore: bool = False
    watchdog_s: Annotated[Positive, Field(ge=0.003, le=60.0)] = 0.1
    accept_no_watchdog: bool = False
    wait_s: NonNegative = 5.0

    @field_validator("eds", mode="before")
    @classmethod
    def _path(cls, value: object) -> object:
        return Path(value) if isinstance(value, str) else value

    @property
    def written(self) -> dict[tuple[int, int], int]:
        """`parameters` by index and sub-index."""
        return by_index(self.parameters)
