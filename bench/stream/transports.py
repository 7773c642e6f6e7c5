"""A cloud over ROS 2 beside zenoh: milliseconds from its publication to its points, between sessions of one process."""

from __future__ import annotations

import threading
from argparse import Namespace
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from importlib import import_module

import numpy as np

from bench.harness.rows import Row, against, medians
from bench.stream.processes import free_port
from coview_stream.errors import TransportError
from coview_stream.messages import decode_cloud, encode_cloud, ros2
from coview_stream.messages.types import CloudMessage, Encoded, Sample
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.ros2_node import message_type, start_node
from coview_stream.stream.transport.ros2_transport import Ros2Transport
from coview_stream.stream.transport.transport import Transport
from coview_stream.stream.transport.zenoh_transport import open_transport

_POINTS, _PATIENCE = 65_000, 5.0  # seconds


class _Receiver:
    """Decodes the clouds of one key."""

    def __init__(self, transport: Transport, key: str) -> None:
        self._came = threading.Event()
        transport.subscribe(key, self._take, "newest")

    def _take(self, sample: Sample) -> None:
        decode_cloud(sample, None, None, 16 << 20)
        self._came.set()

    def wait(self) -> bool:
        came = self._came.wait(_PATIENCE)
        self._came.clear()
        return came


def rows(asked: Namespace) -> Iterator[Row]:
    """Send the same bytes over either."""
    points = np.random.default_rng(0).uniform(-50.0, 50.0, (_POINTS, 3)).astype(np.float32)
    encoded: Encoded = encode_cloud(CloudMessage(0, points), "cdr")
    keys, endpoint = (
        robot_keys("native", "coview", "r1", "r1/points", "r1/odom", "r1/pose"),
        f"tcp/127.0.0.1:{free_port()}",
    )
    ros = Ros2Transport(start_node(()), [keys], check_frames=False)
    with closing(ros), closing(open_transport(listen=[endpoint])) as near, closing(open_transport([endpoint])) as far:
        sender = start_node(("-r", "__node:=sender"))
        quality = import_module("rclpy.qos").qos_profile_sensor_data
        topic = sender.create_publisher(message_type(ros2.CLOUD), "/r1/points", quality)
        publisher = far.publisher(keys.cloud, "data")
        sides = (partial(topic.publish, encoded.payload), _Receiver(ros, keys.cloud)), (
            partial(publisher.put, encoded), _Receiver(near, keys.cloud)
        )  # fmt: skip

        def send(publish: partial[None], receiver: _Receiver) -> None:
            publish()
            if not receiver.wait():
                raise TransportError(f"no cloud came within {_PATIENCE:g} s")

        while not topic.get_subscription_count():
            threading.Event().wait(0.05)
        if not far.await_subscriber(keys.cloud, _PATIENCE):
            raise TransportError("no zenoh subscriber")
        ours, baseline = medians(*(partial(send, *side) for side in sides))
        yield against("transports/65,000 points, ROS 2 beside zenoh", ours, baseline, "ms", None)
        sender.destroy_node()
        sender.context.try_shutdown()
