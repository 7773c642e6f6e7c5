"""Recording of a simulated world in MCAP: its survey, the true way with the scans, and where odometry leads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coview_stream.basemap.summary import MapView
from coview_stream.clouds.files import read_cloud
from coview_stream.clouds.trajectory import read_tum
from coview_stream.geometry.transforms import Pose, inverse
from coview_stream.messages.types import PoseMessage
from coview_stream.recordings.open_run import open_run
from coview_stream.viewers.foxglove_sink import FoxgloveSink
from coview_stream.viewers.scene import Scan


def record_world(world: Path, out: Path) -> int:
    """Write what ``simulate`` left in ``world`` as ``out`` (MCAP, Foxglove's schemas), at the run's stamps.

    ``/robots/truth`` has the true poses and each scan in the map's frame; ``/robots/odometry`` starts there and goes
    where odometry leads.

    Returns:
        Number of frames.

    Raises:
        InputError: ``out`` is there already or cannot be written.
        DependencyError: there is no foxglove-sdk.
    """
    sink = FoxgloveSink(by_stamp=True)
    sink.record(out)
    try:
        survey = read_cloud(world / "base.laz")
        sink.map(MapView.of_cloud(survey.points, survey.origin))
        run = open_run(world / "run")
        _, truth = read_tum(world / "truth.tum")
        T_map_odom = truth[0] @ inverse(run.poses[0])
        for frame, T_map_body in zip(run, truth, strict=True):
            stamp_ns = round(frame.stamp * 1e9)
            sink.pose(_pose("truth", stamp_ns, T_map_body))
            sink.pose(_pose("odometry", stamp_ns, T_map_odom @ frame.T_odom_body))
            sink.scan(Scan("truth", stamp_ns, frame.points, T_map_body))
    finally:
        sink.close()
    return len(truth)


def _pose(robot: str, stamp_ns: int, T_map_body: Pose) -> PoseMessage:
    unknown = np.full((6, 6), np.nan)
    return PoseMessage(stamp_ns, robot, "TRACKING", T_map_body, unknown, np.nan, "")
