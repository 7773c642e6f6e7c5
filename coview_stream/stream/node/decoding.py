"""From samples to messages: what cannot be decoded is counted and, once, named."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from coview_stream.errors import EncodingError, MessageError
from coview_stream.messages import OversizedError
from coview_stream.messages.types import CloudMessage, Sample
from coview_stream.stream.node.counters import Counters

_MOST_ERRORS = 10  # different complaints that are kept
_MOST_LOGGED = 20  # complaints about one robot's input that are logged, ever: its sender may invent new ones

log = logging.getLogger("coview_stream.node")

Message = TypeVar("Message")


class ErrorLog:
    """The newest different complaints, each once; the first few are logged as well."""

    def __init__(self) -> None:
        self.texts: deque[str] = deque(maxlen=_MOST_ERRORS)
        self._logged = 0

    def add(self, text: str, logged: bool = True) -> None:
        """Remember a complaint unless it is known; ``logged`` is whether it is this class that logs it."""
        if text not in self.texts:
            self.texts.append(text)
            if logged and self._logged < _MOST_LOGGED:
                self._logged += 1
                log.warning("%s", text)

    def add_first(self, kind: str, text: str) -> None:
        """Remember only the first complaint of a kind, where every one would be worded differently."""
        start = f"{kind}; the first: "
        if not any(known.startswith(start) for known in self.texts):
            self.add(start + text)


def received(
    sample: Sample,
    decode: Callable[[Sample, str | None, str | None], Message],
    option: str | None,
    hint: str | None,
    max_payload: int,
) -> tuple[Message | None, str, str]:
    """Decode a sample.

    Returns:
        The message, or None with the name of the counter that it belongs to (see :class:`Counters`) and the reason.
    """
    size = len(sample.payload) if sample.size is None else sample.size
    if sample.size is not None or size > max_payload:
        return None, "oversized", f"{size} bytes, {max_payload} are the most"
    try:
        return decode(sample, option, hint), "", ""
    except EncodingError as error:
        return None, "unknown_encoding", str(error)
    except OversizedError as error:
        return None, "oversized", str(error)
    except MessageError as error:
        return None, "malformed", str(error)


def note(counters: Counters, complaints: ErrorLog, prefix: str, name: str, key: str, reason: str) -> None:
    """Count what could not be decoded; name it, unless every such message would have a reason of its own."""
    counters.count(prefix + name)
    if name == "unknown_encoding":
        complaints.add(reason)
    else:
        complaints.add_first(f"{key}: {name} messages", reason.removeprefix(f"{key}: "))


def last_line(text: str) -> str:
    """Return what a traceback ends with."""
    return (text.strip() or "unknown failure").splitlines()[-1]


def voxelized_cloud(message: CloudMessage, most: int) -> CloudMessage:
    """Return the cloud with every n-th point only, if it has more than ``most``."""
    step = -(-len(message.points) // most)
    if step <= 1:
        return message
    times = None if message.times is None else message.times[::step]
    rings = None if message.rings is None else message.rings[::step]
    return replace(message, points=np.ascontiguousarray(message.points[::step]), times=times, rings=rings)
