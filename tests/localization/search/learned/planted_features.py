"""A map of random features, and what a perfect network would see anywhere in it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from coview_stream.descriptors.feature_map import TILE, FeatureMap, quantized, quantized_sigma, weights_sha256
from coview_stream.descriptors.network import Features
from coview_stream.localization.search.learned.matcher import QueryFeatures

CHANNELS = 16
TILES = 6  # along an edge: 192 m
LOW = np.array([-3, -2])  # tile at the lower corner
SECTORS = 36


def field(seed, shape, smooth):
    """Unit vectors (C, H, W) that change over ``smooth`` cells."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(CHANNELS, *shape)).astype(np.float32)
    values = ndimage.gaussian_filter(values, (0, smooth, smooth))
    return values / np.linalg.norm(values, axis=0)


def in_tiles(values):
    """(H, W, ...) as tiles, row by row."""
    size, *rest = values.shape[0] // TILE, *values.shape[2:]
    blocks = values.reshape(size, TILE, size, TILE, *rest).swapaxes(1, 2)
    return blocks.reshape(size * size, TILE, TILE, *rest)


class Planted:
    """A map of random features, and what a perfect ground network would see anywhere in it."""

    def __init__(self, seed=1):
        size = TILES * TILE
        self.local = field(seed, (size, size), 2.5)
        rng = np.random.default_rng(seed)
        self.marks = rng.uniform(0, size, (1200, 2))  # keypoints: x and y in cells
        self.sigma = np.full((size, size), 3.0, dtype=np.float32)
        column, row = self.marks.astype(int).T
        self.sigma[row, column] = rng.uniform(0.2, 0.4, len(self.marks)).astype(np.float32)
        row, column = np.divmod(np.arange(TILES**2), TILES)
        tiles = (np.column_stack([column, row]) + LOW).astype(np.int32)
        at = (np.stack(np.meshgrid(np.arange(size // 8), np.arange(size // 8)), -1).reshape(-1, 2) + 0.5) * 8
        place = rng.normal(size=(len(at), 24)).astype(np.float32)
        self.place = place / np.linalg.norm(place, axis=1, keepdims=True)
        self.place_at = at + LOW * TILE
        arrays = {
            "learned.local": in_tiles(quantized(self.local.transpose(1, 2, 0))),
            "learned.sigma": in_tiles(quantized_sigma(self.sigma)),
            "learned.tiles": tiles,
            "learned.place": quantized(self.place),
            "learned.place_at": self.place_at.astype(np.float32),
        }
        self.features = FeatureMap(arrays, {"weights": weights_sha256(), "cell": 1.0})

    def seen(self, xy, yaw, centre, noise=0.5, seed=0):
        """What the network makes of a robot at ``xy`` whose odometry frame is turned by ``yaw`` in the map."""
        axis = np.arange(64) + 0.5 - 32.0
        u, v = np.meshgrid(axis, axis)
        c, s = np.cos(yaw), np.sin(yaw)
        at = np.stack([c * u - s * v + xy[0], s * u + c * v + xy[1]]) - (LOW * TILE)[:, None, None]
        where = at[::-1] - 0.5
        local = np.stack([ndimage.map_coordinates(k, where, order=1, mode="nearest") for k in self.local])
        local += noise * field(100 + seed, (64, 64), 1.0)
        local /= np.linalg.norm(local, axis=0)
        sigma = np.full((64, 64), 3.0, dtype=np.float32)
        there = self.marks + LOW * TILE - xy
        mine = np.column_stack([c * there[:, 0] + s * there[:, 1], -s * there[:, 0] + c * there[:, 1]]) + 32.0
        near = ((mine > 0) & (mine < 64)).all(axis=1)
        column, row = mine[near].astype(int).T
        sigma[row, column] = 0.3
        nearest = np.hypot(*(self.place_at - xy).T).argmin()
        place = np.repeat(self.place[nearest][:, None], 256, axis=1).reshape(-1, 16, 16)
        inside = np.hypot(u, v) <= 30.0
        weight = np.where(inside, 1.0 / sigma, 0.0).astype(np.float32)
        return QueryFeatures(Features(local.astype(np.float32), sigma, place.astype(np.float32)), weight, centre)
