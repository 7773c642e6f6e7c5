"""Free memory goes back to the system, once in a while."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from coview_stream.stream.node import memory
from coview_stream.stream.node.memory import PERIOD, MemoryRelease

FRAGMENTED = """
import re
from coview_stream.stream.node.memory import release_free_memory

def megabytes():
    return int(re.search(r"Anonymous:\\s+(\\d+)", open("/proc/self/smaps_rollup").read())[1]) / 1024

blocks = [bytearray(b"x" * 100_000) for _ in range(3000)]
last = blocks[-1]
before = megabytes()
del blocks
kept = megabytes()
release_free_memory()
print(before, kept, megabytes())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_free_memory_goes_back():
    done = subprocess.run([sys.executable, "-c", FRAGMENTED], capture_output=True, text=True, check=True)
    before, kept, after = map(float, done.stdout.split())
    assert before > 250.0
    if kept > before - 100.0:  # as glibc does
        assert after < before - 200.0


def test_it_is_released_no_more_often_than_once_a_period():
    now, calls = [0.0], []
    release = MemoryRelease(lambda: calls.append(now[0]), lambda: now[0])
    for _ in range(1000):
        now[0] += 0.25
        release.when_due()
    assert calls == [PERIOD, 2 * PERIOD, 3 * PERIOD, 4 * PERIOD]


def test_it_goes_on_until_it_is_stopped(monkeypatch):
    monkeypatch.setattr(memory, "PERIOD", 0.01)
    stopping, calls = threading.Event(), []

    def release():
        calls.append(1)
        if len(calls) == 3:
            stopping.set()

    MemoryRelease(release).run(stopping)
    assert len(calls) == 3
