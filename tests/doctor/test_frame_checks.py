"""Clouds against odometry: the usual faults of a set-up on a simulated drive and, where they are, on real runs."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import small_world
from nightly import nightly

from coview_stream.config.mount import parse_mount
from coview_stream.doctor.frame_checks import SeenFrame, frame_findings
from coview_stream.doctor.map_checks import seen_frames
from coview_stream.errors import CloudError
from coview_stream.geometry.transforms import (
    exp_so3,
    inverse,
    log_so3,
    pose_from,
    quat_to_matrix,
    quaternion_of,
    rot_z,
    transform,
    yaw_of,
)
from coview_stream.localization.witness.conventions import RIVALS
from coview_stream.recordings.open_run import open_run
from tests.test_realdata import SETS, data

R_camera_body = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def T(R):
    return pose_from(R, np.zeros(3))


def clouds(R):
    return lambda f: SeenFrame(f.stamp, transform(T(R), f.points), f.T_odom_body)


def scaled(s):
    return lambda f: SeenFrame(f.stamp, f.points * np.float32(s), f.T_odom_body)


def odometry(change):
    return lambda f: SeenFrame(f.stamp, f.points, change(f.T_odom_body))


def camera(f):
    return SeenFrame(
        f.stamp, transform(T(R_camera_body), f.points), T(R_camera_body) @ f.T_odom_body @ inverse(T(R_camera_body))
    )


def quaternion_shifted(T):
    """A pose whose quaternion is written w, x, y, z and read x, y, z, w."""
    return pose_from(quat_to_matrix(quaternion_of(T)[[3, 0, 1, 2]]), T[:3, 3])


def in_frame(T_frame_odom):
    return lambda f: SeenFrame(f.stamp, transform(T_frame_odom @ f.T_odom_body, f.points), f.T_odom_body)


PITCH = exp_so3([0.0, np.radians(10.0), 0.0])
FAULTS = {
    "lidar tilted": (clouds(PITCH), "lean"),
    "odometry tilted": (odometry(lambda P: T(PITCH) @ P), "lean"),
    "upside down": (clouds(exp_so3([np.pi, 0.0, 0.0])), "upside down"),
    "yawed": (clouds(rot_z(np.pi / 2)), "against the motion of the body"),
    "camera axes": (camera, "camera"),
    "camera clouds": (clouds(R_camera_body), "points up"),
    "static": (odometry(lambda P: np.eye(4)), "stands still, but the lidar moves"),
    "inverse": (odometry(inverse), "inverse"),
    "transposed": (odometry(RIVALS["transposed"]), "transposed"),
    "millimetres": (scaled(1000.0), "millimetres"),
    "feet": (scaled(3.2808), "feet"),
    "centimetres": (scaled(100.0), "clouds are in centimetres"),
    "odometry in centimetres": (
        odometry(lambda P: pose_from(P[:3, :3], 100.0 * P[:3, 3])),
        "odometry is in centimetres",
    ),
    "x and y of clouds": (lambda f: SeenFrame(f.stamp, f.points[:, [1, 0, 2]], f.T_odom_body), "x and y of one"),
    "north before east": (odometry(lambda P: pose_from(P[:3, :3], P[[1, 0, 2], 3])), "x and y are swapped"),
    "clockwise": (odometry(lambda P: pose_from(rot_z(np.pi / 2 - 2 * yaw_of(P)) @ P[:3, :3], P[:3, 3])), "clockwise"),
    "quaternion": (odometry(quaternion_shifted), "written w, x, y, z"),
    "odometry's frame": (in_frame(np.eye(4)), "in odometry's frame"),
    "map's frame": (in_frame(pose_from(rot_z(0.7), [600.0, -300.0, 12.0])), "in a map's frame"),
    "left-handed": (lambda f: SeenFrame(f.stamp, f.points * np.float32([1, -1, 1]), f.T_odom_body), "left-handed"),
}


@pytest.fixture(scope="module")
def frames(scene):
    drive = small_world.record_along(scene, small_world.drive(14), 1.0)
    pairs = zip(drive.clouds, drive.T_odom_body, strict=True)
    return [SeenFrame(0.5 * k, cloud, pose) for k, (cloud, pose) in enumerate(pairs)]


@pytest.mark.slow
def test_unspoilt_drive_is_ok(frames):
    assert [(f.what, f.verdict) for f in frame_findings(frames)] == [("ground", "ok"), ("motion", "ok")]


@pytest.mark.slow
def test_a_straight_drive_is_said_not_to_show_a_mirror(frames):
    mirrored = [SeenFrame(f.stamp, f.points * np.float32([1, -1, 1]), f.T_odom_body) for f in frames[:7]]
    motion = next(f for f in frame_findings(mirrored) if f.what == "motion")
    assert "whether y points left" in motion.remedy


@pytest.mark.slow
def test_mistakes_that_a_straight_drive_cannot_tell_apart_are_each_named_with_their_remedy(frames):
    spoil, words = FAULTS["clockwise"]
    findings = list(frame_findings([spoil(f) for f in frames[:7]]))
    assert [f.verdict for f in findings] == ["FAIL", "warn", "warn"]
    assert words in findings[0].found
    assert findings[0].remedy.endswith("bends or uneven ground may tell which")
    assert all("(33% probable)" in f.found for f in findings)
    assert all(f.found.startswith("or else ") for f in findings[1:])
    assert len({f.remedy for f in findings}) == 3


# this drive is nearly straight: there an inverse is told as a lidar that is turned on the body
@pytest.mark.slow
@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault != "inverse"])
def test_fault_is_found(frames, fault):
    spoil, words = FAULTS[fault]
    findings = list(frame_findings([spoil(f) for f in frames]))
    assert any(words in f.found and f.verdict != "ok" and f.remedy for f in findings), findings


def test_one_frame_is_said_to_show_no_motion(frames):
    (finding,) = frame_findings(frames[:1])
    assert (finding.what, finding.verdict) == ("motion", "warn")


def test_standing_robot_is_told_to_drive(frames):
    (motion, ground) = frame_findings([frames[0]] * 8)
    assert (motion.verdict, ground.verdict) == ("warn", "ok")
    assert "drive" in motion.remedy


@pytest.mark.slow
@pytest.mark.parametrize(("count", "words"), [(2, "too few frames"), (3, "too few frames"), (5, "odometry follows")])
def test_three_motions_that_agree_are_sure_and_two_are_not(frames, count, words):
    motion = next(f for f in frame_findings(frames[:count]) if f.what == "motion")
    assert motion.verdict == ("ok" if count == 5 else "warn")
    assert motion.found.startswith(words)


@pytest.mark.slow
def test_remedy_of_an_upside_down_lidar_is_its_mount(frames):
    spoil, _ = FAULTS["upside down"]
    (finding,) = frame_findings([spoil(f) for f in frames])
    option = finding.remedy.removeprefix("set --mount=").partition(";")[0]
    mount = parse_mount(option)
    for f in frames[:3]:
        back = mount.to_body(spoil(f).points)
        assert np.linalg.norm(back - f.points, axis=1).max() < 0.1 * np.linalg.norm(f.points, axis=1).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("180,0,0", "by --mount=180,0,0 the lidar is upside down"),
        ("0,0,90,1,0,0.5", "by --mount=0,0,90,1,0,0.5 the lidar is turned by -9"),
        ("0,10,0", "leans"),
    ],
)
def test_remedy_of_a_wrong_mount_is_the_right_one(frames, given, words):
    wrong = parse_mount(given)
    seen = [SeenFrame(f.stamp, wrong.to_body(f.points), f.T_odom_body) for f in frames]
    finding = next(f for f in frame_findings(seen, given=wrong) if f.verdict != "ok")
    assert words in finding.found
    mount = parse_mount(re.search(r"--mount=(\S+?)[; ]", finding.remedy)[1])
    turned = np.linalg.norm(log_so3(mount.T_body_sensor[:3, :3]))
    assert turned < np.radians(8.0)
    assert (mount.x, mount.y, mount.z) == (wrong.x, wrong.y, wrong.z)


def test_run_of_which_no_frame_can_be_read_is_not_ok(world_drive, tmp_path):
    """Millimetres: beyond what a body frame holds."""
    drive = replace(world_drive, clouds=[1000.0 * cloud + 5000.0 for cloud in world_drive.clouds])
    run = open_run(small_world.write_run(tmp_path / "run", drive, 3))
    with pytest.raises(CloudError, match=r"millimetres.*; write frames.*in metres"):
        seen_frames(run)


@cache
def real(name):
    return seen_frames(open_run(data(name, "run")))


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("name", SETS)
def test_unspoilt_run_is_ok(name):
    assert [f.verdict for f in frame_findings(real(name))] == ["ok", "ok"]


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("fault", FAULTS)
@nightly
def test_fault_is_found_on_a_real_run(fault):
    spoil, words = FAULTS[fault]
    findings = list(frame_findings([spoil(f) for f in real("riverside_a")]))
    assert any(words in f.found and f.verdict != "ok" and f.remedy for f in findings), findings
