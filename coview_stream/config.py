"""Configuration: frozen dataclasses with validated ranges, paper defaults and named presets.

Lengths in metres, angles in radians. What shapes the map's descriptors (:class:`DescriptorConfig`) is stored in
the map and read back from it, so that the two can never drift apart; the rest belongs to the localizer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from coview_stream.errors import ConfigError

Channel = Literal["scan_context", "coview", "coview_strict", "density"]
Visibility = Literal["paper", "eye", "off"]
Preset = Literal["slam", "tls"]
GraphBackend = Literal["auto", "gtsam", "numpy"]
RegistrationMethod = Literal["trimmed-icp", "gicp"]


def _require(ok: bool, config: object, name: str, allowed: str) -> None:
    if not ok:
        value = getattr(config, name)
        raise ConfigError(f"{name} is {value!r}; it must be {allowed} ({type(config).__name__}.{name})")


def _positive(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        _require(math.isfinite(value) and value > 0, config, name, "a positive, finite number")


def _counts(config: object, *names: str, least: int = 1) -> None:
    for name in names:
        value = getattr(config, name)
        _require(isinstance(value, int) and value >= least, config, name, f"a whole number >= {least}")


def _fraction(config: object, *names: str) -> None:
    for name in names:
        _require(0 < getattr(config, name) <= 1, config, name, "in (0, 1]")


@dataclass(frozen=True)
class DescriptorConfig:
    """How a virtual scan becomes a polar descriptor (paper, section 3.2, eqs 1-4).

    ``channels`` names the descriptors that vote together: ``scan_context`` is the maximum height of every bin,
    ``coview`` keeps what both views can see (eqs 1-3: horizontally visible, or dense), ``coview_strict`` only
    what is horizontally visible, ``density`` the number of voxels in a bin (eq. 3). Measured: unlike views
    (airborne map) favour co-visibility, like views favour Scan Context, the two together are right on both.
    """

    radius: float = 50.0
    rings: int = 20
    sectors: int = 60
    channels: tuple[Channel, ...] = ("scan_context", "coview")
    visibility: Visibility = "paper"
    eye: float = 1.5
    voxel: float = 0.5
    ground_zero: bool = True

    def __post_init__(self) -> None:
        _positive(self, "radius", "eye", "voxel")
        _require(self.radius <= 1000, self, "radius", "at most 1000 m")
        _counts(self, "rings", "sectors", least=4)
        known = get_args(Channel)
        _require(
            bool(self.channels) and set(self.channels) <= set(known), self, "channels", f"some of {known}"
        )
        _require(len(set(self.channels)) == len(self.channels), self, "channels", "without repetition")
        _require(self.visibility in get_args(Visibility), self, "visibility", "paper, eye or off")


@dataclass(frozen=True)
class MapConfig:
    """How a base map is built (paper, section 3.1)."""

    descriptor: DescriptorConfig = field(default_factory=DescriptorConfig)
    block: float = 2.0
    voxel: float = 0.25
    tile: float = 20.0
    outlier_neighbours: int = 12
    outlier_std_ratio: float = 4.0
    normal_radius: float = 1.0
    normal_neighbours: int = 20
    levels: bool = True

    def __post_init__(self) -> None:
        _positive(self, "block", "voxel", "tile", "outlier_std_ratio", "normal_radius")
        _counts(self, "outlier_neighbours", least=0)
        _counts(self, "normal_neighbours", least=3)
        halves = self.block / 0.5  # stations must stand at the centres of the raster's cells
        _require(abs(halves - round(halves)) < 1e-6, self, "block", "a multiple of 0.5 m")
        _require(self.voxel <= self.block, self, "voxel", f"no larger than block ({self.block} m)")
        _require(
            self.block < self.descriptor.radius,
            self,
            "block",
            f"below the radius ({self.descriptor.radius} m)",
        )


@dataclass(frozen=True)
class KeyframeConfig:
    """When the robot's frames become a virtual local scan (paper, section 3.3).

    ``distance`` is the paper's sigma_d. The ring buffer holds ``capacity`` keyframes, so memory is fixed;
    ``min_points`` after voxel de-duplication is what a VLS needs before it may vote.
    """

    distance: float = 2.0
    capacity: int = 30
    voxel: float = 0.25
    range_min: float = 0.5
    min_points: int = 300

    def __post_init__(self) -> None:
        _positive(self, "distance", "voxel")
        _counts(self, "capacity", "min_points")
        _require(self.range_min >= 0, self, "range_min", "zero or more")


@dataclass(frozen=True)
class RetrievalConfig:
    """Which stations are scored (paper, section 3.4).

    ``exhaustive`` scores all stations at all shifts. ``ring_key`` is the paper's way, kept for comparison: only
    the ``candidates`` stations nearest in ring key are scored, all others count as worst.
    """

    mode: Literal["exhaustive", "ring_key"] = "exhaustive"
    candidates: int = 200

    def __post_init__(self) -> None:
        _require(self.mode in ("exhaustive", "ring_key"), self, "mode", "exhaustive or ring_key")
        _counts(self, "candidates")


@dataclass(frozen=True)
class ConsensusConfig:
    """How keyframes vote for one ``T_map_odom``.

    ``window`` newest keyframes vote; ``peaks`` best hypotheses that differ by more than ``distinct_distance`` or
    ``distinct_yaw`` from every better one go on to registration. ``single`` is the paper's rule instead: the one
    smallest distance of all keyframes.
    """

    mode: Literal["consensus", "single"] = "consensus"
    window: int = 10
    peaks: int = 6
    distinct_distance: float = 6.0
    distinct_yaw: float = math.radians(20)

    def __post_init__(self) -> None:
        _require(self.mode in ("consensus", "single"), self, "mode", "consensus or single")
        _counts(self, "window", "peaks")
        _positive(self, "distinct_distance", "distinct_yaw")


@dataclass(frozen=True)
class RegistrationConfig:
    """Trimmed ICP (eq. 13): point-to-plane, coarse to fine; or GICP, with the same schedule and settings.

    ``method`` is ``trimmed-icp`` or ``gicp``; the latter needs the extra of that name and is for tracking only, the
    search's hypotheses go through trimmed ICP (see :mod:`coview_stream.pose.gicp`). ``residual_scale`` is trimmed
    ICP's alone. ``keep`` is the overlap; the paper keeps 60 %, 70 % converges faster here and as well. ``search`` and
    ``track`` list the largest correspondence distances of the successive scales. Points above the ground and points
    on it are trimmed apart, else the ground, which fits anywhere, pushes out the facades that fix the position (KITTI
    04: 0.25 m median error against 0.05 m). ``inflation`` scales the inverse Hessian's sigma, which is optimistic
    (points are not independent). A direction in which that leaves more than ``weak_from`` metres (an angle counts as
    what it moves at ``weak_lever`` metres) is one that the map hardly shows: its sigma is widened further, up to
    ``weak_sigma`` metres (see :func:`coview_stream.pose.covariance.registration_covariance`). The ``shared`` sigmas are
    of the error that neighbouring registrations have in common (see
    :func:`coview_stream.pose.covariance.shared_covariance`): a scanned map's points lie off its surfaces. Inflation,
    floors and shared sigmas are calibrated on simulated drives, seeds 5101 to 5110 of ``bench.tracking``; a real map's
    own error, against the ground truth that matters to you, comes on top.
    """

    method: RegistrationMethod = "trimmed-icp"
    keep: float = 0.7
    search: tuple[float, ...] = (3.0, 1.5, 0.8, 0.4)
    track: tuple[float, ...] = (0.8, 0.4)
    iterations: int = 15
    source_voxel: float = 0.5
    source_points: int = 5000
    source_range: float = 50.0
    residual_scale: float = 0.1
    inflation: float = 3.0
    sigma_floor: float = 0.002
    sigma_floor_angle: float = math.radians(0.004)
    shared: float = 1.45
    shared_position: float = 0.005
    shared_height: float = 0.001
    shared_tilt: float = math.radians(0.04)
    shared_yaw: float = math.radians(0.001)
    gravity_sigma: float = math.radians(1.0)
    weak_lever: float = 10.0
    weak_from: float = 0.05
    weak_sigma: float = 10.0

    def __post_init__(self) -> None:
        methods = get_args(RegistrationMethod)
        _require(self.method in methods, self, "method", f"one of {', '.join(methods)}")
        _fraction(self, "keep")
        _counts(self, "iterations", "source_points")
        _positive(self, "weak_lever", "weak_from", "weak_sigma")
        _positive(self, "source_voxel", "source_range", "residual_scale", "inflation", "gravity_sigma")
        _positive(self, "sigma_floor", "sigma_floor_angle")
        _positive(self, "shared", "shared_position", "shared_height", "shared_tilt", "shared_yaw")
        for name in ("search", "track"):
            steps = getattr(self, name)
            falling = bool(steps) and all(
                a >= b > 0 for a, b in zip(steps, (*steps[1:], steps[-1]), strict=True)
            )
            _require(falling, self, name, "one or more positive distances, coarse to fine")


@dataclass(frozen=True)
class AcceptanceConfig:
    """What evidence makes a fix, keeps it, and loses it (see :mod:`coview_stream.pose.verification`).

    A hypothesis counts when its score is at least ``score``, leads every registered rival's by ``lead``, and at least
    ``ground`` of the robot's ground lies on the map's. It is accepted when it has counted for ``confirmations``
    keyframes that agree within ``agree_distance`` and ``agree_angle``, none between them having found another place,
    and what its scores exceed ``proof_floor`` by adds up to ``proof``: weak evidence needs more driving. One frame
    alone (``stationary``) must reach ``single_score`` and ``single_lead``.

    Set by hand on few scans, with earlier forms of the score, and no command prints these figures: single scans of
    three real and two simulated sensors, where 86 right places led by 0.04-0.8, four wrong ones by 0.07 at most and
    two that were 1.3-2.1 m off by 0.11; and 16 runs outside the map, one of which found a place at the map's edge
    (scores of 0.3-0.5, a lead of 0.3, a ground share below 0.65). Right places had a ground share of 0.8 or more after
    two keyframes.
    While tracking a registration is rejected if it scores below ``keep_score``, below ``keep_share`` of what was usual
    on the last metres, or below ``keep_ground``; if less than ``inside`` of the points lie where the map has been
    surveyed; or if odometry would have to be off by a squared Mahalanobis distance of ``keep_innovation`` (6 degrees of
    freedom; 22 is exceeded by one in a thousand if all covariances are right, but their tails are not). Meanwhile there
    is no pose. One that is not rejected clears the doubt; ``patience`` that are, ``TrackingConfig.distance`` apart, or
    a doubt that lasts ``patience_seconds``, lose the place (see :mod:`coview_stream.pose.judgement`). While the sensor
    is blind nothing speaks against it: for ``patience_blind`` seconds odometry goes on without a pose given, and after
    more than ``patience_seconds`` it takes ``confirmations`` registrations to be believed again.
    """

    score: float = 0.27
    lead: float = 0.1
    ground: float = 0.7
    confirmations: int = 3
    proof: float = 1.2
    proof_floor: float = 0.2
    single_score: float = 0.45
    single_lead: float = 0.2
    agree_distance: float = 1.5
    agree_angle: float = math.radians(3)
    keep_score: float = 0.17
    keep_share: float = 0.65
    keep_innovation: float = 40.0
    keep_ground: float = 0.5
    inside: float = 0.3
    patience: int = 2
    patience_seconds: float = 10.0
    patience_blind: float = 60.0
    most_tilt: float = math.radians(8)

    def __post_init__(self) -> None:
        _fraction(
            self,
            "score",
            "lead",
            "single_score",
            "single_lead",
            "keep_score",
            "keep_share",
            "inside",
            "ground",
            "keep_ground",
        )
        _counts(self, "confirmations", "patience")
        _positive(self, "agree_distance", "agree_angle", "most_tilt", "proof", "keep_innovation")
        _positive(self, "patience_seconds", "patience_blind")
        _require(0 <= self.proof_floor < 1, self, "proof_floor", "in [0, 1)")


@dataclass(frozen=True)
class TrackingConfig:
    """How a fix is kept: how often to register, with what, and how fast odometry is believed to drift.

    Register after ``distance`` metres of driving or ``turn`` radians of turning, or ``seconds`` (sensor time) whatever
    odometry says, for wheels slip, drivers hang and robots are carried; and, where odometry is bad, as soon as the pose
    has become uncertain by ``unsure_position`` metres or ``unsure_yaw`` radians, but not before ``least_distance``
    metres. Registered is the newest frame, and as many before it as it takes to ``min_points``, but none from before
    the last ``window`` metres once there are that many, and none once there are ``max_points``: older ones are smeared
    by the drift (with odometry that drifts by 3 % the heading came out ten times as well from one frame as from the
    last two metres').

    Drifts are random-walk sigmas per square root of a metre driven; ``turn_drift`` is yaw error per radian turned.
    They are where :class:`coview_stream.pose.drift.DriftEstimator` begins: it believes them like ``drift_trust`` metres
    of driving, and forgets what it has measured over ``drift_memory`` metres.
    """

    distance: float = 1.0
    seconds: float = 1.0
    least_distance: float = 0.3
    unsure_position: float = 0.03
    unsure_yaw: float = math.radians(0.2)
    window: float = 0.01
    min_points: int = 2500
    max_points: int = 50_000
    turn: float = math.radians(10)
    position_drift: float = 0.015
    height_drift: float = 0.004
    tilt_drift: float = math.radians(0.05)
    yaw_drift: float = math.radians(0.15)
    turn_drift: float = 0.02
    drift_trust: float = 6.0
    drift_memory: float = 40.0

    def __post_init__(self) -> None:
        _positive(
            self,
            "distance",
            "seconds",
            "least_distance",
            "unsure_position",
            "unsure_yaw",
            "window",
            "turn",
            "position_drift",
            "height_drift",
            "tilt_drift",
            "yaw_drift",
            "turn_drift",
            "drift_trust",
            "drift_memory",
        )
        _counts(self, "min_points", "max_points")


@dataclass(frozen=True)
class GraphConfig:
    """How poses are smoothed (see :mod:`coview_stream.pose.graph`).

    ``backend`` is ``gtsam``, ``numpy``, or ``auto``: gtsam where it can be imported, else NumPy. Both answer alike for
    the newest pose. The gtsam graph grows to ``restart`` keyframes and begins anew with the newest ``window`` of them;
    the NumPy one does so when it has a quarter more. What they drop lives on in the belief that it left behind, so
    a longer window only lets old registrations be weighed again, and linearised again, in the light of later ones.
    ``huber`` is where, in standard deviations, a registration's pull stops growing. It is the norm of six residuals at
    once, which is 2.4 on average and exceeds 3.5 in one case of twenty; the usual 1.345 is meant for a single one. It
    must not be a kernel that lets go altogether: with an optimistic covariance that locks the map out for good.
    """

    backend: GraphBackend = "auto"
    window: int = 40
    restart: int = 120
    huber: float = 3.5

    def __post_init__(self) -> None:
        allowed = get_args(GraphBackend)
        _require(self.backend in allowed, self, "backend", f"one of {', '.join(allowed)}")
        _counts(self, "window", "restart", least=2)
        _require(self.restart > self.window, self, "restart", f"greater than window ({self.window})")
        _positive(self, "huber")


@dataclass(frozen=True)
class LocalizerConfig:
    """Everything that the localizer decides by; the defaults need no change.

    ``stationary`` is the paper's path for terrestrial scans: one frame may be enough for a fix.
    """

    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    retrieval: RetrievalConfig = field(default_factory=RetrievalConfig)
    consensus: ConsensusConfig = field(default_factory=ConsensusConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    stationary: bool = False


def map_preset(name: Preset, **changes: Any) -> MapConfig:
    """Return one of the paper's two settings: ``slam`` (radius 50 m) and ``tls`` (terrestrial scans, radius 100 m).

    ``changes`` are fields of :class:`MapConfig` or :class:`DescriptorConfig` that replace the preset's. Raises
    :class:`ConfigError` for an unknown preset or field, or a value out of range.
    """
    if name not in get_args(Preset):
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(get_args(Preset))}")
    descriptor: dict[str, Any] = {"radius": 100.0 if name == "tls" else 50.0}
    rest: dict[str, Any] = {}
    descriptor_names = {f.name for f in fields(DescriptorConfig)}
    map_names = {f.name for f in fields(MapConfig)} - {"descriptor"}
    for key, value in changes.items():
        if key in descriptor_names - {"voxel"}:
            descriptor[key] = value
        elif key in map_names:
            rest[key] = value
        else:
            raise ConfigError(
                f"unknown map option {key!r}; choose from {sorted(descriptor_names | map_names)}"
            )
    return MapConfig(descriptor=DescriptorConfig(**descriptor), **rest)
