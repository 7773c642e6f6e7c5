"""What a job came to, told to the session that it was of."""

from __future__ import annotations

from coview_stream.decision import Verdict
from coview_stream.stream.jobs import FrameJob, FrameResult, Job, Result, SearchJob, SweepJob, SweepResult
from coview_stream.stream.lane import DiedError, FailedError, RejectedError
from coview_stream.stream.lidar_session import LidarSession
from coview_stream.stream.session import Session


def take_sweep(session: Session) -> SweepJob | None:
    """Hand out a frame to make odometry of, for a robot that sends none."""
    return session.take_sweep() if isinstance(session, LidarSession) else None


def tell_done(session: Session, job: Job, result: Result, now: float) -> None:
    """Hand a result over at local time ``now``."""
    if isinstance(job, FrameJob) and isinstance(result, FrameResult):
        session.frame_done(job, result, now)
    elif isinstance(job, SearchJob) and isinstance(result, Verdict):
        session.search_done(job, result)
    elif isinstance(job, SweepJob) and isinstance(result, SweepResult) and isinstance(session, LidarSession):
        session.sweep_done(job, result, now)


def tell_failed(session: Session, job: Job, error: Exception) -> None:
    """Say that there is no result, and whether the engine is as good as before (RejectedError)."""
    reason = str(error) if isinstance(error, (RejectedError, FailedError, DiedError)) else repr(error)
    rejected = isinstance(error, RejectedError)
    if isinstance(job, FrameJob):
        session.frame_failed(job, reason, rejected)
    elif isinstance(job, SearchJob):
        session.search_failed(job, reason)
    elif isinstance(session, LidarSession):
        session.sweep_failed(job, reason, rejected)
