"""Reference systems: units, heights, scales, equality; and places on Earth, against pyproj and geometry."""

import math
import re
import sys

import numpy as np
import pyproj
import pytest

from coview_stream.clouds.reference_system import GeoReference, flaw_of_system, same_system, short_name, stated_system
from coview_stream.errors import InputError


def flaw(text, place, keys=None):
    centre = np.array(place, dtype=float)
    return flaw_of_system(text, keys or {}, centre - 50.0, centre + 50.0)


@pytest.mark.parametrize(
    ("text", "place", "keys", "says"),
    [
        ("EPSG:2277", (3.1e6, 1.0e7, 500), {}, "coordinates are in US survey feet .*EPSG:32614"),
        ("EPSG:2994", (6.4e5, 8.5e5, 400), {}, "coordinates are in feet"),
        (None, (1000, 1000, 0), {3076: 9002}, "coordinates are in feet"),
        ("EPSG:25832", (5e5, 5.4e6, 100), {4099: 9003}, "heights are in US survey feet"),
        ("EPSG:26910+6360", (5e5, 5.4e6, 100), {}, "heights are in US survey feet"),
        ("EPSG:4326", (8.1, 50.2, 100), {}, "in degrees .*EPSG:32632"),
        ("EPSG:4978", (4e6, 6e5, 4.8e6), {}, "geocentric"),
        ("EPSG:3857", (6e5, 6.8e6, 0), {}, "lengths are 1.62 times"),
        ("EPSG:3395", (6e5, 6.8e6, 0), {}, "lengths are 1.6"),
    ],
)
def test_system_that_is_not_metric_is_refused_with_the_reason(text, place, keys, says):
    found = flaw(text, place, keys)
    assert found is not None
    assert re.search(says, found), found


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("EPSG:25832", (5e5, 5.4e6, 100)),
        ("EPSG:25832+7837", (5e5, 5.4e6, 100)),
        ("EPSG:28992", (8.5e4, 4.47e5, 0)),
        ("EPSG:27700", (5.3e5, 1.8e5, 0)),
        ("EPSG:2193", (1.6e6, 5.4e6, 0)),
        ("EPSG:25832", (12.0, 34.0, 0)),  # local coordinates that only say so
        ("EPSG:4326", (5e5, 5.4e6, 100)),  # likewise
        ("EPSG:99999", (1, 1, 1)),
        ("no system at all", (1, 1, 1)),
        (None, (1, 1, 1)),
    ],
)
def test_metric_system_and_unknown_one_pass(text, place):
    assert flaw(text, place) is None


def test_system_comes_from_text_or_from_keys():
    assert stated_system("PROJCS[...]", {3072: 25832}) == "PROJCS[...]"
    assert stated_system("", {3072: 25832}) == "EPSG:25832"
    assert stated_system("", {3072: 25832, 4096: 5783}) == "EPSG:25832+5783"
    assert stated_system("", {2048: 4326}) == "EPSG:4326"
    assert stated_system("", {3072: 32767, 3076: 9001}) is None


def test_systems_are_compared_by_meaning():
    text = pyproj.CRS(25832).to_wkt("WKT1_GDAL")
    assert same_system("EPSG:25832", text)
    assert same_system("EPSG:25832", "EPSG:25832+7837")  # the first says nothing of heights
    assert same_system(None, text)
    assert not same_system(text, "EPSG:25833")
    assert not same_system("EPSG:25832+7837", "EPSG:25832+5783")
    assert short_name("EPSG:25832").startswith("EPSG:25832 ETRS89")


def test_without_pyproj_units_in_the_file_still_count(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert flaw('PROJCS["x",UNIT["US survey foot",0.3048006]]', (1e6, 1e6, 0)) is not None
    assert flaw(None, (1, 1, 0), {3076: 9003}) is not None
    assert flaw("EPSG:2277", (3.1e6, 1.0e7, 500)) is None
    assert not same_system("EPSG:2277", "EPSG:2278")


def test_known_place_has_its_coordinates():
    place = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform(8.5, 50.1)
    latitude, longitude, height = GeoReference("EPSG:25832").geodetic(np.array([[*place, 123.0]]))[0]
    assert (latitude, longitude, height) == pytest.approx((50.1, 8.5, 123.0), abs=1e-9)


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:32633", "EPSG:28992", "EPSG:2193"])
def test_heading_is_that_of_the_geodesic(crs):
    """Ten metres ahead on the map lie in the direction of the heading, up to the projection's distortion of angles."""
    geo = GeoReference(crs)
    area = pyproj.CRS(crs).area_of_use
    there = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(
        0.7 * area.west + 0.3 * area.east, 0.5 * (area.south + area.north)
    )
    position = np.array([*there, 0.0])
    for yaw in (0.0, 0.5, math.pi / 2, 3.0, -2.0):
        ahead = position + 10.0 * np.array([math.cos(yaw), math.sin(yaw), 0.0])
        (lat, lon, _), (lat_a, lon_a, _) = geo.geodetic(np.stack([position, ahead]))
        bearing, _, metres = pyproj.Geod(ellps="WGS84").inv(lon, lat, lon_a, lat_a)
        off = (math.degrees(geo.heading(position, yaw)) - bearing + 180.0) % 360.0 - 180.0
        assert abs(off) < 0.05
        assert metres == pytest.approx(10.0, rel=0.005)


def test_covariance_turns_with_the_axes():
    geo = GeoReference("EPSG:25832")
    position = np.array([700_000.0, 5_600_000.0, 100.0])  # two degrees of convergence
    angle = geo.convergence(position)
    assert abs(math.degrees(angle)) > 1.0
    north = np.array([0.0, 1.0, 0.0])
    found = geo.enu_covariance(position, np.outer(north, north))
    # the map's north points by the angle to the east of true north
    assert found[0, 0] == pytest.approx(math.sin(angle) ** 2, abs=1e-9)
    assert np.sign(found[0, 1]) == np.sign(math.sin(angle))
    np.testing.assert_allclose(np.trace(found), 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("crs", "says"), [(None, "build it with --crs"), ("nonsense", "no place on Earth")])
def test_map_without_a_place_on_earth_says_so(crs, says):
    with pytest.raises(InputError, match=says):
        GeoReference(crs)


def test_position_outside_the_system_has_no_place():
    assert np.isnan(GeoReference("EPSG:25832").geodetic(np.array([[1e30, 1e30, 0.0]]))).all()
