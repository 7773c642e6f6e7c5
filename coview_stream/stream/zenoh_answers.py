"""Answers to zenoh's queries. They are rare: one thread for all keys, which sleeps until somebody asks."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import Any

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
