"""Samples in and out of zenoh's own types, and with which quality of service they travel."""

from __future__ import annotations

from typing import Any

from coview_stream.stream.guard import Guard
from coview_stream.stream.messages import Encoded, Sample
from coview_stream.stream.transport import Urgency

_UNSET = "zenoh/bytes"  # how zenoh spells "no encoding"


class ZenohPublisher:
    """A publisher that may exist before the session does."""

    def __init__(self, key: str, guard: Guard) -> None:
        self._key = key
        self._guard = guard
        self._publisher: Any = None
        self._closed = False

    def attach(self, publisher: Any) -> None:
        """Take zenoh's publisher, once there is a session to declare it on."""
        self._publisher = publisher
        if self._closed:
            self.close()

    def put(self, message: Encoded) -> None:
        """Publish; lost while there is no session yet or nobody to send to."""
        publisher = self._publisher
        if publisher is not None and not self._closed:
            encoding = message.encoding or _UNSET
            self._guard.run(
                self._key,
                lambda: publisher.put(message.payload, encoding=encoding, attachment=message.attachment),
            )

    def close(self) -> None:
        """Undeclare; later messages are ignored."""
        self._closed = True
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            self._guard.run(self._key, publisher.undeclare)


def plain(sample: Any, max_payload: int | None = None) -> Sample:
    """Return a zenoh sample as plain data. Copies the payload once: zenoh's Python types share no memory.

    Payload and attachment that are together larger than ``max_payload`` are not copied, which would hold up every other
    thread, but for their size.
    """
    key, encoding = str(sample.key_expr), str(sample.encoding)
    encoding = "" if encoding == _UNSET else encoding
    attachment = sample.attachment
    size = len(sample.payload) + (0 if attachment is None else len(attachment))
    if max_payload is not None and size > max_payload:
        return Sample(key, b"", encoding, size=size)
    return Sample(
        key, sample.payload.to_bytes(), encoding, None if attachment is None else attachment.to_bytes()
    )


def quality(urgency: Urgency) -> dict[str, Any]:
    """Return the options to declare a publisher with."""
    import zenoh

    congestion, priority = zenoh.CongestionControl, zenoh.Priority
    if (
        urgency == "realtime"
    ):  # express: not batched; 0.2 ms beside a flood of clouds on the same link instead of 8
        return {"express": True, "priority": priority.REAL_TIME, "congestion_control": congestion.DROP}
    if urgency == "report":
        return {"congestion_control": congestion.DROP}
    if urgency == "data":  # DROP lost 2 % of small messages at 300 robots on one link
        return {"congestion_control": congestion.BLOCK}
    # BLOCK_FIRST hands one frame to a background task and drops newer ones meanwhile: put never waits. DROP gives up a
    # big frame half sent after 50 ms, so on a slow link none arrives
    return {"congestion_control": getattr(congestion, "BLOCK_FIRST", congestion.DROP)}
