"""From samples to messages: what cannot be decoded is counted and, once, named."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeVar

from coview_stream.errors import EncodingError, MessageError
from coview_stream.stream.codecs import OversizedError
from coview_stream.stream.counters import Counters
from coview_stream.stream.messages import Sample

_MOST_ERRORS = 10  # different complaints that are kept

Message = TypeVar("Message")


class Complaints:
    """The newest different complaints, each once."""

    def __init__(self) -> None:
        self.texts: deque[str] = deque(maxlen=_MOST_ERRORS)

    def add(self, text: str) -> None:
        """Remember a complaint unless it is known."""
        if text not in self.texts:
            self.texts.append(text)


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
    if len(sample.payload) > max_payload:
        return None, "oversized", f"{len(sample.payload)} bytes, {max_payload} are the most"
    try:
        return decode(sample, option, hint), "", ""
    except EncodingError as error:
        return None, "unknown_encoding", str(error)
    except OversizedError as error:
        return None, "oversized", str(error)
    except MessageError as error:
        return None, "malformed", str(error)


def note(counters: Counters, complaints: Complaints, prefix: str, name: str, key: str, reason: str) -> None:
    """Count what could not be decoded; name it, unless every such message would have a reason of its own."""
    counters.count(prefix + name)
    if name == "malformed":
        reason = "malformed messages; the first one: " + reason
        if any(text.startswith(f"{key}: malformed") for text in complaints.texts):
            return
    complaints.add(f"{key}: {reason}")
