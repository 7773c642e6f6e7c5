"""A robot that sends what a test says, as received by the doctor on a fake clock."""

import fake_robot
import numpy as np
from fake_robot import KEYS, ns

from coview_stream.doctor.capture import RobotCapture, capture_cloud, capture_odometry
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import encode_odometry
from coview_stream.messages.types import OdometryMessage, Sample

SWEEP = np.random.default_rng(1).uniform(-20.0, 20.0, (2000, 3)).astype(np.float32)


def cloud(seconds, points=SWEEP, codec="cdr", **fields):
    return fake_robot.cloud(seconds, points, codec, **fields)


def odometry(seconds, T=None, codec="json"):
    driven = seconds % 1000.0  # any clock may be asked for, but no place that is out of reach
    T = pose_from(rot_z(0.1 * driven), [2.0 * driven, 0.0, 0.0]) if T is None else T
    encoded = encode_odometry(OdometryMessage(ns(seconds), T), codec)
    return Sample(KEYS.odometry, encoded.payload, encoded.encoding, encoded.attachment)


def capture(clouds=(), odometry=(), seconds=3.0, **more):
    """A capture of messages that came at local times: pairs (time, sample)."""
    return RobotCapture(
        KEYS,
        [capture_cloud(sample, at) for at, sample in clouds],
        [capture_odometry(sample, at) for at, sample in odometry],
        ended=seconds,
        ended_ns=ns(0),
        **more,
    )


def steps(rate, seconds=3.0):
    return [k / rate for k in range(round(rate * seconds))]


def usual(cloud_shift=0.0, odometry_shift=0.0, **fields):
    """10 Hz of clouds and 50 Hz of odometry for 3 s, stamps shifted by so many seconds."""
    return capture(
        [(t + 0.05, cloud(t + cloud_shift, **fields)) for t in steps(10)],
        [(t, odometry(t + odometry_shift)) for t in steps(50)],
    )
