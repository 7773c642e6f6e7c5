"""Joint adjustment: what it brings where the map is blind, and that it keeps what it cannot better."""

import numpy as np
import pytest
import small_world
from localized_drives import localized

from coview_stream.basemap.basemap import BaseMap
from coview_stream.fusion.constraints import path_of, spaced
from coview_stream.fusion.joint import Joint, Judgement, adjust

pytestmark = pytest.mark.filterwarnings("ignore:.*which map:UserWarning")


@pytest.fixture(scope="module")
def drives(scene):
    return [small_world.record_along(scene, small_world.drive(10), spacing) for spacing in (0.5, 0.7)]


def errors(poses, drive):
    return np.linalg.norm(poses[:, :3, 3] - np.array(drive.T_map_body)[:, :3, 3], axis=1)


@pytest.mark.slow
def test_a_run_that_drifted_where_the_map_is_blind_is_drawn_to_the_other(map_points, scene, drives, tmp_path):
    way = np.array(drives[1].T_map_body)[:, :3, 3]
    blind = BaseMap.build(map_points[np.linalg.norm(map_points[:, :2] - way[-1, :2], axis=1) > 16.0], radius=30.0)
    off = np.zeros_like(way)
    off[:, 1] = 0.25 * np.clip(np.linspace(-1.0, 1.0, len(way)), 0.0, 1.0)
    runs = [localized(blind, tmp_path / "a", drives[0]), localized(blind, tmp_path / "b", drives[1], off)]
    joint = adjust(blind, runs)
    assert joint.between > 5
    assert joint.accepted
    assert joint.residuals[1] < joint.residuals[0]
    assert errors(joint.poses[1], drives[1]).max() < 0.4 * errors(runs[1].poses, drives[1]).max()
    assert errors(joint.poses[0], drives[0]).max() < 0.06
    assert "overlaps not used" in joint.said()


@pytest.mark.slow
def test_without_overlaps_the_poses_stay(world_map, drives, tmp_path):
    run = localized(world_map, tmp_path, drives[1])
    joint = adjust(world_map, [run])
    assert (joint.between, joint.loops, joint.accepted) == (0, 0, False)
    assert np.array_equal(joint.poses[0], run.poses)
    assert errors(joint.adjusted[0], drives[1]).max() < 0.05
    assert "poses of locate are kept" in joint.said()


def test_what_is_worse_is_not_taken():
    assert Judgement((0.04, 0.03), (0.02, 0.02)).better
    assert not Judgement((0.03, 0.04), (0.02, 0.02)).better
    assert not Judgement((0.04, 0.03), (0.02, 0.05)).better
    assert Judgement((0.04, 0.03), (float("nan"), float("nan"))).better
    old, new = np.eye(4)[None], 2.0 * np.eye(4)[None]
    worse = Joint((old,), (new,), 1, 1, 0, 3, 0, 3, (1.0, 0.5), Judgement((0.03, 0.04), (0.02, 0.02)))
    assert worse.poses[0] is old
    assert "not better" in worse.said()


def test_keyframes_are_apart_and_the_end_has_one():
    driven = np.array([0.0, 1.0, 4.5, 5.0, 8.6, 11.0])
    assert spaced(driven, 4.0).tolist() == [0, 2, 4, 5]
    assert spaced(np.zeros(3), 4.0).tolist() == [0]
    assert path_of(np.eye(4)[None].repeat(3, 0))[0].tolist() == [0.0, 0.0, 0.0]
