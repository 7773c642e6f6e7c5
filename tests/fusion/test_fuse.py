"""Fusing runs with a map: what is added, what is new, what is gone, what moved."""

import numpy as np
import pytest
import small_world
from localized_drives import localized
from small_world import Box

from coview_stream.errors import InputError
from coview_stream.fusion.fuse import GONE, NEW, FuseConfig, fuse
from coview_stream.geometry.transforms import transform

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:.*which map:UserWarning")]


def inside(points, box, grown=0.3):
    local = np.abs(small_world.in_box_frame(box, points[:, :2]))
    return (local < 0.5 * box.size[:2] + grown).all(axis=1) & (points[:, 2] > 0.6)


@pytest.fixture(scope="module")
def changed(world_map, scene, tmp_path_factory):
    """Fused with a run through the world as it is now: one box gone, one new; and both boxes."""
    way = np.array([T[:2, 3] for T in small_world.drive()])
    gone = min(scene, key=lambda box: np.hypot(*(way - box.centre).T).min())
    new = Box(np.array([way[2, 0], way[2, 1] - 5.0]), np.array([3.0, 2.0, 2.0]), 0.3)
    now = [box for box in scene if box is not gone and np.hypot(*(box.centre - new.centre)) > 5.0] + [new]
    drive = small_world.record_along(now, small_world.drive(), 0.7)
    folder = tmp_path_factory.mktemp("changed")
    return fuse(world_map, [localized(world_map, folder, drive)], FuseConfig(changes=True)), gone, new, now


def test_a_new_box_is_new_and_little_else_is(changed):
    fused, _, new, _ = changed
    found = fused.points[fused.change == NEW]
    ours = fused.points[inside(fused.points, new)]
    assert len(ours) > 30
    assert inside(found, new).sum() > 0.8 * len(ours)
    assert inside(found, new).mean() > 0.9


def test_a_box_that_is_gone_is_gone_and_little_else_is(changed):
    fused, gone, _, now = changed
    points = np.asarray(fused.base_map.points)
    found = points[fused.base_change == GONE]
    left = [box for box in now if inside(found, box).any()]
    assert inside(found, gone).sum() > 20
    standing = np.any([inside(found, box, 0.1) for box in now], axis=0)
    assert standing.mean() < 0.05, left


def test_a_place_without_change_has_none(world_map, world_drive, tmp_path):
    fused = fuse(world_map, [localized(world_map, tmp_path, world_drive)], FuseConfig(changes=True))
    assert (fused.change == NEW).sum() <= 3
    assert (fused.base_change == GONE).sum() <= 3


def test_who_walked_by_is_left_out(world_map, scene, tmp_path):
    """A person who is in the way in two frames of thirty."""
    drive = small_world.record_along(scene, small_world.drive(), 0.6)
    rng = np.random.default_rng(1)
    person = rng.uniform([5.0, 1.0, -1.2], [5.4, 1.4, 0.1], (80, 3)).astype(np.float32)
    for k in (8, 9):
        drive.clouds[k] = np.concatenate([drive.clouds[k], person])
    run = localized(world_map, tmp_path, drive)
    spot = transform(drive.T_map_body[8], np.array([[5.2, 1.2, -0.5]]))[0]

    def near(fused):
        return int((np.linalg.norm(fused.points - spot, axis=1) < 0.8).sum())

    kept = near(fuse(world_map, [run], FuseConfig(keep_moving=True)))
    fused = fuse(world_map, [run])
    assert kept > 10
    assert near(fused) < 0.35 * kept
    assert fused.moving > 5


def test_runs_over_more_than_100_km2_are_refused_before_frames_are_read(world_map, world_drive, tmp_path):
    off = np.zeros((len(world_drive.clouds), 3))
    off[-1, :2] = 15_000.0, 12_000.0
    read = []
    with pytest.raises(InputError, match=r"15\d\d\d x 12\d\d\d m, 100 km2 at most"):
        fuse(world_map, [localized(world_map, tmp_path, world_drive, off)], progress=lambda *at: read.append(at))
    assert not read


def test_two_runs_have_their_numbers(world_map, world_drive, slow_drive, tmp_path):
    runs = [localized(world_map, tmp_path / name, drive) for name, drive in (("a", world_drive), ("b", slow_drive))]
    fused = fuse(world_map, runs)
    assert set(np.unique(fused.source)) == {1, 2}
    assert [added.points for added in fused.added] == [int((fused.source == k).sum()) for k in (1, 2)]
    assert len(fused.points) == len(np.unique(np.floor(fused.points / 0.25), axis=0))
