"""A disk that is full while a map is built or a run is localized: one line, and the files before it stay."""

import pytest

pytestmark = pytest.mark.slow


def test_map_that_cannot_be_written_leaves_the_one_before(map_cloud_file, world_file, tmp_path, refused, full_disk):
    site, before = tmp_path / "site.coview", world_file.read_bytes()
    site.write_bytes(before)
    with full_disk(30_000):
        error = refused("build", map_cloud_file, "-o", site, "--no-learned")
    assert "site.coview: cannot write the map" in error
    assert [path.name for path in tmp_path.iterdir()] == ["site.coview"]
    assert site.read_bytes() == before


def test_results_that_cannot_be_written_are_one_line_and_no_halves(world_file, world_run, tmp_path, refused, full_disk):
    with full_disk(30_000):
        assert "cannot be written" in refused("locate", world_file, world_run, "-o", tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.part"))
