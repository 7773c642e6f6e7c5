"""Runs: a robot's frames with their odometry, read one at a time."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, SupportsIndex, overload

import numpy as np

from coview_stream.clouds.cloud import Cloud
from coview_stream.clouds.files import read_cloud
from coview_stream.config.mount import Mount
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, Poses, interpolate
from coview_stream.odometry.deskew import SweepCorrection
from coview_stream.recordings.layouts import Layout


@dataclass(frozen=True, eq=False)
class Frame:
    """One scan of a run.

    Attributes:
        index: position in the run, from 0.
        stamp: seconds.
        points: (N, 3) float32 in the body frame (x forward, z up), metres, relative to ``origin``.
        T_odom_body: (4, 4), odometry <- body.
        origin: (3,) float64 metres. Zeros, except for a single terrestrial scan in map-like coordinates.
        path: source file.
        dropped: unusable rows of the file.
    """

    index: int
    stamp: float
    points: Points
    T_odom_body: Pose
    origin: Floats
    path: Path
    dropped: int = 0

    def __repr__(self) -> str:
        """Return index, stamp, size and file in one line."""
        return f"Frame({self.index}: {self.stamp:.3f} s, {len(self.points):,} points, {self.path.name!r})"


class CloudSource(Protocol):
    """Reader for a run's clouds that are not in one file each."""

    def read(self, index: int, correction: SweepCorrection | None = None) -> Cloud:
        """Read frame ``index`` in the body frame at its stamp, metres; CloudError if it is damaged."""
        ...


@dataclass(frozen=True, eq=False)
class _SelectedClouds:
    """The clouds ``indices`` of a source."""

    source: CloudSource
    indices: range

    def read(self, index: int, correction: SweepCorrection | None = None) -> Cloud:
        return self.source.read(self.indices[index], correction)


@dataclass(frozen=True, eq=False)
class Run:
    """A validated run. Iteration reads lazily: one frame is in memory at a time.

    ``run[3]`` reads a frame, ``run[-1]`` the last one; ``run[10:20]`` and ``run[::5]`` are runs of these frames,
    numbered from zero.

    Attributes:
        path: the directory, the single cloud file, or the recording.
        frames_paths: (N) files in order; for a recording its path, N times.
        stamps: (N,) seconds, strictly increasing.
        poses: (N, 4, 4), odometry <- body, metres.
        source: reads the clouds of a recording; None if each is a file.
        notes: frames left out and assumptions made when the run was opened, one line each.
        mount: pose of the lidar, whose clouds are read into the body frame; None if the body is the lidar.
    """

    path: Path
    frames_paths: tuple[Path, ...]
    stamps: Floats
    poses: Poses
    source: CloudSource | None = None
    notes: tuple[str, ...] = ()
    mount: Mount | None = None

    def __len__(self) -> int:
        return len(self.frames_paths)

    @property
    def interval(self) -> float:
        """Median time from one frame to the next, seconds; NaN of a single frame."""
        return float(np.median(np.diff(self.stamps))) if len(self) > 1 else float("nan")

    @property
    def stamp_unit(self) -> str:
        """Unit that the stamps seem to have; seconds, unless ten milliseconds or more, as numbers, lie between them."""
        units = ((1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds"))
        return next((name for factor, name in units if self.interval > factor * 1e-2), "seconds")

    def __iter__(self) -> Iterator[Frame]:
        """Yield every frame in order; raises like ``read``, so use ``read`` to skip a damaged frame."""
        return (self.read(index) for index in range(len(self)))

    @overload
    def __getitem__(self, index: SupportsIndex) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> Run: ...

    def __getitem__(self, index: SupportsIndex | slice) -> Frame | Run:
        """Read one frame (negative: from the end), or return the run of a slice; RunError if empty or backwards."""
        if not isinstance(index, slice):
            at = operator.index(index)
            return self.read(at + len(self) if -len(self) <= at < 0 else at)
        indices = range(len(self))[index]
        if not indices or indices.step < 0:
            fault = "goes backwards" if indices else "holds no frame"
            part = f"{index.start}:{index.stop}:{index.step}"
            raise RunError(f"{self.path}: the slice {part} of {len(self)} frames {fault}")
        source = None if self.source is None else _SelectedClouds(self.source, indices)
        files, stamps, poses = self.frames_paths[index], self.stamps[index], self.poses[index]
        return replace(self, frames_paths=files, stamps=stamps, poses=poses, source=source)

    def with_late_clouds(self, delay: float) -> Run:
        """Return the run with each frame at the stamp and odometry ``delay`` seconds earlier, when it was measured.

        Frames before the first odometry or after the last are left out; RunError if none remains.
        """
        stamps = self.stamps - delay
        first, end = np.searchsorted(stamps, self.stamps[0]), np.searchsorted(stamps, self.stamps[-1], "right")
        if len(self) < 2 or not delay:
            return self
        if first >= end:
            lasts = self.stamps[-1] - self.stamps[0]
            raise RunError(f"{self.path}: the clouds' delay, {abs(delay):g} s, is longer than the run, {lasts:.1f} s")
        stamps = stamps[first:end]
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self) - 1)
        share = (stamps - self.stamps[after - 1]) / (self.stamps[after] - self.stamps[after - 1])
        poses = interpolate(self.poses[after - 1], self.poses[after], share)
        return replace(self[int(first) : int(end)], stamps=stamps, poses=poses)

    def __repr__(self) -> str:
        """Return path, number of frames, duration and distance in one line."""
        driven = float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum())
        return (
            f"Run({str(self.path)!r}: {len(self)} frames, {self.stamps[-1] - self.stamps[0]:.1f} s, "
            f"{driven:.1f} m driven)"
        )

    def read(self, index: int, correction: SweepCorrection | None = None) -> Frame:
        """Read frame ``index``; a recording's raw sweep is deskewed by odometry with ``correction`` applied.

        Raises:
            IndexError: there is no such frame.
            CloudError: the file is unreadable, has no usable point, or is not in the body frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path}: no frame {index} among {len(self)}")
        path = self.frames_paths[index]
        cloud = read_cloud(path) if self.source is None else self.source.read(index, correction)
        if len(self) > 1 and cloud.origin.any():
            raise CloudError(
                f"{path}: coordinates near {cloud.origin.tolist()} cannot be in the body frame: millimetres, or in a "
                "map's frame; write frames relative to the sensor, in metres"
            )
        points = cloud.points
        if self.mount is not None and self.source is None:
            if cloud.origin.any():
                raise CloudError(f"{path}: is in map-like coordinates, not the sensor's; leave --mount out")
            points = self.mount.to_body(points)
        return Frame(index, float(self.stamps[index]), points, self.poses[index], cloud.origin, path, cloud.dropped)


def single_frame_run(layout: Layout, mount: Mount | None = None) -> Run:
    """Return a run of one frame; it needs no odometry."""
    return Run(layout.path, layout.frames, np.zeros(1), np.eye(4)[None], mount=mount)
