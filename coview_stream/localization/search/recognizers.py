"""Place recognizers: keyframes vote for places of the map, and the best places become hypotheses of the search."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Channel, LocalizerConfig
from coview_stream.descriptors.coview import Descriptor, describe, on_ground
from coview_stream.errors import warn
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.search.retrieval import Retrieval, StationConsensus

if TYPE_CHECKING:  # imports SciPy, which takes a while
    from coview_stream.localization.search.learned.matcher import FeatureMatcher


class PlaceRecognizer(Protocol):
    """Place recognizer: keyframes vote, and their votes name places."""

    def vote(self, request: SearchRequest) -> None:
        """Add the votes of one keyframe; too few points give none."""
        ...

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best places, best first; none before the first vote."""
        ...

    def clear(self) -> None:
        """Forget all votes."""
        ...


@dataclass(frozen=True)
class SearchIndex:
    """The data shared by the recognizers of all searches of one map; None for an unused recognizer."""

    retrieval: Retrieval | None
    learned: FeatureMatcher | None

    @classmethod
    def of(cls, base_map: BaseMap, config: LocalizerConfig, load: bool = True) -> SearchIndex:
        """Return the index for ``config.reloc``, not yet prepared; ``load`` also loads and checks the network.

        ``auto`` warns of learned features that cannot be used, and does without them.

        Raises:
            MapError, InputError: as :meth:`BaseMap.require_features`.
        """
        retrieval = None if config.reloc == "learned" else Retrieval(base_map)
        missing = base_map.require_features(config.reloc, load)
        warn(missing)
        if missing is not None or config.reloc == "coview" or base_map.learned is None:
            return cls(retrieval, None)
        from coview_stream.localization.search.learned.matcher import FeatureMatcher

        block = base_map.config.block
        return cls(retrieval, FeatureMatcher(base_map.learned, base_map.stations, config.learned, block=block))

    def prepare(self) -> None:
        """Compute ahead of the first query; CoViewError if something is missing."""
        if self.retrieval is not None:
            self.retrieval.prepare()
        if self.learned is not None:
            self.learned.prepare()


class CoViewRecognizer:
    """Recognizer by the paper's descriptors (eqs 1-12).

    Attributes:
        last_query: descriptors (R, S) of the newest keyframe that voted, by channel.
    """

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, retrieval: Retrieval, peaks: int) -> None:
        self.base_map = base_map
        self.config = config
        self.consensus = StationConsensus(retrieval, replace(config.consensus, peaks=peaks))
        self.last_query: dict[Channel, Descriptor] = {}

    def vote(self, request: SearchRequest) -> None:
        """Compare the virtual local scan with every station's."""
        descriptor = self.base_map.descriptor_config
        if len(request.scan) < self.config.keyframe.min_points:
            return
        centre = on_ground(request.scan, request.position) if descriptor.ground_zero else request.position
        self.last_query = describe(request.scan, centre, descriptor)
        self.consensus.vote(centre, self.last_query, request.area)

    def hypotheses(self) -> list[Hypothesis]:
        """Return the consensus' peaks."""
        return self.consensus.hypotheses()

    def alike(self, T_map_odom: Pose) -> Floats:
        """Return ``T_map_odom`` (K, 4, 4) of the places that look most like one on the map."""
        return self.consensus.alike(T_map_odom)

    def clear(self) -> None:
        """Forget all votes."""
        self.consensus.clear()
