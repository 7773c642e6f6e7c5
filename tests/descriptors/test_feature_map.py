"""A map's learned features: made in windows that leave no trace, stored in tiles, read back where they belong."""

import numpy as np
import pytest
from scipy import ndimage

from coview_stream.basemap.basemap import BaseMap
from coview_stream.descriptors import feature_map
from coview_stream.descriptors.feature_map import (
    TILE,
    FeatureMap,
    dequantized,
    feature_arrays,
    quantized,
    quantized_sigma,
)
from coview_stream.descriptors.network import Features, network
from coview_stream.errors import MapError

MOST_BYTES_PER_KM2 = 64e6


def wood(seed=3, low=(-40.0, -70.0), size=(110.0, 90.0)):
    """Points of a slope with posts on it, somewhere about the origin."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(low, np.add(low, size), (30_000, 2))
    posts = np.repeat(rng.uniform(low, np.add(low, size), (120, 2)), 60, axis=0)
    xy = np.concatenate([ground, posts + rng.normal(0.0, 0.4, posts.shape)])
    up = np.concatenate([np.zeros(len(ground)), rng.uniform(0.0, 14.0, len(posts))])
    return np.column_stack([xy, 0.05 * xy[:, 0] + up]).astype(np.float32)


@pytest.fixture(scope="module")
def points():
    return wood()


@pytest.fixture(scope="module")
def built(points):
    return feature_arrays(points)


@pytest.fixture(scope="module")
def features(built):
    return FeatureMap(*built)


def by_place(arrays):
    """The same arrays with tiles and descriptors in the order of their places."""
    tiles = np.lexsort(arrays["learned.tiles"].T)
    places = np.lexsort(arrays["learned.place_at"].T)
    return {name: values[places if ".place" in name else tiles] for name, values in arrays.items()}


def test_quantized_vectors_and_sigmas_round_trip():
    vectors = np.linspace(-1.0, 1.0, 501, dtype=np.float32)
    assert np.abs(dequantized(quantized(vectors)) - vectors).max() <= 0.5 / 127 + 1e-6
    sigma = np.geomspace(0.02, 50.0, 300).astype(np.float32)
    read = 0.02 * (50.0 / 0.02) ** (quantized_sigma(sigma) / 255.0)  # as the file format has it
    assert np.abs(np.log(read / sigma)).max() < 0.016
    assert quantized_sigma(np.array([1e-6, 1e6], dtype=np.float32)).tolist() == [0, 255]


def far_sighted(image):
    """Stands in for the network: what it gives of a cell depends on all of its receptive field, to the same extent."""
    height, width = (n // 2 for n in image.shape[1:])
    shown = image[:-1].mean(axis=0).reshape(height, 2, width, 2).mean(axis=(1, 3))
    near = 0.7 * ndimage.uniform_filter(shown, 61, mode="constant")
    far = 0.7 * ndimage.uniform_filter(shown, 117, mode="constant")[2::4, 2::4]
    local, place = (np.stack([np.cos(each), np.sin(each)]).astype(np.float32) for each in (near, far))
    return Features(local, (1.0 + near).astype(np.float32), place)


def differing(one, other, name):
    """Share of the numbers that differ by more than int8 rounding."""
    assert one[name].shape == other[name].shape
    return (np.abs(one[name].astype(np.float64) - other[name]) > 1).mean()


@pytest.fixture
def encoder(monkeypatch, request):
    """The network, or its stand-in."""
    encode = network("aerial") if request.param == "aerial" else far_sighted
    monkeypatch.setattr(feature_map, "network", lambda *_: encode)


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ["aerial", "far-sighted"], indirect=True)
def test_feature_windows_leave_no_seams(points, encoder):
    """Many windows make of a map what one does: drawing and network see enough around each."""
    one, many = (by_place(feature_arrays(points, window=window)[0]) for window in (256, 64))
    for name in one:  # a rare point lies so near a layer's bound that rounding puts it to either side
        assert differing(one, many, name) < 1e-3, name


def test_feature_tiles_lie_on_fixed_grid_where_map_has_points(points, built):
    tiles = {tuple(t) for t in built[0]["learned.tiles"].tolist()}
    own = {tuple(t) for t in np.floor(points[:, :2] / TILE).astype(int).tolist()}
    assert own <= tiles
    low, high = points[:, :2].min(axis=0) - 4.0, points[:, :2].max(axis=0) + 4.0
    for tile in tiles:  # none farther than the known surroundings of points
        assert ((np.add(tile, 1) * TILE > low) & (np.multiply(tile, TILE) < high)).all()


def test_features_are_shift_equivariant_by_a_tile(points, features):
    moved = FeatureMap(*feature_arrays(points + np.float32([TILE, -2 * TILE, 0.0])))
    (here, corner), (there, other) = features.coarse(1.0), moved.coarse(1.0)
    np.testing.assert_allclose(other - corner, [TILE, -2 * TILE])
    assert np.abs(here).max() > 0.1
    assert (np.abs(here - there) > 1.01 / 127).mean() < 1e-3  # rounding puts a rare point to either side of a layer


def test_cells_hold_unit_vectors_or_zeros(points, features):
    local, corner = features.coarse(1.0)
    norms = np.linalg.norm(local, axis=0)
    known = norms > 0
    assert np.abs(norms[known] - 1.0).max() < 0.03
    x, y = np.meshgrid(*(corner[k] + np.arange(known.shape[1 - k]) + 0.5 for k in (0, 1)))
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    assert known[(x > low[0]) & (y > low[1]) & (x < high[0]) & (y < high[1])].all()
    assert not known[(x > high[0] + 5.0) | (y > high[1] + 5.0)].any()


@pytest.mark.parametrize("cell", [2, 4])
def test_coarse_cells_are_means(features, cell):
    coarse, corner = features.coarse(float(cell))
    assert not np.mod(corner, TILE).any()
    fine, same = features.coarse(1.0)
    np.testing.assert_array_equal(corner, same)
    rows, columns = (n // cell for n in fine.shape[1:])
    expected = fine.reshape(features.dimensions, rows, cell, columns, cell).mean(axis=(2, 4))
    np.testing.assert_allclose(coarse, expected, atol=1e-6)


def test_place_vectors_have_unit_norm_and_lie_in_the_map(points, features):
    assert np.abs(np.linalg.norm(dequantized(features.place), axis=1) - 1.0).max() < 0.05
    assert len(features.place) == len(np.unique(features.place_at, axis=0))
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    assert ((features.place_at > low - 8.0) & (features.place_at < high + 8.0)).all()


def test_feature_map_size_is_bounded(features):
    assert features.bytes / (len(features.index.tiles) * TILE**2) * 1e6 < 0.6 * MOST_BYTES_PER_KM2
    assert features.area == pytest.approx(118.0 * 98.0, rel=0.03)  # the map and four metres around it


def with_features(base_map, built):
    arrays, parameters = built
    return BaseMap({**base_map.arrays, **arrays}, {**base_map.parameters, "learned": parameters})


def test_map_file_keeps_features(world_map, built, tmp_path):
    with_features(world_map, built).save(tmp_path / "site.coview")
    loaded = BaseMap.load(tmp_path / "site.coview")
    for name, values in built[0].items():
        np.testing.assert_array_equal(loaded.arrays[name], values)
    again = loaded.learned
    np.testing.assert_array_equal(FeatureMap(*built).coarse(1.0)[0], again.coarse(1.0)[0])
    assert again.weights == built[1]["weights"] != ""


def test_maps_of_earlier_version_can_be_read(world_map):
    assert world_map.learned is None
    before = {n: v for n, v in world_map.parameters.items() if n != "learned"}
    before["config"] = {n: v for n, v in before["config"].items() if n != "learned"}
    old = BaseMap(dict(world_map.arrays), before)
    assert old.learned is None
    assert old.config.learned is False


@pytest.mark.parametrize("name", ["local", "sigma", "tiles", "place", "place_at"])
def test_incomplete_features_are_refused(world_map, built, name):
    arrays = {n: v for n, v in built[0].items() if n != f"learned.{name}"}
    with pytest.raises(MapError, match="build it again"):
        _ = with_features(world_map, (arrays, built[1])).learned
    short = {**built[0], f"learned.{name}": built[0][f"learned.{name}"][1:]}
    with pytest.raises(MapError, match="do not fit together"):
        FeatureMap(short, built[1])
