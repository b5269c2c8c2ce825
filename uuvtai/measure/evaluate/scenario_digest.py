"""Scenarios as one sha256: whether two evaluations met the same water."""

from __future__ import annotations

import hashlib
import json
from typing import Any

_DIGITS = 3
"""of a number: millimetres"""


def scenarios_sha256(scenarios: list[dict[str, Any]]) -> str:
    """Of ``closed_form.describe_scenario``'s documents, to the millimetre. On another processor a number may
    round to the other side: equal digests prove equal scenarios, unequal ones do not prove the contrary."""
    text = json.dumps(_rounded(scenarios), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(inner) for inner in value]
    return round(float(value), _DIGITS) + 0.0 if isinstance(value, float) else value
