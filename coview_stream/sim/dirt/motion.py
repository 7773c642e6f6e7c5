"""Motion during a sweep: beams leave one after the other while the robot drives and turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats, Indices
from coview_stream.geometry.transforms import Points, Poses, interpolate, inverse
from coview_stream.odometry.buffer import Segment
from coview_stream.odometry.deskew import deskew
from coview_stream.sim.dirt.ranges import within
from coview_stream.sim.sensors import FRAME_PERIOD

_STEPS = 200  # true poses along a sweep: every 0.5 ms; set by hand
_NS = 1e9


@dataclass(frozen=True)
class Motion:
    """Raw sweeps: each lasts from one stamp to the next and bears the stamp of its end.

    Attributes:
        rate: samples of odometry a second, by which the sweeps are deskewed.
        deskewed: whether the frames are deskewed, by the product's own code; if not they stay bent.

    Raises:
        ConfigError: a value out of its range.
    """

    rate: float = 50.0
    deskewed: bool = True

    def __post_init__(self) -> None:
        within(self, rate=(10.0, 1000.0))


class Track:
    """Smooth motion through the poses of a run's frames, true and as odometry has it.

    The robot is where the frames' poses say at their stamps, and moves smoothly between them; what odometry gets
    wrong grows evenly from frame to frame.
    """

    def __init__(self, stamps: Floats, T_scene_body: Poses, T_odom_body: Poses) -> None:
        """Lay the track through (N,) stamps in seconds and (N, 4, 4) poses; it begins a frame before the first."""
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        before = T_scene_body[0]
        if len(stamps) > 1:
            before = T_scene_body[0] @ inverse(T_scene_body[1]) @ T_scene_body[0]
        self.stamps = stamps
        self.odometry = T_odom_body
        self._at: Floats = np.concatenate([stamps[:1] - FRAME_PERIOD, stamps])
        poses = np.concatenate([before[None], T_scene_body])
        self._positions = CubicSpline(self._at, poses[:, :3, 3])
        self._rotations = RotationSpline(self._at, Rotation.from_matrix(poses[:, :3, :3]))
        wrong = np.stack([odom @ inverse(true) for odom, true in zip(T_odom_body, T_scene_body, strict=True)])
        self._wrong = np.concatenate([wrong[:1], wrong])

    def true(self, stamps: Floats) -> Poses:
        """Return ``T_scene_body`` (M, 4, 4) at (M,) seconds."""
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3, :3] = self._rotations(stamps).as_matrix()
        poses[:, :3, 3] = self._positions(stamps)
        return poses

    def odom(self, stamps: Floats) -> Poses:
        """Return ``T_odom_body`` (M, 4, 4) at (M,) seconds."""
        k = np.clip(np.searchsorted(self._at, stamps, side="right") - 1, 0, len(self._at) - 2)
        share = (stamps - self._at[k]) / (self._at[k + 1] - self._at[k])
        return np.asarray(interpolate(self._wrong[k], self._wrong[k + 1], share) @ self.true(stamps))

    def along(self, frame: int, times: Floats) -> tuple[Poses, Indices]:
        """Return true poses (K, 4, 4) along a sweep, and which of them each of (N,) times after its stamp has."""
        grid = np.linspace(-FRAME_PERIOD, 0.0, _STEPS)
        nearest = np.rint((times + FRAME_PERIOD) * ((_STEPS - 1) / FRAME_PERIOD)).astype(np.intp)
        return self.true(self.stamps[frame] + grid), np.clip(nearest, 0, _STEPS - 1)

    def segment(self, frame: int, rate: float) -> Segment:
        """Return the odometry of a sweep, ``rate`` samples a second."""
        count = round(FRAME_PERIOD * rate) + 1
        stamps = self.stamps[frame] + np.linspace(-FRAME_PERIOD, 0.0, count)
        return Segment(np.rint(stamps * _NS).astype(np.int64), self.odom(stamps))

    def straightened(self, frame: int, points: Points, times: Floats, rate: float) -> Points:
        """Deskew a sweep's points (N, 3) by the odometry, as a node does."""
        stamp_ns = round(float(self.stamps[frame]) * _NS)
        return deskew(points, times, self.segment(frame, rate), stamp_ns, self.odometry[frame])


def beam_times(count: int) -> Floats:
    """Return (N,) seconds from a frame's stamp, the sweep's end, to each of its beams: beams come in that order."""
    return np.asarray((np.arange(1, count + 1) / count - 1.0) * FRAME_PERIOD)
