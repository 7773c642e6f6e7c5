"""Latitude, longitude, heading and covariance of places in maps, against pyproj and geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from coview_stream.clouds.reference_system import GeoReference
from coview_stream.errors import InputError

pyproj = pytest.importorskip("pyproj", reason="pyproj is not there; pip install 'coview-stream[geo]'")


def test_known_place_has_its_coordinates():
    place = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform(8.5, 50.1)
    latitude, longitude, height = GeoReference("EPSG:25832").geodetic(np.array([[*place, 123.0]]))[0]
    assert (latitude, longitude, height) == pytest.approx((50.1, 8.5, 123.0), abs=1e-9)


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:32633", "EPSG:28992", "EPSG:2193"])
def test_heading_is_that_of_the_geodesic(crs):
    """Ten metres ahead on the map lie where the heading says, within what a projection's scale does to angles."""
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


@pytest.mark.parametrize(("crs", "says"), [(None, "build it with --crs"), ("nonsense", "no place on Earth")])
def test_map_without_a_place_on_earth_says_so(crs, says):
    with pytest.raises(InputError, match=says):
        GeoReference(crs)


def test_position_outside_the_system_has_no_place():
    assert np.isnan(GeoReference("EPSG:25832").geodetic(np.array([[1e30, 1e30, 0.0]]))).all()
