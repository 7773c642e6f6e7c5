"""Learned re-localization on one map: a scan's features compared with the map's, at every place and heading."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from coview_stream.config import LearnedConfig
from coview_stream.geometry import Points, pose_from, rot_z, transform, yaw_of
from coview_stream.place.consensus import Hypothesis, yaw_of_shift
from coview_stream.place.learned.bird_view import CELL, bird_view
from coview_stream.place.learned.coarse_map import CoarseMap
from coview_stream.place.learned.correlation import correlate
from coview_stream.place.learned.feature_map import FeatureMap
from coview_stream.place.learned.feature_tiles import TILE
from coview_stream.place.learned.keypoints import Keypoints, keypoints
from coview_stream.place.learned.match_config import LearnedMatchConfig
from coview_stream.place.learned.network import LOCAL_CELL, Features, Network
from coview_stream.place.learned.sharpen import sharpen
from coview_stream.place.learned.turning import coarser
from coview_stream.place.retrieval import Volume

_SIZE = 64.0
"""Metres along the edge of a query's image."""

_SAMPLE = 200_000  # numbers are enough for a median
_TILE_RADIUS = 0.75 * TILE * LOCAL_CELL  # what a tile's blocks have to reach from its middle, corners and all


@dataclass(frozen=True)
class View:
    """What the ground network saw around ``centre``.

    Attributes:
        features: of an image with ``centre`` in its middle, axes as the odometry frame's.
        weight: (h, w) how much each cell of the local descriptors counts; zero beyond the reach.
        centre: (3,) the robot, but on the ground; odometry frame, metres.
    """

    features: Features
    weight: npt.NDArray[np.float32]
    centre: npt.NDArray[np.float64]

    @property
    def corner(self) -> npt.NDArray[np.float64]:
        """(2,) lower corner of the image, metres from the centre."""
        return np.full(2, -0.5 * _SIZE)

    @property
    def place(self) -> npt.NDArray[np.float32]:
        """(P,) global descriptor of unit norm: the mean of the four cells in the middle."""
        middle = self.features.place.shape[1] // 2
        mean = self.features.place[:, middle - 1 : middle + 1, middle - 1 : middle + 1].mean(axis=(1, 2))
        return np.asarray(mean / (np.linalg.norm(mean) + 1e-9), dtype=np.float32)


class LearnedMap:
    """All that searches of one map share: the map's features, ready to be searched, and the ground network.

    Nothing is loaded before the first query, or :meth:`prepare`.

    Raises:
        MapError: the map's features were made by other weights than those in ``directory`` (the package's).
    """

    def __init__(
        self,
        features: FeatureMap,
        stations: npt.NDArray[np.float32],
        config: LearnedConfig,
        directory: Path | None = None,
    ) -> None:
        features.check(directory)
        self.features = features
        self.stations = stations
        self.config = config
        self.match = LearnedMatchConfig(reach=config.reach)
        self._directory = directory

    @cached_property
    def network(self) -> Network:
        """The ground encoder; one thread is enough for 64 m."""
        return Network("ground", self._directory, threads=1)

    @cached_property
    def coarse(self) -> CoarseMap:
        """The map's features on coarse cells, with their spectra."""
        whole, corner = self.features.coarse(self.config.cell)
        margin = round(0.5 * _SIZE / self.config.cell)
        surveyed = (whole != 0).any(axis=0)
        # halves: the whole is kept beside its spectra, and its numbers come from single bytes anyway
        return CoarseMap(whole.astype(np.float16), corner, self.config.cell, surveyed=surveyed, margin=margin)

    @cached_property
    def _everywhere(self) -> npt.NDArray[np.int64]:
        """Blocks of the coarse map that have features at all."""
        return self.coarse.blocks_near(self.features.tile_centres, _TILE_RADIUS)

    @property
    def dense(self) -> bool:
        """Whether the map is small enough to be searched all over."""
        return self.features.tile_area <= self.config.dense_area

    def prepare(self) -> None:
        """Load the network and make the map's spectra now, rather than at the first query."""
        _ = self.network, self._everywhere

    def view(self, points: Points, centre: npt.NDArray[np.float64]) -> View:
        """Encode a gravity-aligned cloud (N, 3) around ``centre`` (3,), which is on the ground below the robot."""
        size = round(_SIZE / CELL)
        features = self.network(bird_view(points, centre[:2] - 0.5 * _SIZE, (size, size)))
        axis = (np.arange(features.sigma.shape[0]) + 0.5) * LOCAL_CELL - 0.5 * _SIZE
        inside = np.hypot(axis[:, None], axis[None]) <= self.config.reach
        weight = np.where(inside, 1.0 / features.sigma, 0.0).astype(np.float32)
        return View(features, weight, centre)

    def distances(self, view: View) -> Volume:
        """(M, S) of all stations and headings, lower is more alike; shift n means yaw -2 pi n / S.

        Their median is 1, which is also the distance where nothing was compared: it speaks neither for nor against.
        """
        ratio = round(self.config.cell / LOCAL_CELL)
        query, weight = coarser(view.features.local, view.weight, ratio)
        yaws = yaw_of_shift(np.arange(self.config.yaws), self.config.yaws)
        blocks = self._everywhere if self.dense else self._alike(view)
        scores = correlate(query, weight, self.coarse, yaws, blocks)
        row, column = self.coarse.cell_of(self.stations[:, :2])
        inside = (row >= 0) & (row < self.coarse.height) & (column >= 0) & (column < self.coarse.width)
        read = np.full((len(self.stations), len(yaws)), -np.inf, dtype=np.float32)
        read[inside] = scores.transpose(1, 2, 0)[row[inside], column[inside]]
        compared = np.isfinite(read)
        sample = read[:: max(1, read.size // _SAMPLE)]
        sample = sample[np.isfinite(sample)]
        usual = np.median(sample) if len(sample) else np.float32(0.0)
        found: Volume = np.float32(1.0 + usual) - read
        found[~compared] = 1.0
        return found

    def sharpened(self, hypotheses: list[Hypothesis], view: View) -> list[Hypothesis]:
        """Move each hypothesis to where keypoints around it agree; where too few do, it stays."""
        local, sigma = view.features.local, view.features.sigma
        ours = keypoints(local, sigma, view.corner, mask=view.weight > 0, count=self.match.keypoints)
        return [self._sharpened(each, ours, view.centre) for each in hypotheses]

    def _sharpened(
        self, hypothesis: Hypothesis, ours: Keypoints, centre: npt.NDArray[np.float64]
    ) -> Hypothesis:
        T = hypothesis.T_map_odom
        x, y, z = transform(T, centre[None])[0].tolist()
        patch = self.features.patch(np.array([x, y]), self.match.reach + self.match.most_shift)
        known = (patch.local != 0).any(axis=0)
        theirs = keypoints(patch.local, patch.sigma, patch.corner, mask=known, count=None)
        found = sharpen(ours, theirs, (x, y, yaw_of(T)), self.match)
        if found is None:
            return hypothesis
        there = pose_from(rot_z(found.yaw), np.array([found.x, found.y, z]))
        return replace(hypothesis, T_map_odom=there @ pose_from(np.eye(3), -centre))

    def _alike(self, view: View) -> npt.NDArray[np.int64]:
        """Blocks of the coarse map around the tiles whose global descriptors are most like the view's."""
        likeness = self.features.place.astype(np.float32) @ view.place
        tile = np.floor(self.features.place_at / (TILE * LOCAL_CELL)).astype(np.int64)
        found, number = np.unique(tile, axis=0, return_inverse=True)
        best = np.full(len(found), -np.inf, dtype=np.float32)
        np.maximum.at(best, number.reshape(-1), likeness)
        chosen = found[np.argsort(-best, kind="stable")[: self.config.shortlist]]
        return self.coarse.blocks_near((chosen + 0.5) * (TILE * LOCAL_CELL), _TILE_RADIUS)
