"""Clouds of a recording, read when they are asked for and deskewed by its odometry."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.bag_reader import BagReader, explained, header_stamp
from coview_stream.clouds.cloud import ABSURD, Cloud, CloudBuilder
from coview_stream.clouds.track import StampsNs, Track
from coview_stream.clouds.trajectory import Poses
from coview_stream.errors import CloudError, MessageError
from coview_stream.geometry import Points
from coview_stream.stream.codecs import ros2
from coview_stream.stream.deskew import deskew
from coview_stream.stream.messages import CloudMessage, Sample

_NS = 1e-9


class BagClouds:
    """Clouds of a recording by index; in order, the recording is read once, and otherwise sought by arrival."""

    def __init__(
        self, reader: BagReader, topic: str, stamps: StampsNs, arrivals: StampsNs, track: Track, poses: Poses
    ) -> None:
        self.reader, self.topic, self.track = reader, topic, track
        self.stamps, self.arrivals, self.poses = stamps, arrivals, poses
        self._lock = threading.Lock()  # a replay reads on another thread
        self._coming: Iterator[tuple[str, int, bytes]] = iter(())
        self._next = -1

    def read(self, index: int) -> Cloud:
        """Frame ``index`` in the body frame at its stamp; CloudError if it is damaged or holds no usable point."""
        message = self.message(index)
        # false for NaN as well
        usable: npt.NDArray[np.bool_] = np.all(np.abs(message.points) < ABSURD, axis=1)
        builder = CloudBuilder(dropped=int((~usable).sum()))
        builder.add(self._deskewed(index, message, usable))
        return builder.finish(self._name(index))

    def message(self, index: int) -> CloudMessage:
        """Frame ``index`` as it was recorded; CloudError if it is damaged."""
        name = self._name(index)
        with self._lock, explained(name, CloudError):
            payload = self._payload(index)
        try:
            return ros2.decode_cloud(Sample(self.topic, payload))
        except MessageError as error:
            raise CloudError(f"{name}: {error}; skip it, or repair the recording") from error

    def _name(self, index: int) -> str:
        return f"{self.reader.path}: cloud of {self.topic} at {_NS * int(self.stamps[index]):.6f}"

    def _payload(self, index: int) -> bytes:
        reads_on = index == self._next and self.arrivals[index] > self.arrivals[index - 1]
        self._next = -1  # should this fail, the next one is sought
        for _ in range(2):
            if not reads_on:
                start = int(self.arrivals[index])
                self._coming = self.reader.messages({self.topic: ros2.CLOUD}, start)
            for _, arrived, payload in self._coming:
                if arrived == self.arrivals[index] and _is_of(payload, int(self.stamps[index])):
                    self._next = index + 1
                    return payload
            reads_on = False
        raise ValueError("it is not there any more")

    def _deskewed(self, index: int, message: CloudMessage, usable: npt.NDArray[np.bool_]) -> Points:
        points = message.points[usable]
        if message.times is None or not len(points):
            return points
        stamp, times = message.stamp_ns, message.times[usable]
        begin, end = (stamp + round(t / _NS) for t in (min(0.0, times.min()), max(0.0, times.max())))
        return deskew(points, times, self.track.around(begin, end, stamp), stamp, self.poses[index])


def _is_of(payload: bytes, stamp_ns: int) -> bool:
    try:
        return header_stamp(payload) == stamp_ns
    except MessageError:
        return False
