"""Values as JSON has them: NaN and infinity become null."""

import math
from collections.abc import Mapping
from typing import Any


def nan_to_none(value: Any) -> Any:
    """Return `value` with None for every number that is not finite, through dicts and lists."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: nan_to_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [nan_to_none(item) for item in value]
    return value
