"""Folders and patterns of clouds."""

from __future__ import annotations

import pytest

from coview_stream.clouds.cloud_paths import expand_cloud_paths
from coview_stream.errors import CloudError


@pytest.fixture
def folder(tmp_path):
    for name in ("tile10.laz", "tile2.laz", "tile1.las", ".hidden.laz", "site.coview", "notes.txt", "tile3.laz.part"):
        (tmp_path / "tiles" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "tiles" / name).touch()
    return tmp_path / "tiles"


def test_folder_means_its_clouds_in_natural_order(folder):
    assert [path.name for path in expand_cloud_paths([folder])] == ["tile1.las", "tile2.laz", "tile10.laz"]


def test_pattern_and_names_may_be_mixed(folder):
    found = expand_cloud_paths([folder / "tile*.laz", folder / "tile1.las", folder / "none.laz"])
    assert [path.name for path in found] == ["tile2.laz", "tile10.laz", "tile1.las", "none.laz"]


def test_named_file_is_left_to_its_reader(folder):
    assert expand_cloud_paths([folder / "notes.txt"]) == [folder / "notes.txt"]


def test_folder_or_pattern_without_clouds_says_so(folder, tmp_path):
    with pytest.raises(CloudError, match=r"holds no cloud .*did you mean .*tiles\?"):
        expand_cloud_paths([tmp_path])
    (tmp_path / "empty").mkdir()
    with pytest.raises(CloudError, match=r"holds no cloud .*name another folder"):
        expand_cloud_paths([tmp_path / "empty"])
    with pytest.raises(CloudError, match="no cloud has such a name"):
        expand_cloud_paths([folder / "*.ply"])


def test_file_whose_name_has_brackets_is_a_file(tmp_path):
    (tmp_path / "scan[1].ply").touch()
    assert expand_cloud_paths([tmp_path / "scan[1].ply"]) == [tmp_path / "scan[1].ply"]
