"""The watchdog: acts on what takes too long, and on nothing else."""

from __future__ import annotations

import threading

from sockets import until

from coview_stream.stream.node.watchdog import Watchdog


def names():
    return [thread.name for thread in threading.enumerate()]


def test_watchdog_acts_after_the_limit():
    freed = threading.Event()
    dog = Watchdog("coview-test-dog", freed.set)
    with dog.limit(60.0):
        pass
    assert not dog.acted
    with dog.limit(0.05):  # while its thread sleeps until the deadline before
        assert freed.wait(10.0)
    assert dog.acted
    dog.close()
    until(lambda: "coview-test-dog" not in names())


def test_watchdog_ignores_calls_within_limit():
    calls = []
    dog = Watchdog("coview-test-dog", lambda: calls.append(1))
    for _ in range(3):
        with dog.limit(0.02):
            pass
    with dog.limit(60.0):  # longer than all the limits before
        threading.Event().wait(0.1)
    assert calls == []
    with dog.limit(0.01):
        until(lambda: calls)
    with dog.limit(60.0):
        assert not dog.acted
    assert calls == [1]
    dog.close()
