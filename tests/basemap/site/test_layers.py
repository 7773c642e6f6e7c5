"""Layers of tiles: exact bytes, bounded errors of points and normals, hostile input."""

import contextlib
import json
import tracemalloc

import numpy as np
import pytest

from coview_stream.basemap.site.layers import (
    STEPS,
    cloud_layer,
    decode,
    encode,
    most_bytes,
    read_cloud_layer,
    read_stations_layer,
    stations_layer,
)
from coview_stream.clouds.filters import voxel_grid
from coview_stream.errors import MapError

RNG = np.random.default_rng(4)
ARRAYS = {
    "levels": RNG.integers(-4, 900, 1000).astype(np.int32),
    "counts": RNG.integers(0, 3, (40, 50)).astype(np.uint16),
    "inside": RNG.integers(0, 12, (3, 77)).astype(np.uint8),
    "place": RNG.normal(size=(5, 2)).astype(np.float32),
    "none": np.zeros((0, 2), dtype=np.int8),
}


@pytest.fixture(params=["bz2", "lzma"])
def packing(request):
    return request.param


def test_arrays_come_back_and_the_same_arrays_are_the_same_bytes(packing):
    raw = encode(ARRAYS, packing)
    assert raw == encode(dict(reversed(ARRAYS.items())), packing)
    found = decode(raw, "a")
    assert set(found) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("at", [0, 9, 20, 300, -1])
def test_changed_bytes_are_refused_or_change_only_numbers(at, packing):
    raw = bytearray(encode(ARRAYS, packing))
    raw[at] ^= 0x5A
    with contextlib.suppress(MapError):  # the error of a layer, and no other
        found = decode(bytes(raw), "tile")
        assert sum(found[name].nbytes for name in found) < 1 << 20


@pytest.mark.parametrize("cut", [0, 7, 30, 200, -1])
def test_cut_bytes_are_refused(cut, packing):
    with pytest.raises(MapError, match="is not a layer of a tile"):
        decode(encode(ARRAYS, packing)[:cut], "tile")


@pytest.mark.parametrize("other", ["zip2", 7, None])
def test_unknown_packings_are_refused(other):
    raw = encode({"a": np.arange(9, dtype=np.uint8)})
    size = int.from_bytes(raw[8:12], "little")
    entries = json.loads(raw[12 : 12 + size])
    entries[0]["packing"] = other
    header = json.dumps(entries).encode()
    with pytest.raises(MapError, match="not known"):
        decode(raw[:8] + len(header).to_bytes(4, "little") + header + raw[12 + size :], "tile")


@pytest.mark.parametrize("shape", [[1 << 30], [1 << 15, 1 << 15], [-1], [2.0], ["a"], [1, 1, 1, 1, 1]])
def test_impossible_shapes_take_no_memory(shape):
    header = json.dumps([{"name": "a", "type": "f4", "shape": shape, "bytes": 0}]).encode()
    with pytest.raises(MapError, match="is not a layer of a tile"):
        decode(b"COVIEWL1" + len(header).to_bytes(4, "little") + header, "tile")


def test_array_that_unpacks_to_more_than_it_says_is_refused(packing):
    raw = encode({"a": np.zeros(1 << 20, dtype=np.uint8)}, packing)
    small = raw.replace(b"[1048576]", b"[1048575]")
    assert small != raw
    with pytest.raises(MapError, match="not 1048575"):
        decode(small, "tile")


TILE, VOXEL = 320.0, 0.25
CORNER = np.array([-640.0, 320.0, 0.0])


def cloud(count=20_000):
    rng = np.random.default_rng(8)
    raw = rng.uniform([0.0, 0.0, -9.0], [TILE, TILE, 40.0], (count, 3)).astype(np.float32)
    points = voxel_grid(raw, VOXEL)
    normals = rng.normal(size=points.shape)
    normals[:, 2] = np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return points, normals.astype(np.float32), rng.uniform(0.2, 1.0, len(points)).astype(np.float32)


def test_points_normals_and_planarity_come_back_within_their_steps():
    points, normals, planarity = cloud()
    layer = cloud_layer(points, normals, planarity, TILE, VOXEL)
    found, packed = read_cloud_layer(layer, CORNER, TILE, VOXEL)
    cells = np.floor(points / VOXEL)
    order = np.lexsort((cells[:, 2], cells[:, 0], cells[:, 1]))
    assert np.abs(found - CORNER - points[order]).max() <= 0.5 * VOXEL / STEPS + 1e-4
    length = np.linalg.norm(packed.astype(np.float64), axis=1)
    np.testing.assert_allclose(length / 127.0, planarity[order], atol=0.05)
    cosine = (packed * normals[order]).sum(axis=1) / length
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < 4.0


def test_bytes_a_point():
    """A flat street: the ground's points are next to each other, and their normals alike."""
    x, y = (each.ravel() for each in np.meshgrid(*(np.arange(0.125, 100.0, 0.25),) * 2))
    points = np.column_stack([x, y, 0.02 * np.random.default_rng(1).normal(size=x.size)]).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    layer = cloud_layer(points, normals, np.ones(len(points), np.float32), TILE, VOXEL)
    assert len(encode(layer)) < 2.0 * len(points)


@pytest.mark.parametrize("name", ["counts", "levels", "inside", "normals", "planarity"])
def test_arrays_that_do_not_fit_together_are_refused(name):
    layer = cloud_layer(*cloud(500), TILE, VOXEL)
    for wrong in (layer[name][:-1], layer[name].astype(np.float32), None):
        other = {k: v for k, v in layer.items() if k != name} | ({} if wrong is None else {name: wrong})
        with pytest.raises(MapError, match="tile's cloud"):
            read_cloud_layer(other, CORNER, TILE, VOXEL)


def test_stations_come_back_to_the_centimetre():
    rng = np.random.default_rng(2)
    cells = np.unique(rng.integers(-300, 300, (400, 2)), axis=0)
    stations = np.column_stack([(cells + 0.5) * 2.0, rng.uniform(-20.0, 90.0, len(cells))]).astype(np.float32)
    found = read_stations_layer(stations_layer(stations, 2.0), 2.0)
    order = np.lexsort((stations[:, 2], stations[:, 0], stations[:, 1]))
    np.testing.assert_array_equal(found[:, :2], stations[order, :2])
    assert np.abs(found[:, 2] - stations[order, 2]).max() <= 0.0051
    with pytest.raises(MapError, match="stations"):
        read_stations_layer({"steps": np.zeros((2, 5), dtype=np.int32)}, 2.0)


@pytest.mark.slow
def test_layer_unpacks_to_no_more_than_it_may(packing):
    size = sum(array.nbytes for array in ARRAYS.values())
    assert len(decode(encode(ARRAYS, packing), "tile", size)) == len(ARRAYS)
    with pytest.raises(MapError, match="too large"):
        decode(encode(ARRAYS, packing), "tile", size - 1)
    zeros = encode({"levels": np.zeros(1 << 22, dtype=np.int32)}, "bz2")  # 17 MB of a few bytes
    tracemalloc.start()
    with pytest.raises(MapError, match="too large"):
        decode(zeros, "tile", most_bytes("cloud", 1000, 10, 20.0, 0.25))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.slow
def test_cloud_is_unpacked_in_little_more_memory_than_it_takes():
    number, across = 1 << 20, 64
    layer = {
        "counts": np.full((across, across), number // across**2, dtype=np.uint16),
        "levels": np.zeros(number, dtype=np.int32),
        "inside": np.zeros((3, number), dtype=np.uint8),
        "normals": np.zeros((number, 2), dtype=np.uint8),
        "planarity": np.zeros(number, dtype=np.uint8),
    }
    tracemalloc.start()
    points, _ = read_cloud_layer(layer, np.zeros(3), 16.0, 0.25)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(points) == number
    assert peak < 80 * number  # was 190: 15 are the result
