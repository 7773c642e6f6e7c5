"""A robot that sends what a test says, as received by the doctor on a fake clock."""

import numpy as np

from coview_stream.doctor.capture import RobotCapture, capture_cloud, capture_odometry
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage, Sample
from coview_stream.stream.transport.keys import robot_keys

KEYS = robot_keys("native", "coview", "r1")
EPOCH_NS = 1_700_000_000_000_000_000
SWEEP = np.random.default_rng(1).uniform(-20.0, 20.0, (2000, 3)).astype(np.float32)


def ns(seconds):
    return EPOCH_NS + round(seconds * 1e9)


def cloud(seconds, points=SWEEP, codec="cdr", **fields):
    encoded = encode_cloud(CloudMessage(ns(seconds), points, **fields), codec)
    return Sample(KEYS.cloud, encoded.payload, encoded.encoding, encoded.attachment)


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
