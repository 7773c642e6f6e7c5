"""Queries of the forest benchmark: what is recorded of a drawn world or read from disk, and how errors are counted."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bench.forest.drives import poses

from bench.forest import worlds as forest_worlds
from bench.forest.plot import lowest, pasted, standing
from bench.forest.query import errors, local, query_of
from bench.forest.runs import runs_table, scored
from bench.forest.worlds import Drive, drawn, ends_of, frames_behind, in_odometry, recorded
from bench.harness.trajectory_scores import Told
from coview_stream.clouds import write_cloud, write_tum
from coview_stream.config import LocalizerConfig
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform, yaw_of
from coview_stream.training.recipe import Recipe

TINY = Recipe(
    built=0.0, size=(80.0, 80.0), sensors=("os64",), slope=(0.0, 5.0), stems=(150.0, 200.0), rays=6000,
    pulses=(3.0, 3.0), travel=(4.0, 6.0), standing=0.0, gravity_error=(0.0, 0.0), understory=(0.0, 0.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return drawn(tmp_path_factory.mktemp("forest"), 19_510, 2, TINY)


def test_a_recorded_drive_is_the_submap_that_training_sees(world):
    from coview_stream.training.worlds import draw_world, submaps

    recipe = replace(TINY, submaps=2)
    for drive, (sensor, submap) in zip(
        world.drives, submaps(draw_world(19_510, recipe), 19_510, recipe), strict=True
    ):
        assert drive.sensor == sensor == "os64"
        assert drive.travelled == submap.travelled
        query, truth = query_of(drive, LocalizerConfig(reloc="learned"))
        assert yaw_of(truth) == pytest.approx(submap.pose[2], abs=1e-3)
        np.testing.assert_allclose((truth @ query.T_odom_body)[:2, 3], submap.pose[:2], atol=1e-6)
        cells = [
            {tuple(c) for c in np.floor(p / 2.0).astype(int).tolist()} for p in (query.scan, submap.points)
        ]
        assert len(cells[0] & cells[1]) > 0.97 * len(cells[1])


def test_a_world_is_drawn_once(world, monkeypatch):
    def never(*args):
        raise AssertionError("drawn again")

    monkeypatch.setattr(forest_worlds, "_simulate", never)
    again = drawn(world.base.parent.parent, 19_510, 2, TINY)
    assert again.kind == world.kind
    assert again.kind.startswith("forest")
    np.testing.assert_array_equal(again.drives[1].clouds[0], world.drives[1].clouds[0])
    with pytest.raises(AssertionError, match="drawn again"):
        drawn(world.base.parent.parent, 19_510, 2, replace(TINY, rays=7000))


def test_queries_of_a_run_end_every_ten_metres():
    way = np.arange(0, 35.05, 0.1)
    ends = ends_of(way, None)
    np.testing.assert_allclose(way[ends], [12.0, 22.0, 32.0], atol=0.11)
    assert ends_of(way, 2) == [ends[0], ends[2]]
    assert ends_of(np.array([0.0]), 5) == [0]
    assert ends_of(np.array([0.0, 3.0]), 5) == [1]


def test_a_query_is_of_the_frames_of_the_last_twelve_metres():
    way = np.concatenate([np.full(20, 0.0), np.arange(0, 30, 0.1), np.full(20, 30.0)])
    end = len(way) - 1
    chosen = frames_behind(way, end)
    assert chosen[-1] == end
    assert way[chosen[0]] == pytest.approx(18.1, abs=0.3)
    assert (np.diff(way[chosen]) >= 0.25 - 1e-9).all()
    assert 38 <= len(chosen) <= 50


@pytest.fixture
def on_disk(tmp_path):
    """A run of 13 m along x of a wall of points, at coordinates as they are on maps."""
    rng, origin = np.random.default_rng(2), np.array([5e5, 5e6, 100.0])
    spots = np.column_stack([rng.uniform(-30, 40, 3000), rng.uniform(-20, 20, 3000), rng.uniform(0, 5, 3000)])
    write_cloud(tmp_path / "base.laz", spots, origin=origin)
    folder = tmp_path / "run" / "frames"
    folder.mkdir(parents=True)
    truth = np.array([pose_from(rot_z(0.3), [x, 0.0, 1.0]) for x in np.arange(0, 13.01, 0.5)])
    for k, T in enumerate(truth):
        write_cloud(folder / f"{k:06d}.pcd", transform(inverse(T), spots).astype(np.float32))
    stamps = 10.0 + 0.5 * np.arange(len(truth))
    write_tum(tmp_path / "run" / "odometry.tum", stamps, pose_from(rot_z(1.0), [7.0, 8.0, 0.0]) @ truth)
    in_map = truth.copy()
    in_map[:, :3, 3] += origin
    write_tum(tmp_path / "truth.tum", stamps, in_map)
    (tmp_path / "world.json").write_text(json.dumps({"sensor": "os64"}))
    return tmp_path, spots, origin


def test_a_world_on_disk_gives_queries_in_its_own_coordinates(on_disk):
    folder, spots, origin = on_disk
    place = recorded(folder)
    assert place.base == folder / "base.laz"
    (drive,) = place.drives
    assert drive.sensor == "os64"
    assert drive.travelled == pytest.approx(12.0, abs=1e-3)
    query, truth = query_of(drive, LocalizerConfig(reloc="learned"))
    np.testing.assert_allclose(query.position, 0.0, atol=1e-9)
    seen = transform(local(truth, origin), query.scan.astype(np.float64))
    from scipy.spatial import cKDTree

    assert np.quantile(cKDTree(spots).query(seen)[0], 0.99) < 0.2
    assert len(query.submap) > 1000


def test_a_folder_without_a_base_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no base\.laz or base\.las"):
        forest_worlds.base_of(tmp_path)


def test_errors_are_those_of_the_robot_not_of_the_odometrys_origin():
    told = np.array([pose_from(rot_z(0.2), [100.0, 0.0, 0.0])])
    drive = Drive("os64", 0.0, told, (np.zeros((1, 3), np.float32),), pose_from(rot_z(1.0), [5.0, 6.0, 7.0]))
    at, truth = in_odometry(drive)
    query = query_of(drive, LocalizerConfig(reloc="learned"))[0]
    np.testing.assert_allclose(at[-1, :3, 3], 0.0)
    np.testing.assert_allclose(truth @ at[-1], drive.truth)
    assert errors(truth, truth, query) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-5)
    off = pose_from(np.eye(3), [3.0, 4.0, 12.0]) @ truth
    assert errors(off, truth, query) == pytest.approx((5.0, 0.0, 13.0, 0.0), abs=1e-5)
    turned = truth @ pose_from(rot_z(np.radians(90.0)), np.zeros(3))
    assert errors(turned, truth, query) == pytest.approx((0.0, 90.0, 0.0, 90.0), abs=1e-5)


def told(truth, off):
    """What was said: nothing at the first frame, then poses so many metres off along x; None is no pose."""
    known = np.full((len(truth), 4, 4), np.nan)
    for k, metres in enumerate(off):
        if metres is not None:
            known[k] = pose_from(np.eye(3), [metres, 0, 0]) @ truth[k]
    states = ["TRACKING" if metres is not None else "SEARCHING" for metres in off]
    count = len(truth)
    return Told(
        np.arange(count) * 1.0, states, [""] * count, known, np.zeros((count, 6, 6)), np.full(count, 0.5)
    )


def test_a_run_is_scored_by_two_metres_and_outside_every_pose_is_false():
    truth = np.array([pose_from(np.eye(3), [10.0 * k, 0, 0]) for k in range(5)])
    said = told(truth, [None, 0.3, None, 2.5, 0.4])
    row = scored(said, truth, outside=False)
    assert row["driven_m"] == 40.0
    assert row["first_fix_m"] == 10.0
    assert (row["posed"], row["posed_after"], row["false"]) == (0.6, 0.75, 1)
    assert row["rmse_m"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert scored(said, truth, outside=True)["false"] == 3
    silent = scored(told(truth, [None] * 5), truth, outside=True)
    assert (silent["false"], silent["first_fix_m"], silent["rmse_m"]) == (0, None, None)
    text = runs_table([{"run": "a", "reloc": "auto", **row}, {"run": "b", "reloc": "auto", **silent}])
    assert [cell.strip() for cell in text.splitlines()[-1].strip("|").split("|")][:9] == [
        "b", "auto", "40", "-", "0", "-", "-", "-", "0",
    ]  # fmt: skip


def test_a_drive_keeps_its_height_over_the_ground_and_looks_ahead():
    path = np.column_stack([np.zeros(101), np.arange(101) * 0.1])
    made = poses(path, 0.5, lambda x, y: 0.2 * y, np.random.default_rng(0))
    np.testing.assert_allclose(made[:, 2, 3], 0.2 * made[:, 1, 3] + 1.5)
    ahead = made[:, :3, 0]
    np.testing.assert_allclose(
        ahead.mean(axis=0), [0.0, np.cos(np.arctan(0.2)), np.sin(np.arctan(0.2))], atol=0.02
    )


def test_a_plot_is_pasted_on_the_tiles_ground_in_place_of_what_was_there():
    rng = np.random.default_rng(1)
    tile = np.column_stack([rng.uniform(0, 100, (4000, 2)), np.full(4000, 7.0)])
    plot = np.column_stack([rng.uniform(500, 520, (3000, 2)), np.full(3000, 90.0)])
    plot[0, 2] = 110.0
    both, shift = pasted(tile, plot, rng)
    assert lowest(plot + shift) == pytest.approx(7.0)
    inside = (np.abs(both[:, :2] - 50.0) < 9.9).all(axis=1)
    there = (np.abs(tile[:, :2] - tile[:, :2].mean(axis=0)) < 9.9).all(axis=1).sum()
    assert inside.sum() == pytest.approx(there, rel=0.2)  # as dense as what was there
    drive = standing(plot + shift, 0.7)
    np.testing.assert_allclose(drive.truth[:3, 3], [50.0, 50.0, 8.5], atol=0.2)
    back = transform(drive.truth, drive.clouds[0].astype(np.float64))
    assert np.median(back[:, 2]) == pytest.approx(7.0, abs=1e-4)
