"""``coview-stream fuse``: files in every format, coordinates, names of sources and bad input."""

import json

import laspy
import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.clouds import read_cloud
from coview_stream.clouds.trajectory import read_tum, write_tum

ORIGIN = np.array([412_000.0, 5_318_000.0, 200.0])


@pytest.fixture(scope="module")
def site(map_points, world_run, world_drive, tmp_path_factory):
    """A map at UTM coordinates with a reference system, and results of a run on it; the first frame has no pose."""
    folder = tmp_path_factory.mktemp("utm")
    base_map = BaseMap.build(map_points + ORIGIN, crs="EPSG:25832", radius=30.0)
    sha = base_map.save(folder / "site.coview")
    poses = np.array(world_drive.T_map_body)[1:7]
    poses[:, :3, 3] += ORIGIN
    stamps = [float(line.split()[0]) for line in (world_run / "odometry.tum").read_text().splitlines()]
    (folder / "out").mkdir()
    write_tum(folder / "out" / "trajectory.tum", stamps[1:], poses)
    (folder / "out" / "result.json").write_text(json.dumps({"map_sha256": sha}))
    return folder


@pytest.mark.slow
def test_las_has_sources_stamps_and_reference_system(site, world_run, tmp_path, capsys):
    out, more = tmp_path / "fused.laz", ["--changes", "--picture", str(tmp_path / "f.png")]
    assert main(["fuse", str(site / "site.coview"), f"{world_run}:{site / 'out'}", "-o", str(out), *more]) == 0
    assert (tmp_path / "f.png").stat().st_size > 10_000
    said = capsys.readouterr().out
    assert "1 frame without a pose" in said
    assert "blind spots" in said
    las = laspy.read(out)
    assert las.header.parse_crs().to_epsg() == 25832
    assert las.header.scales.tolist() == [0.001] * 3
    source = np.asarray(las.point_source_id)
    assert set(np.unique(source)) == {0, 1}
    base = np.asarray(las.xyz)[source == 0]
    expected = BaseMap.load(site / "site.coview").world_points()
    assert np.abs(base - expected).max() < 6e-4
    stamps = np.asarray(las.gps_time)
    assert not stamps[source == 0].any()
    assert 100.0 < stamps[source == 1].min() <= stamps.max() < 104.0
    assert set(np.unique(las.change)) <= {0, 1, 2}
    told = json.loads((tmp_path / "fused.laz.json").read_text())
    assert [each["source"] for each in told["sources"]] == [0, 1]
    assert told["sources"][1]["name"] == str(world_run)
    assert told["sources"][1]["points"] == int((source == 1).sum())


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["ply", "pcd", "npy", "las"])
def test_other_formats_are_clouds_that_this_package_reads(site, world_run, tmp_path, suffix):
    out = tmp_path / f"fused.{suffix}"
    assert main(["fuse", str(site / "site.coview"), f"{world_run}:{site / 'out'}", "-o", str(out)]) == 0
    points = read_cloud(out).map_points()
    told = json.loads((tmp_path / f"{out.name}.json").read_text())
    assert len(points) == sum(each["points"] for each in told["sources"])
    expected = BaseMap.load(site / "site.coview").world_points()
    assert np.abs(points[: len(expected)] - expected).max() < 0.01


@pytest.mark.slow
def test_joint_writes_trajectories_and_says_what_it_kept(site, world_run, tmp_path, capsys):
    pair = f"{world_run}:{site / 'out'}"
    out = tmp_path / "f.npy"
    assert main(["fuse", str(site / "site.coview"), pair, pair, "-o", str(out), "--joint"]) == 0
    said = capsys.readouterr().out
    assert "between runs" in said
    assert "f.npy.run1.tum, f.npy.run2.tum: trajectories" in said
    stamps, poses = read_tum(tmp_path / "f.npy.run2.tum")
    before = read_tum(site / "out" / "trajectory.tum")
    assert np.array_equal(stamps, before[0])
    assert np.abs(poses[:, :3, 3] - before[1][:, :3, 3]).max() < 0.1


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["-o", "fused.txt"], "name a cloud"),
        (["-o", "nowhere/fused.laz"], "in an existing directory"),
        (["-o", "fused.laz", "--voxel", "0"], "voxel"),
        (["-o", "fused.laz", "--min-range", "60"], "range_min"),
    ],
)
def test_bad_usage_is_one_line(site, world_run, tmp_path, monkeypatch, refused, arguments, why):
    monkeypatch.chdir(tmp_path)
    assert why in refused("fuse", site / "site.coview", f"{world_run}:{site / 'out'}", *arguments)
    assert not list(tmp_path.iterdir())
