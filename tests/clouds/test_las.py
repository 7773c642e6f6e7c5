"""LAS and LAZ: headers, reference systems, dropped points; LASzip 1.0 is refused."""

import re
import struct

import laspy
import numpy as np
import pytest
from las_file import written
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from coview_stream.clouds.cloud_head import read_head
from coview_stream.clouds.files import read_cloud, write_cloud
from coview_stream.errors import CloudError, CoViewWarning

UTM = np.array([351_154.5, 4_025_876.25, 14.0])
PROJECTED = 'PROJCS["x",GEOGCS["y",UNIT["degree",0.017]],UNIT["{unit}",1]]'


def geo_keys(**keys):
    vlr = GeoKeyDirectoryVlr()
    rows = [(1, 1, 0, len(keys)), *((int(key[1:]), 0, 1, value) for key, value in keys.items())]
    vlr.parse_record_data(np.array(rows, "<u2").tobytes())
    return vlr


@pytest.fixture
def points():
    return np.random.default_rng(4).uniform((5e5, 5.4e6, 100), (5.002e5, 5.4001e6, 130), (3000, 3))


@pytest.mark.parametrize(("version", "point_format", "suffix"), [("1.2", 1, "las"), ("1.4", 6, "laz")])
def test_points_and_system_by_its_keys_are_read(tmp_path, points, version, point_format, suffix):
    path = written(tmp_path / f"a.{suffix}", points, version, point_format, [geo_keys(k1024=1, k3072=25832)])
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.map_points(), points, atol=0.006)
    assert cloud.crs == "EPSG:25832"


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_system_must_be_in_metres(tmp_path, suffix):
    points = np.random.default_rng(5).uniform((8.0, 50.0, 100), (8.01, 50.01, 130), (500, 3))
    metric = WktCoordinateSystemVlr(PROJECTED.format(unit="metre"))
    assert read_cloud(written(tmp_path / f"b.{suffix}", points, "1.4", 6, [metric])).crs == metric.string
    for vlr, says in (
        (WktCoordinateSystemVlr('GEOGCS["WGS 84",UNIT["degree",0.017]]'), "degrees"),
        (geo_keys(k3072=25832, k3076=9002), "feet"),
        (geo_keys(k2048=4326), "degrees"),
    ):
        with pytest.raises(CloudError, match=says):
            read_cloud(written(tmp_path / f"a.{suffix}", points, "1.4", 6, [vlr]))


def test_withheld_and_noise_points_are_dropped_and_classes_kept(tmp_path):
    points = UTM + np.random.default_rng(1).normal(0, 20, (5, 3))
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), UTM
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.classification = np.array([2, 7, 6, 18, 1], np.uint8)
    las.withheld = np.array([0, 0, 0, 0, 1], np.uint8)
    las.write(tmp_path / "a.laz")
    cloud = read_cloud(tmp_path / "a.laz")
    assert cloud.dropped == 3
    assert cloud.classification.tolist() == [2, 6]
    np.testing.assert_allclose(cloud.map_points(), points[[0, 2]], atol=6e-3)


@pytest.mark.parametrize("size", [100, 226, 240])
def test_file_cut_in_its_header_is_refused(tmp_path, points, size):
    path = written(tmp_path / "a.las", points, vlrs=[geo_keys(k3072=25832)])
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(CloudError, match=r"a\.las: (damaged or )?truncated"):
        read_cloud(path)


def test_file_of_laszip_1_0_is_refused_with_the_remedy(tmp_path, points):
    path = written(tmp_path / "a.laz", points)
    raw = bytearray(path.read_bytes())
    struct.pack_into("<H", raw, raw.find(b"laszip encoded") + 52, 1)
    path.write_bytes(raw)
    with pytest.raises(CloudError, match=r"a\.laz: LAZ of LASzip 1\.0.* write it again with a newer LASzip"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_system_that_is_not_utf8_is_read_and_told(tmp_path, points, suffix, capfd):
    text = PROJECTED.replace('"x"', '"Gau\xdf"').format(unit="metre")
    path = written(
        tmp_path / f"a.{suffix}", points, "1.4", 6, [laspy.VLR("LASF_Projection", 2112, "", text.encode("latin-1"))]
    )
    with pytest.warns(CoViewWarning, match=rf"a\.{suffix}: its reference system is not UTF-8"):
        assert read_head(path).crs == text.replace("\xdf", "\ufffd")
    assert capfd.readouterr().err == ""  # laspy's own line


def test_full_disk_while_laz_is_written_is_one_line(tmp_path, points, full_disk):
    with full_disk(1000), pytest.raises(CloudError) as error:  # the header fits, the points do not
        write_cloud(tmp_path / "a.laz", points[:1000])
    assert re.fullmatch(r".*a\.laz: cannot be written \(.+\); check the directory and the disk", str(error.value))
    assert not list(tmp_path.iterdir())
