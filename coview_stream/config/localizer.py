"""All of the localizer's settings together."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import get_args

from coview_stream.config.acceptance import AcceptanceConfig
from coview_stream.config.checks import check_types, require
from coview_stream.config.registration import RegistrationConfig
from coview_stream.config.search import ConsensusConfig, KeyframeConfig, LearnedConfig, Reloc, RetrievalConfig
from coview_stream.config.tracking import GraphConfig, TrackingConfig


@dataclass(frozen=True)
class LocalizerConfig:
    """Everything that the localizer decides by; the defaults need no change.

    Attributes:
        keyframe: when frames become keyframes.
        retrieval: which stations a keyframe is compared with.
        consensus: how keyframes vote.
        registration: how scans are registered to the map, and its covariance.
        acceptance: what makes, keeps and loses a fix.
        tracking: when to register while tracking.
        graph: how poses are smoothed.
        learned: how learned features are looked up.
        reloc: which place recognition names places, see :data:`coview_stream.config.Reloc`; ``auto`` goes without
            learned features where map or installation lack them.
        sensor_leans: whether the sensor may lean against odometry's gravity, which is then estimated; no where odometry
            is made of the sensor's own clouds: what leans is odometry's frame then.
    """

    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    retrieval: RetrievalConfig = field(default_factory=RetrievalConfig)
    consensus: ConsensusConfig = field(default_factory=ConsensusConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    learned: LearnedConfig = field(default_factory=LearnedConfig)
    reloc: Reloc = "auto"
    sensor_leans: bool = True

    def __post_init__(self) -> None:
        check_types(self)
        known = get_args(Reloc)
        require(self.reloc in known, self, "reloc", f"one of {', '.join(known)}")
