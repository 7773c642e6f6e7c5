"""Registrations that need no kiss-icp, and frames whose motion is known."""

import numpy as np
import small_world

from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform


class Told:
    """Answers with poses that the test has written down, and remembers what it was asked."""

    def __init__(self, *poses):
        self.poses = list(poses)
        self.frames = []
        self.guesses = []
        self.clears = 0

    def register(self, points, guess):
        self.frames.append(points)
        self.guesses.append(guess)
        return self.poses.pop(0) if self.poses else guess

    def clear(self):
        self.clears += 1


class Truth(Told):
    """Answers with the true motion since the first frame, in the frame that the first guess spans."""

    def __init__(self, T_map_body):
        super().__init__()
        self.truth = list(T_map_body)

    def register(self, points, guess):
        super().register(points, guess)
        return self.guesses[0] @ inverse(self.truth[0]) @ self.truth[len(self.guesses) - 1]


def frame(scene, tilt=(0.0, 0.0)):
    """A scan of the small world by a sensor that leans (roll, pitch), and its true up in the body frame."""
    roll, pitch = tilt
    lean = pose_from(_about(1, pitch) @ _about(0, roll), [0, 0, 0])
    T = small_world.drive()[0] @ lean
    return small_world.scan(scene, T), T[2, :3]


def swept(cloud, T_begin_end, seconds=0.1):
    """The cloud as a sweep that ends at the stamp sees it, turning clockwise; and the times, before the stamp."""
    share = (np.arctan2(-cloud[:, 1], cloud[:, 0]) / (2 * np.pi)) % 1.0
    steps = np.round(share * 200).astype(int)
    seen = np.empty_like(cloud)
    yaw = np.arctan2(T_begin_end[1, 0], T_begin_end[0, 0])
    for k in range(201):
        back = 1.0 - k / 200  # what is still to be driven
        T = pose_from(rot_z(-back * yaw), -back * T_begin_end[:3, 3])
        seen[steps == k] = transform(inverse(T), cloud[steps == k])
    return seen, (steps / 200 - 1.0) * seconds


def _about(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[a, a] = R[b, b] = c
    R[a, b], R[b, a] = -s, s
    return R
