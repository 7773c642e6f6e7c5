"""Runs and their results: how they are named, and which are refused."""

import json

import numpy as np
import pytest
from localized_drives import opened

from coview_stream.clouds.trajectory import read_tum, write_tum
from coview_stream.errors import InputError
from coview_stream.fusion.localized_run import LocalizedRun, parse_pair

pytestmark = pytest.mark.filterwarnings("ignore:.*which map:UserWarning")


def test_paths_with_colons_are_parted_where_both_are_there(tmp_path):
    run, out = tmp_path / "a:b", tmp_path / "c:d"
    run.mkdir(), out.mkdir()
    pair = parse_pair(f"{run}:{out}")
    assert (pair.run, pair.out) == (run, out)
    assert pair.trajectory == out / "trajectory.tum"


def test_what_is_not_there_is_named(tmp_path):
    (tmp_path / "run").mkdir()
    with pytest.raises(InputError, match=r"there is no .*nowhere"):
        parse_pair(f"{tmp_path / 'run'}:{tmp_path / 'nowhere'}")
    with pytest.raises(InputError, match="RUN:OUT"):
        parse_pair("run")


def test_two_ways_to_part_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b:c", "a:b", "c"):
        (tmp_path / name).mkdir()
    with pytest.raises(InputError, match="2 ways"):
        parse_pair("a:b:c")


@pytest.fixture
def results(world_run, world_drive, world_map, tmp_path):
    """Results of all frames but the first two."""
    stamps, _ = read_tum(world_run / "odometry.tum")
    write_tum(tmp_path / "trajectory.tum", stamps[2:], world_drive.T_map_body[2 : len(stamps)])
    return tmp_path


def test_frames_without_a_pose_are_counted(world_run, world_map, results):
    with pytest.warns(UserWarning, match="which map"):
        run = LocalizedRun(parse_pair(f"{world_run}:{results}"), world_map, opened)
    assert (len(run), run.without_pose) == (5, 2)
    assert all(frame is not None for frame in run.frames())
    assert [frame is not None for frame in run.frames(lambda k: k == 1)] == [False, True, False, False, False]


def test_bridged_poses_are_left_out(world_run, world_map, results):
    """Of poses 2 to 6 the fourth and fifth are bridged; a stretch of another kind or without stamps changes nothing."""
    stamps = read_tum(world_run / "odometry.tum")[0].tolist()
    stretches = [
        {"kind": "backward", "first_stamp": stamps[2], "last_stamp": stamps[3]},
        {"kind": "bridged", "first_stamp": stamps[4], "last_stamp": stamps[5]},
        {"kind": "smoothed", "first_stamp": stamps[6], "last_stamp": stamps[6]},
        {"kind": "bridged", "first_stamp": None},
    ]
    (results / "result.json").write_text(json.dumps({"map_sha256": "", "smoothed": stretches}))
    run = LocalizedRun(parse_pair(f"{world_run}:{results}"), world_map, opened)
    np.testing.assert_allclose(run.stamps, [stamps[k] for k in (2, 3, 6)])
    assert run.without_pose == 4


def test_a_trajectory_alone_will_do(world_run, world_map, results):
    pair = parse_pair(f"{world_run}:{results / 'trajectory.tum'}")
    runs = [LocalizedRun(pair, world_map, opened, delay) for delay in (0.0, 0.2)]
    assert [len(run) for run in runs] == [5, 5]
    now, before = (next(frame for frame in run.frames() if frame is not None).T_map_body for run in runs)
    step = np.linalg.norm(np.diff(runs[0].odometry[:, :3, 3], axis=0), axis=1)[0] / np.diff(runs[0].stamps)[0]
    np.testing.assert_allclose(np.linalg.norm(now[:3, 3] - before[:3, 3]), 0.2 * step, rtol=0.2)


def test_results_of_another_map_are_refused(world_run, world_file, results):
    from coview_stream.basemap.basemap import BaseMap

    (results / "result.json").write_text(json.dumps({"map_sha256": "0" * 64}))
    with pytest.raises(InputError, match="another map"):
        LocalizedRun(parse_pair(f"{world_run}:{results}"), BaseMap.load(world_file), opened)


@pytest.mark.parametrize("text", ["{", "[1]", "[" * 100_000])
def test_damaged_results_are_refused(world_run, world_map, results, text):
    (results / "result.json").write_text(text)
    with pytest.raises(InputError, match=r"result\.json"):
        LocalizedRun(parse_pair(f"{world_run}:{results}"), world_map, opened)


def test_a_run_that_was_not_localized_is_refused(world_run, world_map, tmp_path):
    write_tum(tmp_path / "trajectory.tum", [], [])
    with pytest.raises(InputError, match="not localized"):
        LocalizedRun(parse_pair(f"{world_run}:{tmp_path}"), world_map, opened)


@pytest.mark.parametrize("mount", [{"yaw_deg": 90.0, "z_m": 1.0}, {"yaw": float(np.radians(90.0)), "z": 1.0}])
def test_mount_and_lean_of_the_results_are_applied(world_run, world_drive, world_map, results, mount):
    told = {"map_sha256": "", "mount": mount, "calibration": {"roll_deg": 180.0}}
    (results / "result.json").write_text(json.dumps(told))
    run = LocalizedRun(parse_pair(f"{world_run}:{results}"), world_map, opened)
    frame = next(frame for frame in run.frames() if frame is not None)
    raw = world_drive.clouds[2]
    expected = np.column_stack([-raw[:, 1], -raw[:, 0], -(raw[:, 2] + 1.0)])
    assert np.allclose(frame.points, expected, atol=1e-4)
    assert np.allclose(frame.eye, [0.0, 0.0, -1.0], atol=1e-9)
