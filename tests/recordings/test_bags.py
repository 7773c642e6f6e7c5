"""Recordings as runs: every storage, stamps of headers, deskewing, topics, mounts, and unreadable files."""

import contextlib
import json
import sqlite3
import threading

import numpy as np
import pytest
from bag_files import LATE, cloud, livox, odometry, transforms, write_bag

from coview_stream.cli import main
from coview_stream.clouds import write_tum
from coview_stream.config.mount import parse_mount
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.messages import ros2_outputs
from coview_stream.recordings.bag_reader import BagReader
from coview_stream.recordings.bags import Track
from coview_stream.recordings.frame_tree import FrameTree
from coview_stream.recordings.open_run import open_run

START = 1_700_000_000_000_000_000
SPEED, TURN = 6.0, 0.5
COUNT = 8
CLOUD_NS = [START + 40_000_000 + k * 100_000_000 for k in range(COUNT)]
ODOMETRY_NS = [START + k * 20_000_000 for k in range(50)]
POINTS = np.random.default_rng(5).uniform(-30, 30, (40, 3)).astype(np.float32)


def T_at(stamp_ns):
    """(4, 4) odometry <- body of a robot on a circle, far from odometry's zero."""
    t = 1e-9 * (np.asarray(stamp_ns) - START)
    yaw = TURN * t
    place = (SPEED / TURN * np.sin(yaw) + 3000.0, SPEED / TURN * (1 - np.cos(yaw)) - 2000.0, 1.5)
    return pose_from(rot_z(yaw), place)


def driven(stamps=ODOMETRY_NS):
    return [odometry(ns, T_at(ns)) for ns in stamps]


def clouds(stamps=CLOUD_NS):
    return [cloud(ns, POINTS + np.float32(k)) for k, ns in enumerate(stamps)]


def only_file(folder):
    return next(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))


@pytest.mark.parametrize(
    ("name", "storage", "compression", "single"),
    [
        ("mcap", "mcap", "", False),
        ("db3", "sqlite3", "", False),
        ("mcap_file", "mcap", "", True),
        ("db3_file", "sqlite3", "", True),
        ("zstd_chunks", "mcap", "STORAGE", True),
        ("zstd_messages", "sqlite3", "MESSAGE", False),
        ("zstd_file", "sqlite3", "FILE", False),
        ("ros1.bag", "", "", False),
        ("ros1_lz4.bag", "", "LZ4", False),
        ("ros1_bz2.bag", "", "BZ2", False),
    ],
)
def test_every_bag_storage_is_read(tmp_path, name, storage, compression, single):
    bag = write_bag(tmp_path / name, {"/points": clouds(), "/odom": driven()}, storage, compression)
    if single:
        (bag / "metadata.yaml").unlink()
    run = open_run(only_file(bag) if single else bag)
    assert (len(run), run.notes) == (COUNT, ())
    np.testing.assert_allclose(run.stamps, 1e-9 * np.array(CLOUD_NS), rtol=0, atol=1e-6)
    for k, frame in enumerate(run):
        np.testing.assert_array_equal(frame.points, POINTS + np.float32(k))
        np.testing.assert_allclose(frame.T_odom_body, T_at(CLOUD_NS[k]), atol=1e-4)
        assert not frame.origin.any()
    for k in (5, 2, 3, 0, 7):
        np.testing.assert_array_equal(run.read(k).points, POINTS + np.float32(k))
    with pytest.raises(IndexError):
        run.read(COUNT)


def test_poses_between_samples_are_interpolated(tmp_path):
    between = [ns + 7_000_000 for ns in CLOUD_NS]
    bag = write_bag(tmp_path / "bag", {"/points": clouds(between), "/odom": driven()})
    for T, ns in zip(open_run(bag).poses, between, strict=True):
        np.testing.assert_allclose(T, T_at(ns), atol=5e-4)
        assert abs(T[0, 3] - T_at(ns - 2_000_000)[0, 3]) > 5e-3


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("begin", "end"), [(0.0, 0.1), (-0.1, 0.0)])
@pytest.mark.parametrize("mount", ["0,0,0", "180,10,90,0.3,-0.2,0.5"])
def test_sweep_is_turned_and_then_deskewed(tmp_path, order, begin, end, mount):
    rng = np.random.default_rng(2)
    stamp = START + 400_000_000
    world = transform(T_at(stamp), rng.uniform(-25, 25, (300, 3)))
    times = rng.uniform(begin, end, len(world))
    swept = [transform(inverse(T_at(stamp + round(1e9 * t))), p[None])[0] for p, t in zip(world, times, strict=True)]
    at_once = transform(inverse(T_at(stamp)), world)
    swept[7][1] = np.nan
    seen = transform(inverse(parse_mount(mount).T_body_sensor), np.array(swept)).astype(np.float32)
    bag = write_bag(tmp_path / "bag", {"/points": [cloud(stamp, seen, times, order)], "/odom": driven()})
    frame = open_run(bag, mount=parse_mount(mount)).read(0)
    assert frame.dropped == 1
    kept = np.arange(len(world)) != 7
    assert np.linalg.norm(np.array(swept)[kept] - at_once[kept], axis=1).max() > 0.4
    assert np.linalg.norm(frame.points - at_once[kept], axis=1).max() < 0.01


def test_bag_is_read_once_in_order_without_holding_it(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", {"/points": clouds(), "/odom": driven()})
    begun, ask = [], BagReader.messages
    monkeypatch.setattr(BagReader, "messages", lambda self, *a: begun.append(a) or ask(self, *a))
    run = open_run(bag)
    assert len(begun) == 1
    assert len(list(run)) == COUNT
    assert len(begun) == 2
    run.read(6)
    run.read(7)
    assert len(begun) == 3
    assert begun[2][1] > LATE


def test_bag_can_be_read_from_another_thread(tmp_path):
    run = open_run(write_bag(tmp_path / "bag", {"/points": clouds(), "/odom": driven()}, "sqlite3"))
    seen = []
    reader = threading.Thread(target=lambda: seen.extend(frame.points[0, 0] for frame in run))
    reader.start()
    reader.join()
    assert seen == [POINTS[0, 0] + np.float32(k) for k in range(COUNT)]


def test_several_cloud_topics_need_topic_option(tmp_path):
    topics = {"/rear": clouds(CLOUD_NS[:3]), "/front": clouds(), "/odom": driven(), "/wheel": driven(), "/idle": []}
    bag = write_bag(tmp_path / "bag", topics)
    listed = r"2 topics with sensor_msgs/msg/PointCloud2; choose by --cloud-topic: .*/front \(8 mess.*/rear \(3 "
    with pytest.raises(RunError, match=listed):
        open_run(bag)
    with pytest.raises(RunError, match=r"--odometry-topic: /odom \(50 messages\), /wheel"):
        open_run(bag, cloud_topic="/rear")
    with pytest.raises(RunError, match=r"no topic '/odom' with sensor_msgs.*--cloud-topic may be /front"):
        open_run(bag, cloud_topic="/odom")
    assert len(open_run(bag, cloud_topic="/rear", odometry_topic="/wheel")) == 3


def test_frames_without_odometry_are_skipped_and_counted(tmp_path):
    far = pose_from(np.eye(3), (500.0, 0.0, 0.0))
    gap = [ns for ns in ODOMETRY_NS if ns < START + 300_000_000]
    track = driven(gap) + [odometry(ns, T_at(ns)) for ns in (START + 900_000_000, START + 920_000_000)]
    track += [odometry(ns, far @ T_at(ns)) for ns in (START + 940_000_000, START + 960_000_000)]
    stamps = [START - 5, START + 100_000_000, START + 100_000_000, START + 600_000_000, START + 910_000_000]
    stamps += [START + 930_000_000, START + 940_000_000, START + 960_000_900, START + 970_000_000]
    run = open_run(write_bag(tmp_path / "bag", {"/points": clouds(stamps), "/odom": track}))
    # the first differs from the first sample by less than stamps are good for
    assert [run.read(k).points[0, 0] - POINTS[0, 0] for k in range(len(run))] == pytest.approx(
        [0, 1, 4, 6, 7], abs=1e-4
    )
    assert len(run.notes) == 1
    assert "4 of 9 clouds left out: 3 without odometry around their stamps, 1 with a stamp" in run.notes[0]


def test_odometry_segment_of_a_sweep_stops_at_a_jump():
    stamps = np.array([0, 20, 40, 60, 80], np.int64) * 1_000_000
    poses = np.stack([pose_from(np.eye(3), (0.1 * k + 90.0 * (k > 2), 0.0, 0.0)) for k in range(5)])
    track = Track(stamps, poses)
    for stamp, expected in ((30, [20, 40]), (40, [20, 40]), (60, [60, 80]), (70, [60, 80])):
        segment = track.around(25_000_000, 75_000_000, stamp * 1_000_000)
        np.testing.assert_array_equal(segment.stamps, np.array(expected) * 1_000_000)
    np.testing.assert_array_equal(track.at(stamps + 10_000_000)[1], [True, True, False, True, False])


def test_out_of_order_and_damaged_bag_messages(tmp_path):
    messages = clouds()
    messages[2], messages[3] = messages[3], messages[2]
    messages[5] = messages[5].__class__(**{**vars(messages[5]), "width": 5000})
    samples = driven()
    samples[9].pose.pose.position.x = np.nan
    run = open_run(write_bag(tmp_path / "bag", {"/points": messages, "/odom": samples}))
    assert np.diff(run.stamps).min() > 0.09
    assert run.notes == (f"{tmp_path / 'bag'}: 1 damaged messages left out",)
    assert run.read(2).points[0, 0] == POINTS[0, 0] + 2
    with pytest.raises(CloudError, match=r"bag: cloud of /points at 1700000000\.54.*truncated; skip it"):
        run.read(5)
    assert run.read(6).points[0, 0] == POINTS[0, 0] + 6


def test_bag_with_odometry_file_and_bag_with_single_scan(tmp_path):
    bag = write_bag(tmp_path / "bag", {"/points": clouds()})
    write_tum(tmp_path / "a.tum", [1e-9 * ns for ns in CLOUD_NS[2:]], [T_at(ns) for ns in CLOUD_NS[2:]])
    run = open_run(bag, tmp_path / "a.tum")
    assert (len(run), len(run.notes)) == (COUNT - 2, 1)
    np.testing.assert_allclose(run.poses[0], T_at(CLOUD_NS[2]), atol=1e-5)
    with pytest.raises(RunError, match="give one of them"):
        open_run(bag, tmp_path / "a.tum", odometry_topic="/odom")
    lone = open_run(write_bag(tmp_path / "scan", {"/points": clouds([START])}))
    assert (len(lone), lone.stamps[0]) == (1, 1.7e9)
    np.testing.assert_array_equal(lone.read(0).T_odom_body, np.eye(4))


def test_different_lidar_and_odometry_frames_are_noted(tmp_path):
    messages = [cloud(ns, POINTS, frame="velodyne") for ns in CLOUD_NS]
    run = open_run(write_bag(tmp_path / "bag", {"/points": messages, "/odom": driven()}))
    assert len(run.notes) == 1
    assert "clouds are in frame 'velodyne', odometry moves 'body': taken for one" in run.notes[0]


MOUNT = parse_mount("180,0,30,0.2,0,0.5")
ON_PLATE = parse_mount("0,0,90,0.1,0,0.3").T_body_sensor


def mounted_bag(path, *, odom=True, tree=(), frame="livox_frame"):
    """A lidar on a plate on the body, as ``/tf_static`` has it, whose clouds are POINTS in the body's frame."""
    points = transform(inverse(MOUNT.T_body_sensor), POINTS.astype(np.float64)).astype(np.float32)
    lidar = ("plate", "livox_frame", inverse(ON_PLATE) @ MOUNT.T_body_sensor)
    topics = {"/points": [cloud(ns, points, frame=frame) for ns in CLOUD_NS],
              "/tf_static": [transforms(START, ("base_link", "plate", ON_PLATE), lidar)]}  # fmt: skip
    if odom:
        topics["/odom"] = [odometry(ns, T_at(ns), "base_link") for ns in ODOMETRY_NS]
    if tree:
        topics["/tf"] = [transforms(ns, *tree(ns)) for ns in ODOMETRY_NS]
    return write_bag(path, topics)


@pytest.mark.parametrize("name", ["bag", "ros1.bag"])
def test_mount_is_read_from_static_transforms(tmp_path, name):
    run = open_run(mounted_bag(tmp_path / name))
    assert "/tf_static has the lidar 'livox_frame' on 'base_link': --mount=180,0,30,0.2,0,0.5 is taken" in run.notes[0]
    assert len(run.notes) == 1
    np.testing.assert_allclose(run.mount.T_body_sensor, MOUNT.T_body_sensor, atol=1e-12)
    np.testing.assert_allclose(run.read(3).points, POINTS + 0, atol=1e-4)


def test_newest_static_transform_is_in_force():
    tree, T = FrameTree(), pose_from(rot_z(0.2), [1.0, 0.0, 0.5])
    for T_body_lidar in (np.eye(4), T):
        tree.add(ros2_outputs.encode_transform(T_body_lidar, 0, "base_link", "lidar"), static=True)
    tree.lidar = "lidar"
    np.testing.assert_allclose(tree.mount("base_link"), T, atol=1e-12)


def test_transform_that_nobody_has_set_does_not_hide_the_others(tmp_path):
    static = transforms(START, ("base_link", "camera", np.eye(4)), ("base_link", "livox_frame", MOUNT.T_body_sensor))
    static.transforms[0].transform.rotation.w = 0.0
    topics = {
        "/points": [cloud(ns, POINTS, frame="livox_frame") for ns in CLOUD_NS],
        "/tf_static": [static],
        "/odom": [odometry(ns, T_at(ns), "base_link") for ns in ODOMETRY_NS],
    }
    assert "--mount=180,0,30,0.2,0,0.5 is taken" in open_run(write_bag(tmp_path / "bag", topics)).notes[0]


def test_given_mount_overrides_static_transforms_and_says_so(tmp_path):
    bag = mounted_bag(tmp_path / "bag")
    run = open_run(bag, mount=parse_mount("180,0,0"))
    says = "--mount=180,0,0 is taken; /tf_static has the lidar 'livox_frame' on 'base_link': --mount=180,0,30,0.2,0,0.5"
    assert run.notes == (f"{bag}: {says}",)
    assert np.abs(run.read(0).points - POINTS).max() > 1.0
    assert open_run(bag, mount=MOUNT).notes == ()


def test_mount_is_told_and_not_taken_where_a_file_has_the_odometry(tmp_path):
    write_tum(tmp_path / "a.tum", [1e-9 * ns for ns in CLOUD_NS], [T_at(ns) for ns in CLOUD_NS])
    run = open_run(mounted_bag(tmp_path / "bag"), tmp_path / "a.tum")
    assert run.mount.option == "0,0,0"
    assert "--mount=180,0,30,0.2,0,0.5; give it if" in run.notes[0]


def test_odometry_is_read_from_transforms_where_no_topic_has_it(tmp_path):
    def tree(ns):
        wheel = pose_from(rot_z(1e-9 * (ns - START)), (0.3, 0.2, 0.0))
        T_map_odom = pose_from(np.eye(3), (1e-9 * (ns - START), 5.0, 0.0))
        return ("base_link", "wheel", wheel), ("odom", "base_link", T_at(ns)), ("map", "odom", T_map_odom)

    run = open_run(mounted_bag(tmp_path / "bag", odom=False, tree=tree))
    assert len(run.notes) == 2
    assert "odometry is read from /tf: odom <- base_link" in run.notes[0]
    assert "--mount=180,0,30,0.2,0,0.5 is taken" in run.notes[1]
    for T, ns in zip(run.poses, CLOUD_NS, strict=True):
        np.testing.assert_allclose(T, T_at(ns), atol=1e-4)
    both = open_run(mounted_bag(tmp_path / "both", tree=tree), odometry_topic="/tf")
    np.testing.assert_allclose(both.poses, run.poses)


def test_odometry_from_before_the_static_transform_that_joins_it_to_the_lidar_is_kept():
    tree, on = FrameTree(), ros2_outputs.encode_transform
    tree.lidar = "lidar"
    tree.add(on(np.eye(4), 0, "plate", "lidar"), static=True)
    for ns in (1, 2, 3):
        tree.add(on(pose_from(np.eye(3), [ns, 0.0, 0.0]), ns, "odom", "base_link"), static=False)
        tree.add(on(pose_from(rot_z(ns), [0.0, 0.0, 0.0]), ns, "plate", "shutter"), static=False)
    tree.add(on(np.eye(4), 4, "base_link", "plate"), static=True)
    assert [ns for ns, _ in tree.odometry()[2]] == [1, 2, 3]
    assert "shutter" not in tree._samples


def test_recording_whose_transforms_do_not_move_offers_lidar_odometry(tmp_path):
    with pytest.raises(RunError, match=r"in /tf above the lidar \(base_link <- plate <- livox_frame\); make.*kiss-icp"):
        open_run(mounted_bag(tmp_path / "bag", odom=False))


def test_clouds_in_odometrys_frame_are_taken_back_into_the_body(tmp_path):
    """As FAST-LIO's /cloud_registered."""
    seen = [transform(T_at(ns), POINTS.astype(np.float64)).astype(np.float32) for ns in CLOUD_NS]
    registered = [cloud(ns, points, frame="odom") for ns, points in zip(CLOUD_NS, seen, strict=True)]
    bag = write_bag(tmp_path / "bag", {"/cloud_registered": registered, "/Odometry": driven()})
    run = open_run(bag)
    assert "clouds are in odometry's frame 'odom'" in run.notes[0]
    assert "say so: --mount=0,0,0" in run.notes[0]
    np.testing.assert_allclose(run.read(5).points, POINTS, atol=2e-3)
    own = open_run(bag, mount=parse_mount("0,0,0"))
    np.testing.assert_array_equal(own.read(5).points, seen[5])


def test_clouds_in_the_maps_frame_are_named(tmp_path):
    bag = mounted_bag(tmp_path / "bag", tree=lambda _: [("map", "odom", np.eye(4))], frame="map")
    assert "clouds are in 'map', in which odometry itself moves" in open_run(bag).notes[0]


@pytest.mark.parametrize("name", ["bag", "ros1.bag"])
def test_livox_clouds_are_read_with_their_times(tmp_path, name):
    times = np.linspace(0, 99_000_000, len(POINTS)).astype(int)
    messages = [livox(ns, POINTS + np.float32(k), times) for k, ns in enumerate(CLOUD_NS)]
    still = [odometry(ns, np.eye(4)) for ns in ODOMETRY_NS]
    run = open_run(write_bag(tmp_path / name, {"/livox/lidar": messages, "/odom": still}))
    np.testing.assert_array_equal(run.read(4).points, POINTS + np.float32(4))
    message = run.source.message(4)
    np.testing.assert_allclose(message.times, 1e-9 * times)
    assert message.rings.tolist()[:5] == [0, 1, 2, 3, 0]
    moving = open_run(write_bag(tmp_path / f"moving_{name}", {"/livox/lidar": messages, "/odom": driven()}))
    assert 0.1 < np.abs(moving.read(4).points - POINTS - 4).max() < 3.0  # deskewed


def _cut(bag):
    file = only_file(bag)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return bag


def _unknown_codec(bag):
    file = only_file(bag)
    file.write_bytes(file.read_bytes().replace(b"\4\0\0\0zstd", b"\4\0\0\0snap"))
    return file


def _metadata(bag, old, new):
    text = (bag / "metadata.yaml").read_text()
    assert old in text
    (bag / "metadata.yaml").write_text(text.replace(old, new))
    return bag


@pytest.mark.parametrize(
    ("storage", "compression", "harm", "reason"),
    [
        ("mcap", "", _cut, "end magic.*mcap recover"),
        ("sqlite3", "", _cut, "malformed.*repair it"),
        ("mcap", "STORAGE", _unknown_codec, r"Unsupported chunk compression 'snap'\); write it again with zstd"),
        ("sqlite3", "MESSAGE", lambda b: _metadata(b, "zstd", "brotli"), "'brotli' is not supported.*ros2 bag convert"),
        ("mcap", "", lambda b: _metadata(b, "storage_identifier: mcap", "storage_identifier: other"), "'other'"),
        ("mcap", "", lambda b: _metadata(b, "version: 9", "{"), "YAML.*ros2 bag reindex"),
        ("mcap", "", lambda b: only_file(b).unlink() or b, "missing.*repair it"),
    ],
)
def test_unreadable_bags_are_refused_with_reason(tmp_path, storage, compression, harm, reason):
    bag = write_bag(tmp_path / "bag", {"/points": clouds(), "/odom": driven()}, storage, compression)
    with pytest.raises(RunError, match=reason) as caught:
        open_run(harm(bag))
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "bag") in str(caught.value)


@pytest.mark.parametrize(
    ("topics", "reason"),
    [
        ({}, r"no topic with sensor_msgs/msg/PointCloud2; record one: it has no topics at all"),
        ({"/odom": driven()}, r"no topic with sensor_msgs.*it has /odom \(nav_msgs/msg/Odometry\)"),
        ({"/points": [], "/odom": driven()}, "not one cloud"),
        ({"/points": clouds()}, r"no topic with nav_msgs/msg/Odometry; make it of the clouds: --odometry kiss-icp, or"),
        ({"/points": [b"\0\1\0\0"] * 3, "/odom": driven()}, "not one cloud"),
        ({"/points": clouds([0, 0, 0]), "/odom": driven()}, "all 3 clouds are stamped alike, 0 to 0 s; stamp"),
        ({"/points": clouds([ns // 10**6 for ns in CLOUD_NS]), "/odom": driven()}, "all 8 clouds are stamped alike"),
        ({"/points": clouds([ns // 1000 for ns in CLOUD_NS]), "/odom": driven()}, "are 1,000 times as large"),
        ({"/points": clouds([5 * 10**9, 6 * 10**9]), "/odom": driven()}, "00.98 s; are their clocks the same"),
        ({"/points": clouds(), "/odom": driven([*ODOMETRY_NS, START - 10**10, START])}, "odometry go back by 1"),
    ],
)
def test_bags_without_usable_topics_are_refused(tmp_path, topics, reason):
    with pytest.raises(RunError, match=reason):
        open_run(write_bag(tmp_path / "bag", topics))


def test_directory_of_bags(tmp_path):
    bag = write_bag(tmp_path / "bag", {"/points": clouds(), "/odom": driven()})
    (bag / "metadata.yaml").unlink()
    assert len(open_run(bag)) == COUNT
    (bag / "other.mcap").touch()
    with pytest.raises(RunError, match=r"several recordings \(bag\.mcap, other\.mcap\) without metadata"):
        open_run(bag)


@pytest.mark.slow
def test_locate_command_on_a_bag(world_file, world_drive, tmp_path, capsys):
    stamps = [START + k * 500_000_000 for k in range(7)]
    messages = [cloud(ns, c, frame="lidar") for ns, c in zip(stamps, world_drive.clouds, strict=False)]
    samples = [odometry(ns, T) for ns, T in zip(stamps, world_drive.T_odom_body, strict=False)]
    bag = write_bag(tmp_path / "bag", {"/points": messages, "/odom": samples})
    command = ["locate", str(world_file), str(bag), "-o", str(tmp_path / "out"), "--no-pictures"]
    assert main([*command, "--cloud-topic", "/points", "--odometry-topic", "/odom"]) == 0
    assert capsys.readouterr().err.count("taken for one") == 1
    assert json.loads((tmp_path / "out" / "result.json").read_text())["frames"] == 7
    assert main([*command, "--cloud-topic", "/none"]) == 2
    assert "--cloud-topic may be /points (7 messages)" in capsys.readouterr().err


def test_topic_options_are_refused_for_files(tmp_path):
    write_bag(tmp_path / "bag", {"/points": clouds(), "/odom": driven()})
    (tmp_path / "frames").mkdir()
    with pytest.raises(RunError, match="has no topics"):
        open_run(tmp_path, cloud_topic="/points")


def test_topic_without_a_name_in_a_database_is_refused(tmp_path):
    bag = write_bag(tmp_path / "a", {"/points": [cloud(0, np.ones((5, 3), np.float32))]}, "sqlite3")
    (database,) = bag.glob("*.db3")
    single = database.rename(tmp_path / "b.db3")
    with contextlib.closing(sqlite3.connect(single)) as connection:
        kept = "CREATE TABLE other AS SELECT * FROM topics; DROP TABLE topics; ALTER TABLE other RENAME TO topics;"
        connection.executescript(kept)
        row = connection.execute("SELECT * FROM topics").fetchone()
        connection.execute(f"INSERT INTO topics VALUES ({','.join('?' * len(row))})", (row[0] + 1, None, *row[2:]))
        connection.commit()
    with pytest.raises(RunError, match=r"b\.db3"):
        open_run(single)
