"""Headers of LAS files read without a decoder, and files of LASzip 1.0."""

from __future__ import annotations

import struct

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from coview_stream.clouds.files import read_cloud
from coview_stream.clouds.las_header import read_las_header
from coview_stream.errors import CloudError


def written(path, points, version="1.2", point_format=1, vlrs=()):
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points.min(axis=0))
    header.vlrs.extend(vlrs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)
    return path


def geo_keys(**keys):
    vlr = GeoKeyDirectoryVlr()
    rows = [(1, 1, 0, len(keys)), *((int(key[1:]), 0, 1, value) for key, value in keys.items())]
    vlr.parse_record_data(np.array(rows, "<u2").tobytes())
    return vlr


def without_chunks(path):
    """Rewrite a LAZ file of one chunk as LASzip 1.0 did: no table of chunks, and its place is not stated."""
    raw = bytearray(path.read_bytes())
    start = struct.unpack_from("<I", raw, 96)[0]
    table = struct.unpack_from("<q", raw, start)[0]
    out = raw[:start] + raw[start + 8 : table]
    at = out.find(b"laszip encoded") + 52
    struct.pack_into("<H", out, at, 1)
    struct.pack_into("<I", out, at + 12, 0)
    path.write_bytes(out)


@pytest.fixture
def points():
    return np.random.default_rng(4).uniform((5e5, 5.4e6, 100), (5.002e5, 5.4001e6, 130), (3000, 3))


@pytest.mark.parametrize(("version", "point_format", "suffix"), [("1.2", 1, "las"), ("1.4", 6, "laz")])
def test_header_has_extent_count_and_keys(tmp_path, points, version, point_format, suffix):
    path = written(tmp_path / f"a.{suffix}", points, version, point_format, [geo_keys(k1024=1, k3072=25832)])
    header = read_las_header(path)
    assert header.points == len(points)
    np.testing.assert_allclose(header.low, points.min(axis=0), atol=0.002)
    np.testing.assert_allclose(header.high, points.max(axis=0), atol=0.002)
    assert header.geo_keys[3072] == 25832
    assert (header.compressor is None) == (suffix == "las")


def test_header_has_the_text_of_the_system(tmp_path, points):
    path = written(tmp_path / "a.laz", points, "1.4", 6, [WktCoordinateSystemVlr('PROJCS["a place"]')])
    assert read_las_header(path).wkt == 'PROJCS["a place"]'


@pytest.mark.parametrize("size", [0, 100, 226])
def test_cut_header_is_an_error(tmp_path, points, size):
    path = written(tmp_path / "a.las", points, vlrs=[geo_keys(k3072=25832)])
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ValueError, match="cut off"):
        read_las_header(path)


def test_header_without_its_records_has_no_keys(tmp_path, points):
    path = written(tmp_path / "a.las", points, vlrs=[geo_keys(k3072=25832)])
    path.write_bytes(path.read_bytes()[:240])
    assert read_las_header(path).geo_keys == {}


def test_file_of_laszip_1_0_is_read_as_any_other(tmp_path, points):
    path = written(tmp_path / "a.laz", points)
    expected = read_cloud(path)
    without_chunks(path)
    assert read_las_header(path).compressor == 1
    np.testing.assert_array_equal(read_cloud(path).map_points(), expected.map_points())


def test_truncated_file_of_laszip_1_0_is_refused(tmp_path, points):
    path = written(tmp_path / "a.laz", points)
    without_chunks(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(CloudError, match=r"a\.laz"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("keys", "says"),
    [({"k1024": 1, "k3072": 2277}, "feet"), ({"k2048": 4326}, "degrees"), ({"k3072": 25832, "k4099": 9002}, "heights")],
)
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_file_that_is_not_in_metres_is_refused_by_its_keys(tmp_path, keys, says, suffix):
    pytest.importorskip("pyproj", reason="pyproj is not there; pip install pyproj")
    points = np.random.default_rng(5).uniform((8.0, 50.0, 100), (8.01, 50.01, 130), (500, 3))
    path = written(tmp_path / f"a.{suffix}", points, vlrs=[geo_keys(**keys)])
    with pytest.raises(CloudError, match=says):
        read_cloud(path)
