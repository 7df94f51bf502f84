"""The result of a command as JSON, as the option ``--json`` prints it."""

from __future__ import annotations

import json
import math
from typing import Any


def json_line(document: dict[str, Any]) -> str:
    """Return the result of a command as one JSON object on one line of ASCII, which each terminal can show.

    A number that is not finite is null.
    """
    return json.dumps(_finite(document), default=str, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
