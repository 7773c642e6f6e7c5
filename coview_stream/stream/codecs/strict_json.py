"""JSON objects from strangers: every value is checked, and what is wrong is a MessageError that names the field."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

from coview_stream.errors import MessageError
from coview_stream.stream.codecs.checks import check_size

_MAX_BYTES = 64 * 1024  # a pose has 0.8 kB


def _no_constant(name: str) -> NoReturn:
    raise MessageError(f"{name} is no JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise MessageError("a field occurs twice")
    return found


def load(payload: bytes) -> dict[str, Any]:
    """Fields of a JSON object; no field twice, no NaN."""
    check_size(payload, _MAX_BYTES)
    try:
        found = json.loads(payload, parse_constant=_no_constant, object_pairs_hook=_unique)
    except MessageError:
        raise
    except (ValueError, RecursionError) as error:
        raise MessageError(f"no JSON: {str(error)[:80]}") from error
    if not isinstance(found, dict):
        raise MessageError("the JSON is no object with fields")
    return found


def number(value: object, name: str) -> float:
    """Check that ``value`` is a finite number, and return it."""
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer beyond the floats
        pass
    raise MessageError(f"{name}: not a finite number")


def numbers(fields: dict[str, Any], name: str, count: int) -> list[float]:
    """Field ``name``, a list of ``count`` finite numbers."""
    values = fields.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise MessageError(f"{name}: write a list of {count} numbers")
    return [number(value, name) for value in values]


def text(fields: dict[str, Any], name: str, default: str | None = None) -> str:
    """Field ``name``, a text that can be written as UTF-8."""
    value = fields.get(name, default)
    if not isinstance(value, str) or any("\ud800" <= letter <= "\udfff" for letter in value):
        raise MessageError(f"{name}: write a text")
    return value
