"""Exported trajectories, read back by what reads such files."""

import csv
import io
import json
from xml.etree import ElementTree

import numpy as np
import pytest

from coview_stream.clouds.reference_system import GeoReference
from coview_stream.errors import ConfigError, InputError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.report.export import FORMATS, chosen_formats, export, reference_for, trajectory_of

STAMPS = [1_700_000_000.25, 1_700_000_001.5, 1_700_000_002.0]
POSES = [pose_from(rot_z(0.1 * k), [500_000.0 + k, 5_400_000.0 - 2 * k, 100.0 + k]) for k in range(3)]


@pytest.fixture
def located():
    return trajectory_of("a <run> & more", STAMPS, POSES, GeoReference("EPSG:25832"))


def test_csv(located):
    rows = list(csv.DictReader(io.StringIO(FORMATS["csv"][1](located))))
    assert [float(row["stamp"]) for row in rows] == STAMPS
    assert [float(row["y"]) for row in rows] == [5_400_000.0, 5_399_998.0, 5_399_996.0]
    np.testing.assert_allclose([[float(r["latitude"]), float(r["height"])] for r in rows], located.geodetic[:, (0, 2)])
    plain = trajectory_of("run", STAMPS, POSES, None)
    assert "latitude" not in FORMATS["csv"][1](plain)


def test_kitti(located):
    rows = np.loadtxt(io.StringIO(FORMATS["kitti"][1](located))).reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, np.array(POSES)[:, :3], rtol=1e-9)


def test_geojson(located):
    document = json.loads(FORMATS["geojson"][1](located))
    line, *points = document["features"]
    assert line["geometry"]["type"] == "LineString"
    assert line["properties"]["name"] == "a <run> & more"
    np.testing.assert_allclose(np.array(line["geometry"]["coordinates"])[:, (1, 0, 2)], located.geodetic, atol=1e-3)
    assert points[0]["properties"] == {"stamp": STAMPS[0], "time": "2023-11-14T22:13:20.250Z"}


def test_gpx(located):
    root = ElementTree.fromstring(FORMATS["gpx"][1](located))
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    assert root.findtext("g:trk/g:name", namespaces=space) == "a <run> & more"
    points = root.findall(".//g:trkpt", space)
    np.testing.assert_allclose([[float(p.get("lat")), float(p.get("lon"))] for p in points], located.geodetic[:, :2])
    assert points[1].findtext("g:time", namespaces=space) == "2023-11-14T22:13:21.500Z"


@pytest.mark.parametrize("name", ["geojson", "gpx"])
def test_poses_nowhere_on_earth_are_refused(name):
    far = [POSES[0], POSES[1] + pose_from(np.zeros((3, 3)), [1e9, 0.0, 0.0]), POSES[2]]
    lost = trajectory_of("run", STAMPS, far, GeoReference("EPSG:25832"))
    with pytest.raises(InputError, match=r"run: 1 of 3 poses lie nowhere on Earth.*export csv.*--crs"):
        FORMATS[name][1](lost)


def test_stamps_that_are_no_times_of_day_are_none():
    found = trajectory_of("run", [0.1, 0.2, 0.3], POSES, GeoReference("EPSG:25832"))
    assert "<time>" not in FORMATS["gpx"][1](found)


def test_nothing_localized_gives_whole_and_empty_files(tmp_path):
    empty = trajectory_of("run", [], [], GeoReference("EPSG:25832"))
    for path in export(empty, tmp_path, tuple(FORMATS)):
        assert path.exists()
    assert json.loads((tmp_path / "trajectory.geojson").read_text())["features"] == []
    ElementTree.parse(tmp_path / "trajectory.gpx")


def test_formats_are_chosen_by_name_and_those_on_earth_need_a_system():
    assert chosen_formats("csv, gpx,csv") == ("csv", "gpx")
    for wrong in ("", "kml", "csv,"[:0]):
        with pytest.raises(ConfigError, match="csv, kitti, geojson, gpx"):
            chosen_formats(wrong)
    assert reference_for(None, ("csv", "kitti")) is None
    with pytest.raises(InputError, match="--crs"):
        reference_for(None, ("gpx",))
