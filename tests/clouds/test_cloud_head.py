"""Files that cannot be one site are named, both, before their points are read."""

import numpy as np
import pytest

from coview_stream.clouds.cloud_head import check_together, head_of, read_head
from coview_stream.clouds.files import read_cloud, write_cloud
from coview_stream.errors import CloudError
from tests.clouds.test_las import geo_keys, written

POINTS = np.random.default_rng(1).uniform(0, (200, 100, 10), (1000, 3))


def tile(folder, name, east, north=5.4e6, scale=1.0):
    path = folder / name
    write_cloud(path, POINTS * scale, np.array([east, north, 100.0]))
    return path


def test_neighbours_belong_together_whatever_lies_between(tmp_path):
    paths = [tile(tmp_path, f"{k}.laz", 5e5 + 900.0 * k) for k in range(4)]
    assert check_together([read_head(path) for path in paths]) is None


def test_tile_a_few_kilometres_away_is_told(tmp_path):
    paths = [tile(tmp_path, f"{k}.laz", 5e5 + 300.0 * k + (3000.0 if k == 3 else 0)) for k in range(4)]
    said = check_together([read_head(path) for path in paths])
    assert said is not None
    assert str(paths[3]) in said
    assert str(paths[2]) in said
    assert "3.1 km" in said


def test_tile_of_another_site_is_refused_with_both_names(tmp_path):
    paths = [
        tile(tmp_path, "near.laz", 5e5),
        tile(tmp_path, "far.laz", 6e5, 5.5e6),
        tile(tmp_path, "next.laz", 5.002e5),
    ]
    with pytest.raises(CloudError, match=r"far\.laz lies .* km from .*(near|next)\.laz"):
        check_together([read_head(path) for path in paths])


def test_local_cloud_and_tile_with_coordinates_are_refused_once_read(tmp_path):
    local, utm = tile(tmp_path, "local.ply", 0.0, 0.0), tile(tmp_path, "utm.laz", 5e5)
    assert check_together([read_head(local), read_head(utm)]) is None  # a PLY's head has no extent
    with pytest.raises(CloudError, match=r"utm\.laz .*local\.ply|local\.ply .*utm\.laz"):
        check_together([head_of(path, read_cloud(path)) for path in (local, utm)])


def test_different_systems_are_refused_with_both_names(tmp_path):
    there = np.add(POINTS, (5e5, 5.4e6, 0.0))
    codes = (25832, 25833)
    paths = [written(tmp_path / f"{code}.las", there, vlrs=[geo_keys(k3072=code)]) for code in codes]
    with pytest.raises(CloudError, match=r"25832\.las is in .*25833\.las in "):
        check_together([read_head(path) for path in paths])


def test_cloud_in_millimetres_is_refused_with_its_size(tmp_path):
    path = tile(tmp_path, "mm.laz", 0.0, 0.0, scale=1000.0)
    with pytest.raises(CloudError, match=r"mm\.laz: extends over 197 x 98 km.*millimetres"):
        head_of(path, read_cloud(path))


def test_damaged_file_is_found_by_its_head(tmp_path):
    path = tile(tmp_path, "a.las", 5e5)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(CloudError, match=r"a\.las: truncated"):
        read_head(path)
    with pytest.raises(CloudError, match="no such file"):
        read_head(tmp_path / "none.laz")
    with pytest.raises(CloudError, match="is a directory"):
        read_head(tmp_path)
