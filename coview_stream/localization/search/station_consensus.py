"""Consensus of keyframes by their descriptors: which stations they are compared with, and the places they agree on."""

from __future__ import annotations

from collections.abc import Mapping

from coview_stream.config import Channel, ConsensusConfig
from coview_stream.descriptors.coview import Descriptor
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.circle import Circle
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.coview_vote import CoViewVote
from coview_stream.localization.search.retrieval import Retrieval
from coview_stream.localization.search.votes import Vote


class StationConsensus:
    """Consensus on the stations of a map, or of a circle on it."""

    def __init__(self, retrieval: Retrieval, config: ConsensusConfig) -> None:
        """Begin without votes, on all of the map."""
        self.retrieval = retrieval
        self.config = config
        self._area: Circle | None = None
        self._compare(None)

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._consensus)

    def clear(self) -> None:
        """Forget all votes."""
        self._consensus.clear()

    def vote(self, centre: Floats, query: Mapping[Channel, Descriptor], area: Circle | None = None) -> None:
        """Add one keyframe's vote; another area than that of the votes so far begins anew.

        Args:
            centre: (3,) zero of the descriptors, z on the ground; odometry frame, metres.
            query: descriptors (R, S) by channel.
            area: of the map, metres from its zero, outside of which no station is compared; None for none.
        """
        if area != self._area:
            self._compare(area)
        self._newest: Vote = self.retrieval.vote(centre, query, self._compared)
        self._consensus.vote(self._newest)

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        found = self._consensus.hypotheses()
        if not found or not isinstance(self._newest, CoViewVote):
            return found
        return self._compared.on_the_map(found, self._newest, len(self))

    def _compare(self, area: Circle | None) -> None:
        self._compared = self.retrieval.compared(area)
        self._consensus = Consensus(self._compared.grid, self.config)
        self._area = area
