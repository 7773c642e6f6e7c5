"""Queries in zenoh: answers to those of others, for all keys on one thread, and the first reply to one of ours."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import Any

from coview_stream.errors import TransportError
from coview_stream.stream.guard import Guard

_JSON = "application/json"

Answer = Callable[[dict[str, str]], dict[str, Any]]


class Answers:
    """Queries that wait for their answer, and the thread's work on them."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._queries: SimpleQueue[tuple[str, Any, Answer] | None] = SimpleQueue()

    def callback(self, key: str, handler: Answer) -> Callable[[Any], None]:
        """Return what zenoh is to call with queries on ``key``; it returns at once."""

        def enqueue(query: Any) -> None:
            self._queries.put((key, query, handler))

        return enqueue

    def run(self) -> None:
        """Answer until :meth:`end`."""
        while (entry := self._queries.get()) is not None:
            key, query, handler = entry
            self._guard.run(key, partial(self._answer, key, query, handler))
            del entry, query  # a query is finished for its sender when nobody holds it

    def end(self) -> None:
        """Let :meth:`run` return."""
        self._queries.put(None)

    def _answer(self, key: str, query: Any, handler: Answer) -> None:
        try:
            reply = json.dumps(handler({str(name): str(value) for name, value in query.parameters}))
        except Exception as error:
            self._guard.report(key, error)
            query.reply_err(json.dumps({"error": str(error)}), encoding=_JSON)
        else:
            query.reply(key, reply, encoding=_JSON)


def first_reply(session: Any, key: str, parameters: dict[str, str], timeout: float) -> dict[str, Any] | None:
    """Query ``key`` and return the first JSON reply, None where nobody answers within ``timeout`` seconds.

    Raises:
        TransportError: the answer is an error, or no JSON object.
    """
    import zenoh

    for reply in session.get(zenoh.Selector(key, parameters), timeout=timeout):
        if reply.ok is None:
            raise TransportError(f"{key}: the node refused: {_error_of(reply.err.payload.to_bytes())}")
        return _json_object(key, reply.ok.payload.to_bytes())
    return None


def _json_object(key: str, payload: bytes) -> dict[str, Any]:
    try:
        answer = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise TransportError(
            f"{key}: the answer is no JSON ({error}); is this a coview_stream node?"
        ) from error
    if not isinstance(answer, dict):
        raise TransportError(f"{key}: the answer is no JSON object; is this a coview_stream node?")
    return answer


def _error_of(payload: bytes) -> str:
    """Text of an error reply: the ``error`` of its JSON, or the bytes as text."""
    try:
        return str(json.loads(payload)["error"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return payload[:200].decode("utf-8", "replace")
