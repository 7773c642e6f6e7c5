"""Size of a status: bounded, because small readers drop longer messages without a word.

A default zenoh-pico takes messages of a few kB; one of 5 kB is lost there silently.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

MAX_STATUS = 3500
"""Bytes of a status, whatever happens; a usual one has 2,000."""

_TEXT, _SHORT_TEXT = 300, 100  # characters, set by hand


def encode_status(document: dict[str, Any]) -> bytes:
    """Encode a status (JSON) in at most :data:`MAX_STATUS` bytes.

    Where it would be longer, what matters least is left out first, and ``shortened`` names what was: ids of the others
    on the network, evidence of past changes of state, old errors, past changes, the end of long texts.
    """
    text = _encode(document)
    if len(text) <= MAX_STATUS:
        return text
    short: dict[str, Any] = json.loads(text)
    for name, shorten in _STEPS:
        shorten(short)
        short["shortened"] = [*short.get("shortened", ()), *([name] if name not in short.get("shortened", ()) else ())]
        text = _encode(short)
        if len(text) <= MAX_STATUS:
            break
    return text


def _encode(document: dict[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":"), ensure_ascii=True).encode()


def _connection(document: dict[str, Any]) -> None:
    connection = document["connection"]
    for name in ("routers", "peers"):
        connection[name] = connection[name][:2]


def _evidence_of_transitions(document: dict[str, Any]) -> None:
    for each in document["transitions"]:
        each["evidence"] = None
        each["reason"] = _cut(each["reason"], _SHORT_TEXT)


def _errors(document: dict[str, Any]) -> None:
    document["errors"] = [_cut(text, _SHORT_TEXT) for text in document["errors"][-3:]]


def _transitions(document: dict[str, Any]) -> None:
    document["transitions"] = document["transitions"][-1:]


def _texts(document: dict[str, Any]) -> None:
    document["reason"] = _cut(document["reason"], _TEXT)
    if document.get("evidence"):
        document["evidence"]["reason"] = _cut(document["evidence"]["reason"], _SHORT_TEXT)
    if document.get("calibration"):
        says = document["calibration"].get("says") or []
        document["calibration"]["says"] = [_cut(text, _SHORT_TEXT) for text in says[:3]]


def _all_but_the_state(document: dict[str, Any]) -> None:
    """Leave what a robot has to know: names and texts of hundreds of characters are all that can come to here."""
    kept = (
        "robot",
        "stamp_ns",
        "state",
        "reason",
        "version",
        "map_sha256",
        "last_frame_ns",
        "pose",
        "node",
        "shortened",
    )
    for name in [name for name in document if name not in kept]:
        del document[name]
    document["reason"] = _cut(document["reason"], _SHORT_TEXT)


_STEPS: tuple[tuple[str, Callable[[dict[str, Any]], None]], ...] = (
    ("connection", _connection),
    ("transitions", _evidence_of_transitions),
    ("errors", _errors),
    ("transitions", _transitions),
    ("reason", _texts),
    ("all but the state", _all_but_the_state),
)


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 4]} ..."
