"""Smoothing a recorded run: poses of frames that had none live, and none that the run does not speak for."""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from small_world import pose_error
from trackers import garbage

from coview_stream.clouds.cloud import Cloud
from coview_stream.clouds.trajectory import read_tum
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.backward import BelievedRegistration, RecordedFrame, RecordingLocalizer
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.offline import RunResult, locate, summary, write
from coview_stream.localization.result import Fix
from coview_stream.localization.smoothing import PoseKind, smooth_run
from coview_stream.localization.state import State
from coview_stream.recordings.run import Run
from coview_stream.report.export import csv, trajectory_of

BLIND = np.tile(np.float32([0.6, 0.0, 0.0]), (15, 1))


@dataclass
class Clouds:
    """Clouds in memory, as the source of a run."""

    clouds: list[np.ndarray]

    def read(self, index, correction=None):
        return Cloud(self.clouds[index], np.zeros(3))


def run_of(clouds, odometry):
    count = len(clouds)
    stamps = 100.0 + 0.5 * np.arange(count)
    return Run(Path("run"), (Path("run"),) * count, stamps, np.array(odometry), Clouds(list(clouds)))


def searched_from(world_map, run, first, known=None):
    """Localize a run whose search answers from frame ``first`` on; smooth it. A calibration may be known."""
    localizer, frames = RecordingLocalizer(world_map), []
    localizer.prepare()
    if known is not None:
        localizer.hint_calibration(known)
    for k, frame in enumerate(run):
        if k < first:
            localizer.add_frame(frame.points, frame.T_odom_body, frame.stamp)
            fix = localizer.fix()
        else:
            fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
        frames.append(RecordedFrame(k, frame.T_odom_body, frame.origin, fix, localizer.registered))
    return frames, smooth_run(localizer, run, frames)


def by_frame(poses):
    return {round((pose.stamp - 100.0) / 0.5): pose for pose in poses}


def assert_right(poses, truth, metres=0.1):
    for k, pose in by_frame(poses).items():
        assert pose_error(pose.T_map_body, truth[k])[0] < metres, (k, pose.kind)


@pytest.mark.slow
@pytest.mark.parametrize("late", ["clouds", "odometry"])
def test_poses_are_of_the_stamp_where_clouds_or_odometry_are_late(world_map, way, late):
    """By a frame, of 0.5 s and 0.4 m; live, tracked backwards and smoothed."""
    old, new = slice(0, -1), slice(1, None)
    clouds, odometry = (old, new) if late == "clouds" else (new, old)
    run = run_of(way.clouds[clouds], way.T_odom_body[odometry])
    known = Calibration(delay=0.5 if late == "clouds" else -0.5, sigma_delay=0.002)
    frames, poses = searched_from(world_map, run, 10, known)
    assert poses[5].kind is PoseKind.BACKWARD
    assert_right(poses, way.T_map_body[1:])
    posed = {k: frame.fix for k, frame in enumerate(frames) if frame.fix.T_map_body is not None}
    assert len(posed) > 20
    for k, fix in posed.items():
        assert pose_error(fix.T_map_body, way.T_map_body[k + 1])[0] < 0.15


@pytest.mark.slow
def test_frames_before_a_late_fix_are_tracked_backwards(world_map, way):
    frames, poses = searched_from(world_map, run_of(way.clouds, way.T_odom_body), 25)
    first = next(k for k, frame in enumerate(frames) if frame.fix.T_map_body is not None)
    assert first >= 25
    found = by_frame(poses)
    assert sorted(found) == list(range(len(way.clouds)))
    assert {found[k].kind for k in range(first)} == {PoseKind.BACKWARD}
    assert {found[k].kind for k in range(first, len(frames))} == {PoseKind.SMOOTHED}
    assert_right(poses, way.T_map_body)


@pytest.mark.slow
def test_nothing_is_made_up_before_odometry_began_anew(world_map, way):
    """At the tenth frame, elsewhere and turned."""
    anew = pose_from(rot_z(0.9), [4.0, 9.0, 0.0])
    odometry = [*way.T_odom_body[:10], *(anew @ T for T in way.T_odom_body[10:])]
    _, poses = searched_from(world_map, run_of(way.clouds, odometry), 25)
    found = by_frame(poses)
    assert min(found) >= 9
    assert PoseKind.BACKWARD in {pose.kind for pose in poses}
    assert_right(poses, way.T_map_body)


@pytest.mark.slow
def test_a_blind_stretch_is_bridged_and_its_protection_level_grows(world_map, way):
    clouds = [BLIND if 15 <= k < 25 else cloud for k, cloud in enumerate(way.clouds)]
    located = locate(world_map, run_of(clouds, way.T_odom_body), smooth=True)
    found = by_frame(located.smoothed)
    blind = [k for k in range(15, 25) if k in found and found[k].kind is PoseKind.BRIDGED]
    assert len(blind) >= 8
    assert not set(blind) & {round((fix.stamp - 100.0) / 0.5) for fix in located.posed}
    assert found[20].protection.horizontal > 1.5 * found[30].protection.horizontal
    assert_right(located.smoothed, way.T_map_body)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "blind"), [(14, range(0)), (15, range(15, 17))])
def test_a_robot_that_was_carried_is_not_smoothed_across(world_map, way, first, blind):
    """It is put down eight metres on; by its odometry it stood still. Blind meanwhile, its live pose is wrong."""
    rows = [*range(first), *range(34, len(way.clouds))]
    odometry = [way.T_odom_body[k] for k in rows]
    back = odometry[first - 1] @ np.linalg.inv(odometry[first])
    odometry = [T if k < first else back @ T for k, T in enumerate(odometry)]
    clouds = [BLIND if at in blind else way.clouds[k] for at, k in enumerate(rows)]
    located = locate(world_map, run_of(clouds, odometry), smooth=True)
    truth = [way.T_map_body[k] for k in rows]
    wrong = [k for k, fix in by_frame(located.posed).items() if pose_error(fix.T_map_body, truth[k])[0] > 0.5]
    assert bool(wrong) == bool(blind)
    assert len(located.smoothed) >= 14
    assert PoseKind.BRIDGED not in {pose.kind for pose in located.smoothed}
    assert_right(located.smoothed, truth)


@pytest.mark.slow
def test_a_slip_moves_no_pose_on_either_side(world_map, way):
    slip = pose_from(rot_z(0.08), [0.3, 0.9, 0.0])
    start = way.T_odom_body[20]
    odometry = [T if k < 20 else start @ slip @ np.linalg.inv(start) @ T for k, T in enumerate(way.T_odom_body)]
    located = locate(world_map, run_of(way.clouds, odometry), smooth=True)
    assert len(located.smoothed) >= len(located.posed) >= 40
    assert_right(located.smoothed, way.T_map_body, 0.03)


@pytest.mark.slow
def test_smoothed_poses_are_no_worse_with_odometry_that_drifts(world_map, way):
    rng = np.random.default_rng(2)
    odometry = [way.T_odom_body[0]]
    for a, b in zip(way.T_odom_body[:-1], way.T_odom_body[1:], strict=True):
        step = np.linalg.inv(a) @ b
        step[:3, 3] *= 1.04
        odometry.append(odometry[-1] @ step @ pose_from(rot_z(rng.normal(0.0, 0.01)), np.zeros(3)))
    located = locate(world_map, run_of(way.clouds, odometry), smooth=True)
    both = {k: pose for k, pose in by_frame(located.smoothed).items() if pose.kind is PoseKind.SMOOTHED}
    live = by_frame(located.posed)
    assert sorted(both) == sorted(live)
    off = [
        np.sqrt(np.mean([pose_error(pose.T_map_body, way.T_map_body[k])[0] ** 2 for k, pose in poses.items()]))
        for poses in (both, live)
    ]
    assert off[0] <= 1.02 * off[1]


def recorded(registered, posed, count=12):
    """Frames in a line, a metre apart, of which some were registered and some have a live pose; odometry is right."""
    level, shared = ProtectionLevel(0.2, 0.5, 0.2, 0.1), 1e-6 * np.eye(6)
    frames = []
    for k in range(count):
        T = pose_from(np.eye(3), [k, 0.0, 0.0])
        fix = Fix(float(k), State.LOST)
        if k in posed:
            fix = Fix(float(k), State.TRACKING, T, np.eye(4), 1e-4 * np.eye(6), 0.9, protection=level)
        kept = BelievedRegistration(T, 1e-4 * np.eye(6), shared, 1.0, False, False) if k in registered else None
        frames.append(RecordedFrame(k, T, np.zeros(3), fix, kept))
    return frames


@pytest.mark.parametrize("registered", [range(5), range(0)])
def test_live_poses_that_no_registration_is_near_stay_as_they_were(world_map, registered):
    """Five frames, four lost, three posed again by odometry; or none of them registered."""
    posed = [*range(5), 9, 10, 11]
    frames = recorded(registered, posed)
    poses = smooth_run(RecordingLocalizer(world_map), run_of([BLIND] * 12, [f.T_odom_body for f in frames]), frames)
    assert [pose.stamp for pose in poses] == posed
    for pose, k in zip(poses, posed, strict=True):
        fix = frames[k].fix
        assert (pose.kind, pose.confidence) == (PoseKind.SMOOTHED, 0.9)
        np.testing.assert_allclose(pose.T_map_body, fix.T_map_body, atol=1e-9)
        if k not in registered:
            assert pose.protection == fix.protection
            np.testing.assert_array_equal(pose.covariance, fix.covariance)


def test_live_poses_beside_a_break_are_not_handed_to_a_backward_registration(world_map, world_drive):
    """One frame between registrations was registered backwards, a metre off, in fog: odometry is broken there."""
    frames, small = [], 1e-4 * np.eye(6)
    for k in range(len(world_drive.clouds)):
        T, off = world_drive.T_map_body[k], pose_from(np.eye(3), [0.0, float(k == 4), 0.0])
        fix = Fix(float(k), State.TRACKING, T, np.eye(4), small, 0.9, protection=ProtectionLevel(0.2, 0.5, 0.2, 0.1))
        T_map_cloud = off @ pose_from(T[:3, :3], T[:3, 3] - world_map.origin)
        kept = BelievedRegistration(T_map_cloud, small, 1e-6 * np.eye(6), 1.0, False, k == 4)
        frames.append(RecordedFrame(k, world_drive.T_odom_body[k], np.zeros(3), fix, None if k in (3, 5, 6) else kept))
    localizer, run = RecordingLocalizer(world_map), run_of(world_drive.clouds, world_drive.T_odom_body)
    localizer.prepare()
    for pose in smooth_run(localizer, run, frames):
        assert pose_error(pose.T_map_body, world_drive.T_map_body[round(pose.stamp)])[0] < 0.1


def test_a_cloud_is_compared_at_the_level_of_its_pose(world_map, world_drive):
    localizer, lean = RecordingLocalizer(world_map), Calibration(pitch=0.12)
    localizer.prepare()
    cloud, T = world_drive.clouds[3], world_drive.T_map_body[3]
    leaning = cloud @ lean.R_body_cloud.astype(np.float32)
    right = localizer.fit(cloud, T, Calibration())
    assert right > 0.8
    assert localizer.fit(leaning, T, lean) == pytest.approx(right, abs=0.01)
    assert localizer.fit(leaning, T, Calibration()) < right - 0.1


def test_a_run_without_a_fix_has_no_smoothed_poses_and_says_so(world_map):
    clouds = [garbage(seed) for seed in range(3)]
    located = locate(world_map, run_of(clouds, [pose_from(np.eye(3), [k, 0.0, 0.0]) for k in range(3)]), smooth=True)
    assert located.smoothed == []
    assert not len(located.trajectory[0])
    assert "nothing: there was no fix" in summary(located)


def test_a_single_fix_is_enough(world_map, world_drive):
    located = locate(world_map, run_of(world_drive.clouds[3:4], world_drive.T_odom_body[3:4]), smooth=True)
    (pose,) = located.smoothed
    assert pose.kind is PoseKind.SMOOTHED
    assert pose_error(pose.T_map_body, world_drive.T_map_body[3])[0] < 0.1
    assert pose.confidence == located.posed[0].confidence


@pytest.mark.slow
def test_files_mark_each_pose_and_keep_the_live_ones(world_map, way, tmp_path):
    frames, poses = searched_from(world_map, run_of(way.clouds[:30], way.T_odom_body[:30]), 20)
    located = RunResult(30, [frame.fix for frame in frames], smoothed=poses)
    write(located, world_map, tmp_path)
    kinds = Counter(pose.kind.value for pose in poses)
    result = json.loads((tmp_path / "result.json").read_text())
    assert [part["kind"] for part in result["smoothed"]] == ["backward", "smoothed"]
    assert {part["kind"]: part["frames"] for part in result["smoothed"]} == kinds
    assert all(0.0 < part["protection_m"] < 2.0 for part in result["smoothed"])  # the ground may not be the survey's
    np.testing.assert_allclose(read_tum(tmp_path / "trajectory.tum")[0], [pose.stamp for pose in poses])
    np.testing.assert_allclose(read_tum(tmp_path / "filtered.tum")[0], [fix.stamp for fix in located.posed])
    text = csv(trajectory_of("run", *located.trajectory, None, [pose.kind for pose in poses])).splitlines()
    assert text[0].endswith(",kind")
    assert [line.rsplit(",", 1)[1] for line in text[1:]] == [pose.kind.value for pose in poses]
    assert f"{kinds['backward']} tracked backwards" in summary(located)
    write(RunResult(1, [Fix(0.0, State.SEARCHING)]), world_map, tmp_path)
    assert not (tmp_path / "filtered.tum").exists()
    assert json.loads((tmp_path / "result.json").read_text())["smoothed"] is None
