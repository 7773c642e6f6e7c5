"""The ``.coview`` file: saved content comes back, and damaged or foreign files are refused."""

import json
import os

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coview_stream.basemap import file_format
from coview_stream.basemap.site.manifest import read_manifest
from coview_stream.errors import MapError

PARAMETERS = {"config": {"block": 2.0}, "crs": 'PROJCS["Zürich"]', "sources": {"a.laz": "00ff"}}


def arrays(seed=0):
    rng = np.random.default_rng(seed)
    return {
        "origin": np.array([5e5, 5.4e6, 300.0]),
        "points": rng.normal(size=(40, 3)).astype(np.float32),
        "descriptor.coview": rng.normal(size=(3, 4, 6)).astype(np.float16),
        "tile_index": np.arange(8).reshape(2, 4),
        "normals": rng.integers(-127, 128, (40, 3)).astype(np.int8),
        "surveyed": np.ones((3, 5), np.uint8),
        "empty": np.empty((0, 3), np.float32),
    }


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "site.coview"
    file_format.save(path, arrays(), PARAMETERS)
    return path


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A saved map's bytes, and a name to write damaged copies to."""
    path = tmp_path_factory.mktemp("damage") / "site.coview"
    file_format.save(path, arrays(), PARAMETERS)
    return path.read_bytes(), path.with_name("damaged.coview")


def test_map_file_round_trip(path):
    loaded, parameters, digest = file_format.load(path)
    assert parameters == PARAMETERS
    assert set(loaded) == set(arrays())
    for name, array in arrays().items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array)
        if name != "empty":
            assert isinstance(loaded[name], np.memmap)
            with pytest.raises(ValueError, match="read-only"):
                loaded[name][...] = 0
    assert len(digest) == 64


def test_equal_content_has_an_equal_hash(tmp_path):
    backwards = dict(reversed(arrays().items()))
    shuffled = dict(reversed(PARAMETERS.items()))
    one = file_format.save(tmp_path / "one.coview", arrays(), PARAMETERS)
    two = file_format.save(tmp_path / "two.coview", backwards, shuffled)
    assert one == two == file_format.load(tmp_path / "two.coview")[2]
    turned = {name: np.asfortranarray(array) for name, array in arrays().items()}
    assert file_format.save(tmp_path / "turned.coview", turned, PARAMETERS) == one
    np.testing.assert_array_equal(file_format.load(tmp_path / "turned.coview")[0]["points"], arrays()["points"])


@pytest.mark.slow
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@example(where=0.0, bit=0)
@example(where=0.9999999, bit=7)
@settings(max_examples=300, deadline=None)
def test_flipped_bit_anywhere_is_detected(shared, where, bit):
    content, target = shared
    at = int(where * len(content))
    target.write_bytes(content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :])
    with pytest.raises(MapError, match=r"damaged\.coview"):
        file_format.load(target)


@pytest.mark.parametrize("length", range(8))
def test_changed_header_padding_is_detected(tmp_path, length):
    """Also the blanks between header and arrays, which JSON would not mind; there are 0 to 7 of them."""
    path = tmp_path / "site.coview"
    file_format.save(path, {"origin": np.arange(3.0)}, {"crs": "x" * length})
    content = path.read_bytes()
    end = 8 + int.from_bytes(content[:8], "little")
    for at in range(end - 10, end):
        for byte in {ord(" "), ord("\n"), ord("0")} - {content[at]}:
            path.write_bytes(content[:at] + bytes([byte]) + content[at + 1 :])
            with pytest.raises(MapError):
                file_format.load(path)


@given(share=st.floats(0, 1, exclude_max=True))
@example(share=0.0)
@settings(max_examples=60, deadline=None)
def test_truncated_map_file_is_detected(shared, share):
    content, target = shared
    target.write_bytes(content[: int(share * len(content))])
    with pytest.raises(MapError, match=r"damaged\.coview"):
        file_format.load(target)


def rewrite_header(path, change):
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    change(header)
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + size :])


def test_unsupported_version_is_named(path):
    rewrite_header(path, lambda header: header["__metadata__"].update(version="2"))
    with pytest.raises(MapError, match=r"format 2, this program reads 1; build the map again"):
        file_format.load(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda h: h["points"].update(dtype="F99"),
        lambda h: h["points"].update(data_offsets=[0, 10**12]),
        lambda h: h["points"].update(data_offsets=None),
        lambda h: h.update(points=None),
        lambda h: h.update(more=[1, 2]),
        lambda h: h["__metadata__"].pop("parameters"),
        lambda h: h["__metadata__"].update(parameters="{"),
        lambda h: h["__metadata__"].pop("sha256"),
        lambda h: h["__metadata__"].pop("format"),
        lambda h: h.update(__metadata__=7),
    ],
)
def test_forged_header_is_refused(path, change):
    rewrite_header(path, change)
    with pytest.raises(MapError, match=r"site\.coview"):
        file_format.load(path)


@pytest.mark.parametrize(
    "content",
    [b"", b"\x00" * 8, b"LASF" + b"\x00" * 400, b"{}", b"\x02" + b"\x00" * 7 + b"{}", b"\xff" * 100, b"7 text\n" * 50],
)
def test_file_that_is_not_a_map_is_refused(tmp_path, content):
    path = tmp_path / "other.coview"
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"other\.coview: not a coview map"):
        file_format.load(path)


def test_missing_files_and_directories_are_refused(tmp_path):
    os.mkfifo(tmp_path / "manifest.json")  # nobody writes to it
    for path in (tmp_path / "none.coview", tmp_path, tmp_path / "manifest.json"):
        with pytest.raises(MapError, match="cannot read the map"):
            file_format.load(path)
    with pytest.raises(MapError, match="it is a pipe"):
        read_manifest(tmp_path)
    with pytest.raises(MapError, match=r"a directory that exists"):
        file_format.save(tmp_path / "no" / "site.coview", arrays(), PARAMETERS)


def test_saving_over_a_loaded_map_keeps_it_readable(path):
    loaded, _, _ = file_format.load(path)
    file_format.save(path, {"points": np.zeros((5, 3), np.float32)}, {})
    np.testing.assert_array_equal(loaded["points"], arrays()["points"])
    assert file_format.load(path)[0]["points"].shape == (5, 3)


def test_the_file_is_valid_safetensors(path):
    from safetensors.numpy import load_file

    loaded = load_file(path)
    assert sorted(loaded) == sorted(arrays())
    for name, array in arrays().items():
        np.testing.assert_array_equal(loaded[name], array)


def test_without_check_only_the_header_is_read(shared):
    content, path = shared
    damaged = bytearray(content)
    damaged[-1] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(MapError, match="checksum differs"):
        file_format.load(path)
    path.write_bytes(content)
    sha256 = file_format.load(path)[2]
    path.write_bytes(damaged)
    assert file_format.load(path, check=False)[2] == sha256
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(MapError, match="damaged or truncated"):
        file_format.load(path, check=False)
