"""JSON: files read with their faults named, what is a number there, and values of JSON's own types."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.files import printable, read_text


def read_json(path: Path) -> Any:
    """What a JSON file holds; OSError, or ValueError where it is none."""
    try:
        return json.loads(read_text(path))
    except RecursionError:
        raise ValueError("lists within lists, hundreds deep") from None


def is_number(value: Any) -> bool:
    """Whether it is a finite number, and no truth value; whole numbers must be ones that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def plain(value: Any) -> Any:
    """``value`` of JSON's own types: arrays become lists, numbers that are not finite null, anything else its text."""
    if isinstance(value, Mapping):
        return {printable(str(k)): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if value is None or isinstance(value, bool | int):
        return value
    return printable(str(value))


def to_text(content: Mapping[str, Any]) -> str:
    """JSON text, one key of the outermost level a line."""
    lines = (f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in content.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"
