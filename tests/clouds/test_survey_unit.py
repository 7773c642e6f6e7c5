"""Surveys in feet: their unit, the same system in metres, and maps of them."""

import numpy as np
import pyproj
import pytest
from las_file import written
from laspy.vlrs.known import WktCoordinateSystemVlr

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.site.site_build import build_site
from coview_stream.basemap.sources import sources_of
from coview_stream.cli import main
from coview_stream.clouds.reference_system import GeoReference
from coview_stream.clouds.survey_unit import US_FOOT, unit_of_system
from coview_stream.config import map_preset
from coview_stream.errors import CloudError, CoViewWarning


@pytest.mark.parametrize(
    ("text", "keys", "name", "metres"),
    [
        ("feet", {}, "feet", [0.3048] * 3),
        ("us-feet", {}, "US survey feet", [US_FOOT] * 3),
        ("EPSG:2263", {}, "US survey feet", [US_FOOT] * 3),
        ("EPSG:2994", {}, "feet", [0.3048] * 3),
        ("EPSG:2263+5703", {}, "US survey feet", [US_FOOT, US_FOOT, 1.0]),
        ("EPSG:26910+6360", {}, "metres, and heights in US survey feet", [1.0, 1.0, US_FOOT]),
        ("EPSG:25832", {4099: 9002}, "metres, and heights in feet", [1.0, 1.0, 0.3048]),
        ("EPSG:2263", {4099: 9001}, "US survey feet", [US_FOOT, US_FOOT, 1.0]),
        (None, {3076: 9003}, "feet", [US_FOOT] * 3),
    ],
)
def test_unit_is_that_of_the_system(text, keys, name, metres):
    unit = unit_of_system(text, keys)
    assert unit.name == name
    np.testing.assert_allclose(unit.metres, metres, rtol=1e-12)


@pytest.mark.parametrize("text", [None, "EPSG:25832", "EPSG:25832+7837", "EPSG:4326", "EPSG:4978", "nonsense"])
def test_other_systems_are_left_alone(text):
    assert unit_of_system(text) is None
    assert unit_of_system("EPSG:25832", {3076: 9002}) is None  # a contradiction, which is refused


def test_place_on_earth_stays():
    degrees = (-73.5, 40.8)
    at = pyproj.Transformer.from_crs(4326, 2263, always_xy=True).transform(*degrees)
    unit = unit_of_system("EPSG:2263")
    latitude, longitude, _ = GeoReference(unit.crs).geodetic(unit.to_metres([*at, 100.0]))[0]
    np.testing.assert_allclose((longitude, latitude), degrees, atol=1e-9)


@pytest.fixture(scope="module")
def survey(map_points):
    """(N, 3) metres in New York's plane."""
    return map_points[(np.abs(map_points[:, :2]) < 12.0).all(axis=1)] + (342_200.0, 70_400.0, 30.0)


def in_feet(path, survey, crs=None):
    system = [] if crs is None else [WktCoordinateSystemVlr(pyproj.CRS(crs).to_wkt())]
    return written(path, survey / US_FOOT, "1.4", 6, system)


@pytest.mark.slow
@pytest.mark.parametrize(("stated", "given"), [(2263, None), (None, "EPSG:2263"), (None, "us-feet")])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_map_of_a_survey_in_feet_is_in_metres(survey, tmp_path, stated, given, suffix):
    path = in_feet(tmp_path / f"a.{suffix}", survey, stated)
    with pytest.warns(CoViewWarning, match=r"in US survey feet; the map and its poses are in metres"):
        base_map = BaseMap.build(path, crs=given, radius=20.0)
    np.testing.assert_allclose(base_map.bounds, (survey.min(axis=0), survey.max(axis=0)), atol=0.5)
    assert "metre" in base_map.crs
    with pytest.warns(CoViewWarning, match="in US survey feet"):
        build_site([path], tmp_path / "site", map_preset("slam", learned=False, radius=20.0), crs=given)
    np.testing.assert_allclose(BaseMap.load(tmp_path / "site").bounds, base_map.bounds, atol=0.5)


def test_array_in_feet_and_a_file_whose_format_is_in_metres(survey, tmp_path):
    (source,) = sources_of(survey / US_FOOT, "EPSG:2263")
    np.testing.assert_allclose(source.read().map_points(), survey, atol=1e-3)
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    with pytest.raises(CloudError, match="E57 is in metres, not in feet"):
        sources_of(tmp_path / "a.e57", "feet")[0].unit_to_convert()


@pytest.mark.slow
def test_a_system_given_beside_a_stated_one_is_still_warned_of(survey, tmp_path, capsys):
    path = in_feet(tmp_path / "a.las", survey, 2263)
    words = ["build", str(path), "-o", str(tmp_path / "a.coview"), "--no-learned", "--radius", "20", "--crs"]
    assert main([*words, "EPSG:2263"]) == 0
    assert "ignored" not in capsys.readouterr().err
    assert main([*words, "feet"]) == 0
    assert "ignored" in capsys.readouterr().err
