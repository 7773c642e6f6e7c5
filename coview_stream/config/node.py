"""Settings of the node; every default is usable as it is."""

from __future__ import annotations

from dataclasses import dataclass, field

from coview_stream.config.checks import all_positive, check_types, require
from coview_stream.config.mount import Mount

METRICS_ADDRESS = "127.0.0.1:9464"
"""Where metrics can be read over HTTP unless another address is named; the port of OpenTelemetry's exporters."""


@dataclass(frozen=True)
class NodeConfig:
    """Limits and rates of the node, in seconds, metres, Hz and bytes.

    Attributes:
        pose_rate: of the poses, while TRACKING.
        status_rate: of the statuses, besides one at every change of state.
        odometry_timeout: without odometry for this long (local time) there is no pose: LOST.
        dead_reckoning_timeout: without a usable frame for this long poses go on by odometry alone, then LOST.
        pairing_wait: a frame waits this long (local time) for the odometry around its stamp.
        odometry_history: odometry is remembered for this long (sensor time); an older frame is late.
        max_gap: odometry is interpolated between samples no farther apart than this.
        max_outage: a longer pause of odometry (sensor time) is a new beginning: the robot may have been carried.
        max_network_outage: the same where nothing was connected to the node meanwhile, which explains the pause.
        max_speed: faster motion between two odometry samples is a jump; see :mod:`coview_stream.odometry.buffer`.
        max_turn_rate: likewise for headings, radians per second, and 20 degrees.
        max_payload: a larger message is counted as oversized and not decoded.
        max_points: of a larger frame only every n-th point is used, so that no robot holds up the others.
        restart_after: stamps that run on steadily, but not from where they were, are a restarted clock after this.
        deskew: move points to the frame's stamp where the sender gives each point's time.
        mount: where the robots' lidars sit: clouds are taken from there into the body frame as they come in.
    """

    pose_rate: float = 10.0
    status_rate: float = 1.0
    odometry_timeout: float = 0.5
    dead_reckoning_timeout: float = 5.0
    pairing_wait: float = 0.3
    odometry_history: float = 5.0
    max_gap: float = 0.5
    max_outage: float = 2.0
    max_network_outage: float = 10.0
    max_speed: float = 50.0
    max_turn_rate: float = 20.0
    max_payload: int = 16 << 20
    max_points: int = 200_000
    restart_after: float = 1.0
    deskew: bool = True
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        check_types(self)
        all_positive(self, "deskew", "mount")
        require(self.pose_rate <= 200, self, "pose_rate", "at most 200 Hz")
