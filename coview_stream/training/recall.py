"""Recall of the dense search, in worlds that were not trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from coview_stream.descriptors.birds_eye_view import Image
from coview_stream.descriptors.network import Features
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.localization.search.learned.correlation import correlate, downsample
from coview_stream.localization.search.learned.feature_index import FeatureIndex
from coview_stream.training.dataset import WorldViews

# all set by hand

HEADINGS = 36
"""Headings that the dense search tries."""

_CELL = 2.0  # metres of the dense search
_BEST = 5  # places kept
_DISTINCT = 10.0  # metres between two places that are counted as two
_MAX_ERROR = 10.0  # metres from the truth at which a place still counts as found
_RADIUS = 29.0  # metres of a query that are compared

Encoder = Callable[[Image], Features]


@dataclass(frozen=True)
class SearchedQuery:
    """One query and the places that the search found.

    Attributes:
        world: index of its world.
        sensor: of the robot.
        travelled: metres driven for it.
        found: (5, 3) x, y (metres) and heading (radians) of the best places, best first.
        pose: (3,) the true x, y and heading.
        scores: (5,) of the places.
    """

    world: int
    sensor: str
    travelled: float
    found: Floats
    pose: Floats
    scores: Floats

    def found_among(self, best: int = 1) -> bool:
        """Tell whether one of the ``best`` places lies within 10 m of the truth."""
        apart = np.linalg.norm(self.found[:best, :2] - self.pose[:2], axis=1)
        return bool((apart < _MAX_ERROR).any())


def search_queries(
    worlds: Sequence[WorldViews], aerial: Encoder, ground: Encoder, max_queries: int | None = None
) -> list[SearchedQuery]:
    """Search every query (up to ``max_queries`` of a world) in its world's map, at all places and headings."""
    yaws = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    results = []
    for number, world in enumerate(worlds):
        features, _ = downsample(aerial(_cropped(world.aerial)).local)
        index = FeatureIndex(features, world.corner, _CELL)
        for k in range(len(world.queries))[:max_queries]:
            query = ground(world.queries[k])
            volume = correlate(*downsample(query.local, weights(query.sigma)), index, yaws)
            found, scores = best_places(volume, yaws, world.corner)
            results.append(
                SearchedQuery(number, str(world.sensor[k]), float(world.travelled[k]), found, world.poses[k], scores)
            )
    return results


def weights(sigma: Floats32) -> Floats32:
    """Weigh a query's cells (h, h) by their uncertainty (h, h): 1 / sigma within 29 m of the middle."""
    at = np.arange(len(sigma)) + 0.5 - len(sigma) / 2
    return np.asarray((np.hypot(at[:, None], at[None]) < _RADIUS) / sigma, dtype=np.float32)


def best_places(volume: Floats32, yaws: Floats, corner: Floats) -> tuple[Floats, Floats]:
    """Find the highest peaks of (K, H, W), 10 m or more apart: places (5, 3) and scores (5,)."""
    top = volume.max(axis=0)
    places, scores = [], []
    rows, columns = np.indices(top.shape)
    for _ in range(_BEST):
        row, column = np.unravel_index(int(top.argmax()), top.shape)
        yaw = yaws[int(volume[:, row, column].argmax())]
        places.append([*(corner + (np.array([column, row]) + 0.5) * _CELL), yaw])
        scores.append(float(top[row, column]))
        top = np.where(np.hypot(rows - row, columns - column) * _CELL < _DISTINCT, -np.inf, top)
    return np.array(places), np.array(scores)


def _cropped(image: Image) -> Image:
    """Crop an image to whole cells of 4 m."""
    return image[:, : image.shape[1] // 8 * 8, : image.shape[2] // 8 * 8]
