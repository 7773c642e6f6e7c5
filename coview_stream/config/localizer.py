"""All of the localizer's settings in one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import get_args

from coview_stream.config.checks import require
from coview_stream.config.registration import RegistrationConfig
from coview_stream.config.search import (
    ConsensusConfig,
    KeyframeConfig,
    LearnedConfig,
    Reloc,
    RetrievalConfig,
)
from coview_stream.config.tracking import AcceptanceConfig, GraphConfig, TrackingConfig


@dataclass(frozen=True)
class LocalizerConfig:
    """Everything that the localizer decides by; the defaults need no change.

    ``reloc`` says who names places to look at: the co-view descriptors (``coview``), the learned features
    (``learned``), or both where map and installation have the latter (``auto``). ``stationary`` is the paper's path for
    terrestrial scans: one frame may be enough for a fix.
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
    stationary: bool = False

    def __post_init__(self) -> None:
        known = get_args(Reloc)
        require(self.reloc in known, self, "reloc", f"one of {', '.join(known)}")
