"""Inboxes: in order, one at a time each, the oldest dropped, fair to others, and an error ends nothing."""

from __future__ import annotations

import logging
import threading
from typing import Any

import pytest
from sockets import until

from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.zenoh_io import THREADS, Inboxes


@pytest.fixture
def inboxes() -> Any:
    made = Inboxes(RateLimitedErrors(logging.getLogger("test")))
    threads = [threading.Thread(target=made.run) for _ in range(THREADS)]
    for thread in threads:
        thread.start()
    yield made
    made.end()
    for thread in threads:
        thread.join(5.0)
        assert not thread.is_alive()


def test_samples_come_in_order_one_at_a_time(inboxes: Inboxes) -> None:
    found: list[int] = []
    busy = threading.Lock()

    def handle(sample: int) -> None:
        assert busy.acquire(blocking=False)
        found.append(sample)
        busy.release()

    inbox = inboxes.open("a", handle, 1000)
    for k in range(500):
        inbox.put(k)
    until(lambda: len(found) == 500)
    assert found == list(range(500))


def test_of_too_many_the_newest_are_kept(inboxes: Inboxes) -> None:
    found: list[int] = []
    go = threading.Event()

    def handle(sample: int) -> None:
        go.wait(10.0)
        found.append(sample)

    inbox = inboxes.open("a", handle, 1)
    inbox.put(0)
    until(lambda: not inbox._waiting)
    for k in range(1, 10):
        inbox.put(k)
    go.set()
    until(lambda: len(found) == 2)
    assert found == [0, 9]


def test_slow_handlers_hold_up_no_others_while_a_thread_is_free_and_errors_end_nothing(inboxes: Inboxes) -> None:
    go, found = threading.Event(), []
    slow = [inboxes.open(f"slow{k}", lambda _: go.wait(10.0), 10) for k in range(THREADS - 1)]
    for each in slow:
        each.put(1)
        each.put(2)

    def handle(sample: int) -> None:
        if sample == 3:
            raise ValueError("three")
        found.append(sample)

    quick = inboxes.open("quick", handle, 10)
    for k in range(5):
        quick.put(k)
    until(lambda: found == [0, 1, 2, 4])
    go.set()


def test_closed_inbox_handles_nothing(inboxes: Inboxes) -> None:
    found: list[int] = []
    inbox = inboxes.open("a", found.append, 10)
    inbox.close()
    inbox.put(1)
    other = inboxes.open("b", found.append, 10)
    other.put(2)
    until(lambda: bool(found))
    assert found == [2]
