"""Settings of the node; every default is usable as it is."""

from __future__ import annotations

from dataclasses import dataclass, field

from coview_stream.config.checks import all_positive, check_types, require
from coview_stream.config.mount import Mount

METRICS_ADDRESS = "127.0.0.1:9464"
"""Default HTTP address of the metrics; the port of OpenTelemetry's exporters."""


@dataclass(frozen=True)
class NodeConfig:
    """Limits and rates of the node, in seconds, metres, Hz and bytes.

    Attributes:
        pose_rate: rate of the poses, while TRACKING.
        status_rate: rate of the statuses; every change of state sends one more.
        odometry_timeout: without odometry for this long (local time) there is no pose: LOST.
        dead_reckoning_timeout: without a usable frame for this long poses go on by odometry alone, then LOST.
        pairing_wait: a frame waits this long (local time) for the odometry around its stamp.
        odometry_history: odometry is remembered for this long (sensor time); an older frame is late.
        max_gap: odometry is interpolated between samples no farther apart than this.
        max_outage: a longer pause of odometry (sensor time) is a new beginning: the robot may have been carried.
        max_speed: metres per second; faster motion between two odometry samples is a jump.
        max_payload: a larger message is counted as oversized and not decoded.
        max_points: a larger frame is thinned to every n-th point: no robot holds up the others.
        restart_after: a jump of the stamps is a restarted clock once they have run on steadily for this long.
        deskew: move points to the frame's stamp where the sender gives each point's time.
        mount: pose of the robots' lidars on the body; clouds are moved into the body frame on arrival.
    """

    pose_rate: float = 10.0
    status_rate: float = 1.0
    odometry_timeout: float = 0.5
    dead_reckoning_timeout: float = 5.0
    pairing_wait: float = 0.3
    odometry_history: float = 5.0
    max_gap: float = 0.5
    max_outage: float = 2.0
    max_speed: float = 50.0
    max_payload: int = 16 << 20
    max_points: int = 200_000
    restart_after: float = 1.0
    deskew: bool = True
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        check_types(self)
        all_positive(self, "deskew", "mount")
        require(self.pose_rate <= 200, self, "pose_rate", "at most 200 Hz")
