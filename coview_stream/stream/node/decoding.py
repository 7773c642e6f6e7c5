"""Decoding of samples: messages that cannot be read are counted, and the first of each kind is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from coview_stream.errors import EncodingError, MessageError
from coview_stream.messages import OversizedError
from coview_stream.messages.types import CloudMessage, Sample
from coview_stream.stream.node.counters import Counters, ErrorLog

Message = TypeVar("Message")


def decode_sample(
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


def count_undecodable(
    counters: Counters, errors: ErrorLog, prefix: str, name: str, key: str, reason: str
) -> None:
    """Count a message that could not be decoded; name it, unless every such message would have its own reason."""
    counters.count(prefix + name)
    if name == "unknown_encoding":
        errors.add(reason)
    else:
        errors.add_first(f"{key}: {name} messages", reason.removeprefix(f"{key}: "))


def limit_points(message: CloudMessage, max_points: int) -> CloudMessage:
    """Return the cloud with every n-th point only, if it has more than ``max_points``."""
    step = -(-len(message.points) // max_points)
    if step <= 1:
        return message
    times = None if message.times is None else message.times[::step]
    rings = None if message.rings is None else message.rings[::step]
    return replace(message, points=np.ascontiguousarray(message.points[::step]), times=times, rings=rings)
