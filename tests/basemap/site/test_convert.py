"""Conversion of sites: light copies."""

import numpy as np
import pytest
from trackers import follow

from coview_stream import Localizer
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.site.convert import CUBE, lighten, one_of_each_cube
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.cli import main
from coview_stream.errors import MapError


def test_each_cube_keeps_the_point_nearest_to_its_mean():
    rng = np.random.default_rng(5)
    points = rng.uniform(-3.0, 3.0, (2000, 3)).astype(np.float32)
    chosen = one_of_each_cube(points)
    assert (np.diff(chosen) > 0).all()
    cells = np.floor(points / CUBE).astype(int)
    for cell in np.unique(cells, axis=0):
        inside = np.flatnonzero((cells == cell).all(axis=1))
        away = np.linalg.norm(points[inside] - points[inside].mean(axis=0), axis=1)
        kept = np.intersect1d(chosen, inside)
        assert len(kept) == 1
        assert np.linalg.norm(points[kept[0]] - points[inside].mean(axis=0)) == pytest.approx(away.min(), abs=1e-5)
    assert len(one_of_each_cube(points[:0])) == 0


@pytest.mark.slow
def test_light_copy_is_a_site_of_fewer_points_with_the_same_cells(site, cache, tmp_path):
    before = Manifest.load(site)
    light = lighten(site, tmp_path / "light")
    assert light == Manifest.load(tmp_path / "light")
    assert light.parameters["light"] == {"cube": CUBE, "of": before.sha256}
    assert light.nbytes < 0.7 * before.nbytes
    assert [tile.stations for tile in light.tiles] == [tile.stations for tile in before.tiles]
    whole, few = BaseMap.load(site), BaseMap.load(tmp_path / "light")
    np.testing.assert_array_equal(few.stations, whole.stations)
    from scipy.spatial import cKDTree

    assert cKDTree(whole.points).query(few.points)[0].max() < 0.04
    cells = [set(map(tuple, np.floor(each.points / CUBE).astype(int).tolist())) for each in (whole, few)]
    assert len(few.points) == len(cells[1]) == len(cells[0])
    assert len(cells[1] - cells[0]) < 0.02 * len(cells[0])  # rounded over a border
    assert lighten(site, tmp_path / "again").sha256 == light.sha256
    assert lighten(site, tmp_path / "light").sha256 == light.sha256  # in its place
    with pytest.raises(MapError, match="light copy already"):
        lighten(tmp_path / "light", tmp_path / "lighter")


@pytest.mark.slow
def test_robot_is_found_on_a_light_copy(site, cache, tmp_path, world_drive):
    lighten(site, tmp_path / "light")
    fixes = follow(Localizer(BaseMap.load(tmp_path / "light")), world_drive, 8)
    found = [(fix, T) for fix, T in zip(fixes, world_drive.T_map_body, strict=False) if fix.T_map_body is not None]
    assert found
    for fix, T in found:
        off = fix.T_map_body[:3, 3] - (512_003.0, 5_120_005.0, 100.0) - T[:3, 3]
        assert np.linalg.norm(off) < 0.3


def test_light_copy_is_made_from_a_directory_to_another(site, tmp_path, capsys):
    with pytest.raises(MapError, match="the site itself"):
        lighten(site, site)
    with pytest.raises(MapError, match="lies in the other"):
        lighten(site, site / "sub")
    other = tmp_path / "other"
    Manifest.load(site).save(other.parent)  # any site, where a light copy is not to go
    with pytest.raises(MapError, match="a whole site"):
        lighten(site, other.parent)
    (other.parent / "manifest.json").unlink()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert main(["convert", str(site), str(tmp_path / "full"), "--light"]) == 2
    (tmp_path / "one.coview").write_bytes(b"a map")
    for words, said in (
        ([tmp_path / "none.coview", tmp_path / "light", "--light"], "is not there"),
        ([tmp_path / "one.coview", tmp_path / "light", "--light"], "is not a directory of tiles"),
        ([site, tmp_path / "light.coview", "--light"], "a directory of tiles is written"),
        ([site, f"{tmp_path}/copy/"], "name a file, NAME.coview, or add --light"),
    ):
        capsys.readouterr()
        assert main(["convert", *map(str, words)]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "copy").exists()
    assert main(["convert", str(site), str(tmp_path / "light"), "--light"]) == 0
    assert "MB per km2" in capsys.readouterr().out
