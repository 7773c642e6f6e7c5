"""All settings of the localizer."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

from coview_stream.config.checks import all_positive, check_types, counts, fraction, names_parts, positive, require

MIN_PAIRS = 50
"""Least number of pairs for a registration, and of points in a crop of the map."""

MAX_DELAY = 1.0
"""Largest delay between the clocks of clouds and odometry that is searched for, seconds."""

LEAST_RISK = 1e-6
"""Smallest risk: the model of the evidence does not resolve smaller errors."""


@dataclass(frozen=True)
class AcceptanceConfig:
    """Evidence that makes, keeps and loses a fix; docs/integrity.md has the equations.

    A place is given while the probability that it is wrong is below ``risk``, and given up once it is more probably
    wrong than right. The other limits are set by hand.

    Attributes:
        risk: integrity risk, the probability of a wrong place above which no pose is given.
        max_tilt: radians by which a pose may lean against gravity.
        max_innovation: squared Mahalanobis distance to odometry's prediction, 6 degrees of freedom, above which the
            pose is withheld. Exact covariances exceed 22 once in a thousand; ours have heavier tails.
        max_doubt_s: seconds of doubt after which the map is searched.
        max_blind_s: the same while the sensor is blind: odometry continues, and nothing contradicts the place.
    """

    risk: float = 1e-4
    max_tilt: float = math.radians(15)
    max_innovation: float = 40.0
    max_doubt_s: float = 5.0
    max_blind_s: float = 60.0

    def __post_init__(self) -> None:
        check_types(self)
        require(LEAST_RISK <= self.risk < 0.5, self, "risk", "in [1e-6, 0.5)")
        positive(self, "max_tilt", "max_innovation", "max_doubt_s", "max_blind_s")


@dataclass(frozen=True)
class RegistrationConfig:
    """Trimmed ICP (eq. 13): point-to-plane, coarse to fine.

    Points above the ground and points on it are trimmed separately, as the ground fits anywhere; ``python -m bench
    ablation --only registration`` also trims them together, and tries other values of ``keep`` and ``iterations``.

    ``inflation`` is calibrated by ``python -m bench tracking --seeds 5100``, ``shared`` by ``python -m bench
    covariance`` on kitti04 and simulated towns, with the other real runs in view. The rest is set by hand.

    Attributes:
        keep: overlap, the share of nearest pairs that the last scale keeps; the paper keeps 0.6. Earlier scales keep
            all, as far from convergence the nearest pairs support a wrong pose.
        search: largest correspondence distances of the successive scales of a search, metres, coarse to fine.
        track: likewise while tracking.
        iterations: limit per scale.
        source_voxel: metres; one point of the scan is kept per cube of this size.
        source_points: limit on the number of these points; the choice is random.
        source_range: metres from the sensor within which the scan's points are used.
        inflation: factor on the inverse Hessian's sigma, which is optimistic, as neighbouring points are not
            independent.
        shared: factor on the clustered sigma of the error shared by neighbouring registrations, as parts of map and
            scan disagree by centimetres.
        gravity_sigma: sigma of odometry's vertical, radians, for roll and pitch each; a prior of searches.
    """

    keep: float = 0.7
    search: tuple[float, ...] = (3.0, 1.5, 0.8, 0.4)
    track: tuple[float, ...] = (0.8, 0.4)
    iterations: int = 30
    source_voxel: float = 0.5
    source_points: int = 5000
    source_range: float = 50.0
    inflation: float = 3.0
    shared: float = 1.25
    gravity_sigma: float = math.radians(1.0)

    def __post_init__(self) -> None:
        check_types(self)
        fraction(self, "keep")
        counts(self, "iterations", "source_points")
        all_positive(self, "search", "track")
        for name in ("search", "track"):
            scales = getattr(self, name)
            falling = bool(scales) and all(a >= b > 0 for a, b in zip(scales, (*scales[1:], scales[-1]), strict=True))
            require(falling, self, name, "one or more positive distances, coarse to fine")


@dataclass(frozen=True)
class KeyframeConfig:
    """Keyframes: when the robot's frames become a virtual local scan, VLS (of the paper); set by hand.

    Attributes:
        distance: metres driven between keyframes, the paper's sigma_d.
        capacity: keyframes kept, which bounds memory.
        voxel: metres; one point of a frame is kept per cube of this size.
        range_min: metres; nearer points are the robot itself.
        min_points: points left that a VLS needs to vote.
    """

    distance: float = 2.0
    capacity: int = 30
    voxel: float = 0.25
    range_min: float = 0.5
    min_points: int = 300

    def __post_init__(self) -> None:
        check_types(self)
        positive(self, "distance", "voxel")
        counts(self, "capacity", "min_points")
        require(self.range_min >= 0, self, "range_min", "zero or more")


@dataclass(frozen=True)
class ConsensusConfig:
    """Consensus: the votes of keyframes for one ``T_map_odom``; set by hand.

    Attributes:
        window: newest keyframes that vote.
        peaks: best hypotheses that the likelihood field scores; above 20,000 stations their number by the co-view
            descriptors grows by the fourth root.
        distinct_distance: metres; a hypothesis farther than this from all better ones is distinct.
        distinct_yaw: radians; so is one turned by more than this.
    """

    window: int = 10
    peaks: int = 184
    distinct_distance: float = 6.0
    distinct_yaw: float = math.radians(20)

    def __post_init__(self) -> None:
        check_types(self)
        counts(self, "window", "peaks")
        positive(self, "distinct_distance", "distinct_yaw")


Reloc = Literal["auto", "coview", "learned"]
"""Place recognition: the paper's descriptors, learned features, or (auto) both where map and installation allow."""


@dataclass(frozen=True)
class LearnedConfig:
    """Search of a scan's learned features among the map's (:mod:`coview_stream.localization.search.learned`).

    Set by hand; ``python -m bench forest`` prints the places that it finds.

    Attributes:
        reach: horizontal metres around the robot's newest position within which its keyframes' points are used.
        cell: spacing in metres of the places at which features are compared with the map's.
        dense_area: square metres up to which a whole map is searched.
        shortlist: most similar tiles around which a larger map is searched.
        peaks: best places that the likelihood field scores.
    """

    reach: float = 30.0
    cell: float = 2.0
    dense_area: float = 2.0e6
    shortlist: int = 50
    peaks: int = 64

    def __post_init__(self) -> None:
        check_types(self)
        positive(self, "dense_area")
        require(5.0 <= self.reach <= 32.0, self, "reach", "5 to 32 m, half a query's image")
        require(self.cell in (1.0, 2.0, 4.0), self, "cell", "1, 2 or 4 m")
        counts(self, "shortlist", "peaks")


@dataclass(frozen=True)
class TrackingConfig:
    """Registrations while tracking: when and with which frames; and the presumed drift of odometry.

    A registration is due after ``distance``, ``turn`` or ``seconds``, and sooner if poor odometry has made the pose
    uncertain. ``seconds`` counts regardless of odometry: wheels slip, drivers hang, robots are carried.

    The newest frame is registered, with earlier ones added until there are ``min_points``. Drift smears older frames:
    ``python -m bench ablation --only localizer`` also registers those of two metres.

    Drifts are sigmas of a random walk per square root of a metre driven, from which the drift estimator starts. All
    are set by hand.

    Attributes:
        distance: metres driven.
        seconds: of sensor time.
        window: metres; no frame older than this is added once there are ``min_points``.
        min_points: see above.
        max_points: no frame is added once there are this many.
        turn: radians turned.
        position_drift: metres, each of x and y.
        height_drift: metres.
        tilt_drift: radians, each of roll and pitch.
        yaw_drift: radians.
        turn_drift: radians of yaw per radian turned.
        drift_prior: weight of these rates against the measured ones, metres of driving.
    """

    distance: float = 1.0
    seconds: float = 1.0
    window: float = 0.01
    min_points: int = 2500
    max_points: int = 50_000
    turn: float = math.radians(10)
    position_drift: float = 0.015
    height_drift: float = 0.004
    tilt_drift: float = math.radians(0.05)
    yaw_drift: float = math.radians(0.15)
    turn_drift: float = 0.02
    drift_prior: float = 6.0

    def __post_init__(self) -> None:
        check_types(self)
        all_positive(self)
        counts(self, "min_points", "max_points")


@names_parts
@dataclass(frozen=True)
class LocalizerConfig:
    """Settings of the localizer; the defaults need no change.

    Attributes:
        keyframe: selection of keyframes.
        consensus: votes of keyframes.
        registration: registration of scans to the map, and its covariance.
        acceptance: limits of a fix.
        tracking: registrations while tracking.
        learned: look-up of learned features.
        reloc: place recognition, see :data:`coview_stream.config.Reloc`; ``auto`` does without learned features where
            the map lacks them or has those of other weights.
        sensor_leans: estimate a lean of the sensor against odometry's gravity; False for odometry computed from the
            sensor's own clouds, whose frame leans with the sensor.
        cloud_delay: seconds by which clouds are stamped later than odometry, from -1 to 1, if known; start of its
            estimate. Negative where odometry is late.
        mount_drawn: heading and place of the lidar on the body are taken from a drawing; False: they are guesses (see
            :attr:`coview_stream.config.mount.Mount.drawn`), which widen covariances until motion has shown them.
    """

    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    consensus: ConsensusConfig = field(default_factory=ConsensusConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    learned: LearnedConfig = field(default_factory=LearnedConfig)
    reloc: Reloc = "auto"
    sensor_leans: bool = True
    cloud_delay: float = 0.0
    mount_drawn: bool = True

    def __post_init__(self) -> None:
        check_types(self)
        require(abs(self.cloud_delay) <= MAX_DELAY, self, "cloud_delay", "seconds, from -1 to 1")
        own_clock = self.sensor_leans or not self.cloud_delay
        require(own_clock, self, "cloud_delay", "0 where odometry is made of the clouds: it has their clock")
        known = get_args(Reloc)
        require(self.reloc in known, self, "reloc", f"one of {', '.join(known)}")
