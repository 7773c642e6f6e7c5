"""Check of silent subscriptions: another session listens, and what it hears ours should have heard.

Zenoh's messages over plain TCP carry no checksum: a flipped bit in a declaration leaves a session that is connected and
yet hears nothing on a key, for good. Silence alone tells nothing, for a robot may be switched off; a second session
that hears something on the same key meanwhile does.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

from coview_stream.stream.transport.error_guard import RateLimitedErrors

_SILENT = 5.0  # seconds without a sample, after which a key is listened to by another session; set by hand
_LONGEST = 300.0  # seconds between two such checks of one key, which follow each other at twice the time each
_LISTEN = 1.5  # seconds that the other session listens
_GRACE = 1.0  # seconds more for ours to hear what the other one heard
_LOOK = 0.5  # seconds between two looks at the clock

Listen = Callable[[Collection[str], float], set[str]]
"""Open another session, listen to keys for at most so many seconds, and return those on which something came."""


@dataclass
class Subscription:
    """What is known of one subscription.

    Attributes:
        key: key expression.
        heard: monotonic time of the last sample.
        due: monotonic time of the next check, should it stay silent.
        wait: seconds from that check to the next.
        handling: whether the handler is at work now, which may take any time.
    """

    key: str
    heard: float
    due: float = 0.0
    wait: float = _SILENT
    handling: bool = False


class SubscriptionCheck:
    """All subscriptions of a session, and the work of the thread that checks those that are silent.

    Args:
        listen: see :data:`Listen`.
        reopen: opens the session anew, with all that was declared on it.
        guard: logs what goes wrong, which must not end the checks.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        listen: Listen,
        reopen: Callable[[str], None],
        guard: RateLimitedErrors,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._guard = guard
        self._listen = listen
        self._reopen = reopen
        self._clock = clock
        self._all: list[Subscription] = []
        self._next = clock()  # no other session is opened before

    def add(self, key: str) -> Subscription:
        """Begin with a subscription; its owner says by :meth:`heard` when a sample comes."""
        found = Subscription(key, self._clock(), self._clock() + _SILENT)
        self._all.append(found)
        return found

    def remove(self, subscription: Subscription) -> None:
        """Check a subscription no more."""
        self._all = [each for each in self._all if each is not subscription]

    def heard(self, subscription: Subscription) -> None:
        """Note a sample."""
        subscription.heard = self._clock()
        subscription.wait = _SILENT
        subscription.due = subscription.heard + _SILENT

    def run(self, stopping: threading.Event) -> None:
        """Check what is silent until ``stopping``."""
        while not stopping.wait(_LOOK):
            with self._guard.catch("subscription check"):
                self.check(stopping.wait)

    def check(self, wait: Callable[[float], object]) -> None:
        """Check what is silent and due now; ``wait(seconds)`` passes time."""
        begin = self._clock()
        silent = [each for each in self._all if begin - each.heard >= _SILENT and not each.handling]
        if begin < self._next or not any(begin >= each.due for each in silent):
            return
        # those that are due soon as well: a hundred robots that are switched off are one session now and then
        silent = [each for each in silent if begin >= each.due - 0.5 * each.wait]
        self._next = begin + _SILENT
        for each in silent:
            each.wait = min(2.0 * each.wait, _LONGEST)
            each.due = begin + _LISTEN + _GRACE + each.wait
        there = self._listen({each.key for each in silent}, _LISTEN)
        if not there:
            return
        wait(_GRACE)
        deaf = [each.key for each in silent if each.key in there and each.heard < begin and not each.handling]
        if deaf:
            self._reopen(", ".join(sorted(deaf)))
