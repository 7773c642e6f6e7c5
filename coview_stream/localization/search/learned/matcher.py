"""Feature matcher: a scan's learned features compared with a map's at every station and heading."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt

from coview_stream.config import LearnedConfig
from coview_stream.config.search import LearnedMatchConfig
from coview_stream.descriptors.birds_eye_view import CELL, birds_eye_view
from coview_stream.descriptors.feature_map import TILE, FeatureMap
from coview_stream.descriptors.network import LOCAL_CELL, Features, Network, network
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, pose_from, rot_z, transform, yaw_of
from coview_stream.localization.search.consensus import Hypothesis, yaw_of_shift
from coview_stream.localization.search.learned.correlation import correlate, downsample
from coview_stream.localization.search.learned.feature_index import FeatureIndex
from coview_stream.localization.search.learned.keypoint_registration import refine_by_keypoints
from coview_stream.localization.search.learned.keypoints import Keypoints, keypoints
from coview_stream.localization.search.votes import ScoreVolume

_SIZE = 64.0
"""Metres along the edge of a query's image."""

_ENERGY = 0.995  # of the features on a map that the dimensions in which they are compared hold; set by hand
_MAX_SLOPE = 1.0  # metres per metre that the ground rises along a storey; set by hand
_MAX_STEP = 1.25  # metres more than that: the next storey is at least 2.5 m away; set by hand
_ROUNDING = 1e-6  # cells
_SAMPLE = 200_000  # scores that a median is taken of; set by hand
_TILE_RADIUS = 0.75 * TILE * LOCAL_CELL  # from a tile's middle to beyond its corners, metres


@dataclass(frozen=True)
class QueryFeatures:
    """Features of a query: the ground network's output around ``centre``.

    Attributes:
        features: of an image with ``centre`` in its middle, along the axes of the odometry frame.
        weight: (h, w) of each cell of the local descriptors; zero beyond the reach.
        centre: (3,) the ground below the robot, odometry frame, metres.
    """

    features: Features
    weight: Floats32
    centre: Floats

    @property
    def corner(self) -> Floats:
        """(2,) lower corner of the image, metres from the centre."""
        return np.full(2, -0.5 * _SIZE)

    @property
    def place(self) -> Floats32:
        """(P,) global descriptor of unit norm: the mean of the four cells in the middle."""
        middle = self.features.place.shape[1] // 2
        mean = self.features.place[:, middle - 1 : middle + 1, middle - 1 : middle + 1].mean(axis=(1, 2))
        return np.asarray(mean / (np.linalg.norm(mean) + 1e-9), dtype=np.float32)


class FeatureMatcher:
    """A map's learned features, ready to be searched, and the ground network: what searches of one map share.

    Nothing is loaded or made before the first query, or :meth:`prepare`.
    """

    def __init__(self, features: FeatureMap, stations: Floats32, config: LearnedConfig, *, block: float = 2.0) -> None:
        """Prepare to search a map whose stations (M, 3) stand in the middle of blocks of ``block`` metres.

        Raises:
            MapError: the features were made by other weights than the installed ones.
            InputError: there are no weights.
        """
        features.check()
        self.features = features
        self.stations = stations
        self.config = config
        self.match_config = LearnedMatchConfig(reach=config.reach)
        self._block = block

    @cached_property
    def network(self) -> Network:
        """The ground encoder; one thread is enough for 64 m."""
        return network("ground", 1)

    @cached_property
    def index(self) -> FeatureIndex:
        """The map's features on coarse cells, in the few dimensions that matter, with their spectra."""
        return self._reduced[0]

    @cached_property
    def _reduced(self) -> tuple[FeatureIndex, Floats32]:
        """The index, and the directions (D, C) of its dimensions."""
        whole, corner = self.features.coarse(self.config.cell)
        margin = round(0.5 * _SIZE / self.config.cell)
        surveyed = (whole != 0).any(axis=0)
        axes = principal_axes(whole[:, surveyed], _ENERGY)
        reduced = np.tensordot(axes, whole, 1).astype(np.float32)
        return FeatureIndex(reduced, corner, self.config.cell, surveyed=surveyed, margin=margin), axes

    @cached_property
    def _feature_blocks(self) -> Ints:
        """Blocks of the index that have any features."""
        return self.index.blocks_near(self.features.tile_centres, _TILE_RADIUS)

    @property
    def dense(self) -> bool:
        """True if the map is small enough to be searched all over."""
        return self.features.tile_area <= self.config.dense_area

    def prepare(self) -> None:
        """Load the network and make the map's spectra, or the first query does.

        Raises:
            InputError: the weights cannot be loaded. DependencyError: there is no onnxruntime, or a broken one.
        """
        import scipy.ndimage  # noqa: F401  # a quarter of a second, which the first image would take

        _ = self.network, self._feature_blocks if self.dense else self.index

    def encode(self, points: Points, centre: Floats) -> QueryFeatures:
        """Encode a gravity-aligned cloud (N, 3) around ``centre`` (3,), which is on the ground below the robot.

        Raises:
            InputError, DependencyError: as :meth:`prepare`.
        """
        size = round(_SIZE / CELL)
        features = self.network(birds_eye_view(points, centre[:2] - 0.5 * _SIZE, (size, size)))
        axis = (np.arange(features.sigma.shape[0]) + 0.5) * LOCAL_CELL - 0.5 * _SIZE
        inside = np.hypot(axis[:, None], axis[None]) <= self.config.reach
        weight = np.where(inside, 1.0 / features.sigma, 0.0).astype(np.float32)
        return QueryFeatures(features, weight, centre)

    def distances(self, query: QueryFeatures, near: npt.ArrayLike = ()) -> ScoreVolume:
        """Return distances (M, S) to all stations at all headings, lower is better; shift n means yaw -2 pi n / S.

        A map too large to be searched all over is searched around the tiles most similar to the query, and around
        ``near`` (N, 2), metres. The median is 1, which is also the distance where nothing was compared: no evidence.
        """
        ratio = round(self.config.cell / LOCAL_CELL)
        index, axes = self._reduced
        local, weight = downsample(np.tensordot(axes, query.features.local, 1), query.weight, ratio)
        yaws = yaw_of_shift(np.arange(self.config.yaws), self.config.yaws)
        blocks = self._feature_blocks if self.dense else self._similar_blocks(query, near)
        read = self._at_stations(correlate(local, weight, index, yaws, blocks))
        compared = np.isfinite(read)
        sample = read[:: max(1, read.size // _SAMPLE)]
        sample = sample[np.isfinite(sample)]
        median = np.median(sample) if len(sample) else np.float32(0.0)
        found: ScoreVolume = np.float32(1.0 + median) - read
        found[~compared] = 1.0
        return found

    def _at_stations(self, scores: Floats32) -> ScoreVolume:
        """Take the best score (M, K) of the cells (K, H, W) whose middle is in a station's block, -inf off the map.

        A block smaller than a cell has the score of the cell around its station.
        """
        grid = scores.transpose(1, 2, 0)
        xy = (self.stations[:, :2].astype(np.float64) - self.index.corner) / self.index.cell
        half = 0.5 * self._block / self.index.cell
        first, last = (np.ceil(xy + side - 0.5 - _ROUNDING).astype(np.int64) for side in (-half, half))
        first = np.where(last > first, first, np.floor(xy).astype(np.int64))
        size = np.maximum(last - first, 1)
        read = np.full((len(xy), grid.shape[2]), -np.inf, dtype=np.float32)
        for right, down in product(*(range(int(n)) for n in size.max(axis=0, initial=0))):
            column, row = (first + np.array([right, down])).T
            inside = ((right, down) < size).all(axis=1) & (row >= 0) & (row < grid.shape[0])
            inside &= (column >= 0) & (column < grid.shape[1])
            read[inside] = np.maximum(read[inside], grid[row[inside], column[inside]])
        return read

    def refine(self, hypotheses: list[Hypothesis], query: QueryFeatures) -> list[Hypothesis]:
        """Move each hypothesis to the pose that keypoints around it agree on; where too few agree, it stays."""
        local, sigma = query.features.local, query.features.sigma
        query_keypoints = keypoints(
            local, sigma, query.corner, mask=query.weight > 0, count=self.match_config.keypoints
        )
        return [self._refined(each, query_keypoints, query.centre) for each in hypotheses]

    def _refined(self, hypothesis: Hypothesis, query_keypoints: Keypoints, centre: Floats) -> Hypothesis:
        T = hypothesis.T_map_odom
        x, y, z = transform(T, centre[None])[0].tolist()
        patch = self.features.patch(np.array([x, y]), self.match_config.reach + self.match_config.max_shift)
        known = (patch.local != 0).any(axis=0)
        map_keypoints = keypoints(patch.local, patch.sigma, patch.corner, mask=known, count=None)
        found = refine_by_keypoints(query_keypoints, map_keypoints, (x, y, yaw_of(T)), self.match_config)
        if found is None:
            return hypothesis
        z = self._ground(np.array([found.x, found.y]), np.array([x, y, z]))
        there = pose_from(rot_z(found.yaw), np.array([found.x, found.y, z]))
        return replace(hypothesis, T_map_odom=there @ pose_from(np.eye(3), -centre), exact=True)

    def _ground(self, xy: Floats, before: Floats) -> float:
        """Return the height at ``xy`` (2,) of the storey at ``before`` (3,), metres; unchanged if it has none."""
        away = np.hypot(*(self.stations[:, :2] - xy).T)
        rise = np.abs(self.stations[:, 2] - before[2])
        moved = float(np.hypot(*(xy - before[:2])))
        same = np.flatnonzero((away <= 1.5 * self._block) & (rise <= _MAX_STEP + _MAX_SLOPE * moved))
        if not len(same):
            return float(before[2])
        nearest = same[np.lexsort((rise[same], np.round(away[same], 2)))[0]]
        return float(self.stations[nearest, 2])

    def _similar_blocks(self, query: QueryFeatures, near: npt.ArrayLike) -> Ints:
        """Find the blocks of the index around ``near`` (N, 2) and around the tiles most similar to the query."""
        similarity = self.features.place.astype(np.float32) @ query.place
        tile = np.floor(self.features.place_at / (TILE * LOCAL_CELL)).astype(np.int64)
        found, number = np.unique(tile, axis=0, return_inverse=True)
        best = np.full(len(found), -np.inf, dtype=np.float32)
        np.maximum.at(best, number.reshape(-1), similarity)
        chosen = found[np.argsort(-best, kind="stable")[: self.config.shortlist]]
        tiles = (chosen + 0.5) * (TILE * LOCAL_CELL)
        middles = np.vstack([tiles, np.asarray(near, dtype=np.float64).reshape(-1, 2)])
        return self.index.blocks_near(middles, _TILE_RADIUS)


def principal_axes(vectors: Floats32, energy: float) -> Floats32:
    """Find the fewest orthonormal directions (D, C) that hold a share of the energy of vectors (C, N), best first.

    Inner products with the vectors change little where a query is reduced to them: what they leave out of a vector of
    unit norm is ``1 - energy`` of its square in the mean.
    """
    moment = (vectors @ vectors.T).astype(np.float64)
    values, directions = np.linalg.eigh(moment)
    share = np.cumsum(values[::-1]) / max(float(values.sum()), 1e-30)
    count = min(int(np.searchsorted(share, energy)) + 1, len(values))
    return np.ascontiguousarray(directions[:, ::-1][:, :count].T, dtype=np.float32)
