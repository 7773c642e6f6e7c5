"""The bounded queue between network and reader."""

from __future__ import annotations

import threading

import pytest

from coview_stream.errors import ConfigError
from coview_stream.stream.client.latest_queue import LatestQueue


def test_latest_queue_keeps_order_and_drops_oldest():
    queue = LatestQueue[int](3)
    for k in range(5):
        queue.put(k)
    assert [queue.get(0), queue.get(0), queue.get(0), queue.get(0)] == [2, 3, 4, None]
    assert queue.dropped == 2


def test_close_wakes_reader_and_keeps_items():
    queue = LatestQueue[int](3)
    found: list[int | None] = [7]
    reader = threading.Thread(target=lambda: found.append(queue.get()))
    reader.start()
    queue.close()
    reader.join(5)
    assert found == [7, None]

    full = LatestQueue[int](3)
    full.put(1)
    full.close()
    full.put(2)
    assert [full.get(), full.get()] == [1, None]


def test_put_wakes_waiting_reader():
    queue = LatestQueue[int](3)
    found: list[int | None] = []
    reader = threading.Thread(target=lambda: found.append(queue.get(timeout=10)))
    reader.start()
    queue.put(4)
    reader.join(5)
    assert found == [4]


def test_latest_queue_size_is_validated():
    with pytest.raises(ConfigError, match="queue size"):
        LatestQueue[int](0)
