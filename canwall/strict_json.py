"""JSON as its standard has it (RFC 8259), without NaN and infinity."""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def as_json(content: Any) -> str:
    """Return a value as JSON; what is no finite number is null."""
    return json.dumps(plain(content), ensure_ascii=False, allow_nan=False)


def plain(value: Any) -> Any:
    """Return a value of the types of JSON; what is no finite number is None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {one.name: getattr(value, one.name) for one in dataclasses.fields(value)}
    elif hasattr(value, "model_dump"):  # pydantic's models
        value = value.model_dump(mode="json")
    elif hasattr(value, "_asdict"):  # named tuples
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy's arrays and scalars
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
