"""Consensus of keyframes by their descriptors: which stations they are compared with, and the places they agree on."""

from __future__ import annotations

from collections.abc import Mapping

from coview_stream.config import Channel, ConsensusConfig
from coview_stream.descriptors.coview import Descriptor
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Circle
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.coview_vote import CoViewVote
from coview_stream.localization.search.retrieval import Retrieval
from coview_stream.localization.search.search_stations import SearchStations
from coview_stream.localization.search.votes import Vote


class StationConsensus:
    """Consensus on the stations of a map, or of a circle on it."""

    def __init__(self, retrieval: Retrieval, config: ConsensusConfig) -> None:
        """Begin without votes; which stations are compared is chosen at the first one."""
        self.retrieval = retrieval
        self.config = config
        self._area: Circle | None = None
        self._compared: SearchStations | None = None
        self._consensus: Consensus | None = None
        self._newest: Vote | None = None

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return 0 if self._consensus is None else len(self._consensus)

    def clear(self) -> None:
        """Forget all votes, and what was copied of a circle."""
        if self._area is not None:
            self._area = self._compared = self._consensus = None
        if self._consensus is not None:
            self._consensus.clear()

    def vote(self, centre: Floats, query: Mapping[Channel, Descriptor], area: Circle | None = None) -> None:
        """Add one keyframe's vote; another area than that of the votes so far begins anew.

        Args:
            centre: (3,) zero of the descriptors, z on the ground; odometry frame, metres.
            query: descriptors (R, S) by channel.
            area: of the map, metres from its zero, outside of which no station is compared; None for none.
        """
        if self._consensus is None or area != self._area:
            self._compared = self.retrieval.compared(area)
            self._consensus = Consensus(self._compared.grid, self.config)
            self._area = area
        self._newest = self.retrieval.vote(centre, query, self._compared)
        self._consensus.vote(self._newest)

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        found = [] if self._consensus is None else self._consensus.hypotheses()
        if not found or self._compared is None or not isinstance(self._newest, CoViewVote):
            return found
        return self._compared.on_the_map(found, self._newest, len(self))
