"""Bytes of a layer: what was written comes back, and nothing else is believed."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest

from coview_stream.basemap.site.layers import decode, encode
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
    with pytest.raises(MapError, match="is no layer of a tile"):
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
    with pytest.raises(MapError, match="is no layer of a tile"):
        decode(b"COVIEWL1" + len(header).to_bytes(4, "little") + header, "tile")


def test_array_that_unpacks_to_more_than_it_says_is_refused(packing):
    raw = encode({"a": np.zeros(1 << 20, dtype=np.uint8)}, packing)
    small = raw.replace(b"[1048576]", b"[1048575]")
    assert small != raw
    with pytest.raises(MapError, match="not 1048575"):
        decode(small, "tile")
