"""A robot on a fake clock: its messages, and an engine's answers without an engine."""

import struct
from dataclasses import replace

import numpy as np

from coview_stream.config import TrackingConfig
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.state import Event, State
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.tracking.motion import Drift
from coview_stream.messages import encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage, Sample
from coview_stream.stream.node.engine_queue import FrameResult
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.keys import robot_keys

START_NS = 1_700_000_000_000_000_000
KEYS = robot_keys("native", "coview", "r1")
POINTS = np.arange(36, dtype=np.float32).reshape(12, 3)
SHA = "ab" * 32
T_MAP_ODOM = pose_from(rot_z(0.5), [100.0, -20.0, 3.0])
DRIFT = Drift.of(TrackingConfig())
ENDS = (
    "processed",
    "rejected",
    "dropped",
    "late",
    "out_of_order",
    "duplicate",
    "no_odometry",
    "malformed",
    "oversized",
    "unknown_encoding",
    "engine_errors",
)
"""Counters of which every received cloud ends as one."""
EVENTS = {
    State.SEARCHING: (Event.NO_PLACE,),
    State.AMBIGUOUS: (Event.PLACE_PROPOSED,),
    State.TRACKING: (Event.PLACE_ACCEPTED, Event.MATCH_VERIFIED),
    State.DOUBTED: (Event.PLACE_ACCEPTED, Event.MATCH_REJECTED),
    State.LOST: (Event.PLACE_ACCEPTED, Event.PLACE_GIVEN_UP),
}
"""Events that lead to a state, with or without a place before."""


def ns(seconds):
    return START_NS + round(seconds * 1e9)


def pose(x=0.0, y=0.0, yaw=0.0):
    return pose_from(rot_z(yaw), [x, y, 0.0])


def message(seconds, x=None, y=0.0, yaw=0.0):
    """Odometry of a robot that drives 2 m/s along x unless told otherwise."""
    return OdometryMessage(ns(seconds), pose(2.0 * seconds if x is None else x, y, yaw))


def odometry(seconds, *place, keys=KEYS, **more):
    encoded = encode_odometry(message(seconds, *place, **more), "json")
    return Sample(keys.odometry, encoded.payload, encoded.encoding, encoded.attachment)


def cloud(seconds, points=POINTS, codec="xyz", keys=KEYS, attachment=None, **fields):
    encoded = encode_cloud(CloudMessage(ns(seconds), points, **fields), codec)
    return Sample(keys.cloud, encoded.payload, encoded.encoding, attachment or encoded.attachment)


def search_request(seconds=0.0):
    return SearchRequest(seconds, np.eye(4), POINTS, POINTS, POINTS)


def search_result(seconds=0.0, reason="two places fit", accepted=None):
    return SearchResult(accepted, KeyframeEvidence(seconds, State.AMBIGUOUS, reason))


def tracking(job, T_map_odom=T_MAP_ODOM, sigma=0.1, drift=DRIFT, covariance=None, protection=None):
    """The engine's answer: here you are."""
    evidence = KeyframeEvidence(job.stamp_ns * 1e-9, State.TRACKING, "verified", 0.8)
    covariance = np.eye(6) * sigma**2 if covariance is None else covariance
    stamp = job.stamp_ns * 1e-9
    T = T_map_odom @ job.T_odom_body
    fix = Fix(stamp, State.TRACKING, T, T_map_odom, covariance, 0.8, evidence, drift, protection)
    return FrameResult(fix, None, 0.01, EVENTS[State.TRACKING])


def unknown(job, state=State.SEARCHING, reason="no place fits", ask=None):
    """The engine's answer: no idea."""
    evidence = KeyframeEvidence(job.stamp_ns * 1e-9, state, reason)
    request = None if ask is None else replace(ask, epoch=(job.epoch, 1))
    return FrameResult(Fix(job.stamp_ns * 1e-9, state, evidence=evidence), request, 0.01, EVENTS[state])


def doubted(job, cause=RejectionReason.BLIND, reason="only 0 points to register"):
    """The engine's answer: here you were, but this frame does not show it."""
    evidence = KeyframeEvidence(job.stamp_ns * 1e-9, State.DOUBTED, reason, cause=cause)
    fix = Fix(job.stamp_ns * 1e-9, State.DOUBTED, evidence=evidence)
    return FrameResult(fix, None, 0.01, EVENTS[State.DOUBTED])


class Robot:
    """A session, and the local clock that its messages come by (sensor time plus a delay)."""

    def __init__(self, config=None, **more):
        self.session = Session(KEYS, SHA, config, **more)
        self.now = 1000.0

    @property
    def counters(self):
        return self.session.counters

    def moved(self, seconds, now=None, **place):
        """Odometry of a sensor time; local time runs along."""
        self.now = 1000.0 + seconds if now is None else now
        self.session.on_odometry(odometry(seconds, **place), self.now)

    def saw(self, seconds, now=None, **fields):
        self.now = 1000.0 + seconds if now is None else now
        self.session.on_cloud(cloud(seconds, **fields), self.now)

    def job_for(self, seconds, **fields):
        """Send a cloud of a sensor time; return the job that waits for the engine then."""
        self.saw(seconds, **fields)
        return self.session.take_job("track")

    def drive(self, begin, end, rate=20.0, **place):
        """Odometry at a steady rate from ``begin`` up to and including ``end``."""
        for k in range(round((end - begin) * rate) + 1):
            self.moved(begin + k / rate, **place)

    def frame(self, seconds, answer=tracking, **more):
        """A cloud between odometry samples, taken by the engine and answered."""
        self.moved(seconds - 0.01)
        self.saw(seconds)
        self.moved(seconds + 0.01)
        return self.answered(answer, **more)

    def answered(self, answer=tracking, now=None, **more):
        """Have the engine take the newest frame and answer it."""
        job = self.session.take_job("track")
        assert job is not None
        self.session.handle_result(job, answer(job, **more), self.now if now is None else now)
        return job

    def localized(self, seconds=0.0, **more):
        """Bring the session to TRACKING by a frame at ``seconds``."""
        self.frame(seconds, **more)
        assert self.session.pose() is not None
        return self


def ends(counters):
    return sum(getattr(counters, name) for name in ENDS)


def numbered(sequence, seconds):
    """rmw_zenoh's attachment."""
    return struct.pack("<qqB16s", sequence, ns(seconds), 16, bytes(16))


def reason(robot):
    return robot.session.state()[1]


def state(robot):
    return robot.session.state()[0]


def counted(robot):
    """Counters that are not zero."""
    return {name: count for name, count in robot.counters.to_json().items() if count}
