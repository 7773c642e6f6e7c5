"""Picture of a map from above: what stands is told apart, and lies where it is."""

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import InputError
from coview_stream.report.relief import Relief, plot_map, relief, write_geotiff

ROOF, TREE, GROUND = (214, 122, 92), (112, 164, 108), (236, 230, 214)
CENTRES = {ROOF: (-15.0, 0.0), TREE: (15.0, 0.0), GROUND: (0.0, 20.0)}
ORIGIN = np.array([448_000.0, 5_400_000.0, 90.0])


@pytest.fixture(scope="module")
def site():
    """A slope with a house and a crown of branches on it, 20 points a square metre."""
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-30, 30, (72_000, 2)), np.zeros(72_000)])
    house = (np.abs(points[:, :2] - CENTRES[ROOF]) < 5.0).all(axis=1)
    crown = np.linalg.norm(points[:, :2] - CENTRES[TREE], axis=1) < 5.0
    points[house, 2] = 6.0 + 0.02 * rng.normal(size=house.sum())
    points[crown, 2] = rng.uniform(3.0, 9.0, crown.sum())
    points[:, 2] += 0.3 * points[:, 1]
    return BaseMap.build(points + ORIGIN, radius=20.0)


def hue_at(seen, at):
    """The colour, without its brightness, that most squares within 3 m of a place have."""
    column, row = ((np.array(at) + ORIGIN[:2] - seen.corner) / seen.cell).astype(int)
    reach = int(3.0 / seen.cell)
    around = seen.rgba[row - reach : row + reach, column - reach : column + reach, :3].reshape(-1, 3).astype(float)
    share = around / around.sum(axis=1, keepdims=True)
    known = np.array(list(CENTRES), dtype=float)
    known /= known.sum(axis=1, keepdims=True)
    nearest = np.argmin(np.linalg.norm(share[:, None] - known, axis=2), axis=1)
    return list(CENTRES)[np.bincount(nearest, minlength=3).argmax()]


@pytest.mark.slow
def test_roofs_trees_and_ground_are_told_apart_on_a_slope(site, monkeypatch):
    monkeypatch.setattr(np, "empty", lambda *shape, **kind: np.full(*shape, np.nan, **kind))  # as memory may be
    seen = relief(site)
    assert {colour: hue_at(seen, at) for colour, at in CENTRES.items()} == {colour: colour for colour in CENTRES}


@pytest.mark.slow
def test_plot_has_stations_where_they_leave_the_map_to_see(site, tmp_path):
    from matplotlib import image

    plot_map(site, tmp_path / "map.png")
    picture = image.imread(tmp_path / "map.png")
    assert min(picture.shape[:2]) > 500
    blue = picture[..., 2] - picture[..., 0] > 0.2
    assert 100 < blue.sum() < 0.1 * blue.size
    with pytest.raises(InputError, match="cannot be written"):
        plot_map(site, tmp_path / "missing" / "map.tif")


def test_geotiff_is_read_by_others_where_it_lies(tmp_path):
    rgba = np.zeros((30, 50, 4), dtype=np.uint8)
    rgba[0] = (10, 20, 30, 255)  # the south
    write_geotiff(Relief(rgba, ORIGIN[:2], 0.5), tmp_path / "map.tif", None)
    pillow = pytest.importorskip("PIL.Image")
    with pillow.open(tmp_path / "map.tif") as picture:
        assert picture.size == (50, 30)
        assert picture.getpixel((0, 29)) == (10, 20, 30, 255)
        assert picture.getpixel((0, 0)) == (0, 0, 0, 0)
        assert picture.tag_v2[33550] == (0.5, 0.5, 0.0)
        assert picture.tag_v2[33922] == (0.0, 0.0, 0.0, 448_000.0, 5_400_015.0, 0.0)


def test_geotiff_names_its_reference_system(tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    write_geotiff(Relief(np.zeros((2, 2, 4), np.uint8), ORIGIN[:2], 0.5), tmp_path / "map.tif", "EPSG:25832")
    with pillow.open(tmp_path / "map.tif") as picture:
        assert picture.tag_v2[34735] == (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 25832)
