"""Recorded runs: directories, ROS recordings and single clouds as sequences of frames with odometry."""

from __future__ import annotations

from coview_stream.recordings.open_run import open_run
from coview_stream.recordings.run import Frame, Run

__all__ = ["Frame", "Run", "open_run"]
