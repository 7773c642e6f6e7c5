"""Offline localization: what is written is what the localizer said, and damaged frames are skipped."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import small_world
from small_world import pose_error

from coview_stream.clouds.files import write_cloud
from coview_stream.clouds.trajectory import read_tum
from coview_stream.config.mount import Mount
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import pose_from
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.offline import RunResult, from_stream, locate, summary, write
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.state import State
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.recordings.open_run import open_run


@pytest.fixture(scope="module")
def located(world_map, world_run):
    return locate(world_map, open_run(world_run))


def test_every_frame_has_a_correct_fix(located, world_drive, world_fixes):
    assert located.frames == len(located.fixes) == len(located.seconds) == 7
    assert not located.skipped
    assert [f.state for f in located.fixes] == [f.state for f in world_fixes[:7]]
    assert located.state is State.TRACKING
    assert located.posed
    assert located.first is located.posed[0]
    for fix in located.posed:
        k = round((fix.stamp - 100.0) / 0.5)
        assert pose_error(fix.T_map_body, world_drive.T_map_body[k])[0] < 0.08


def test_evidence_of_each_keyframe_is_stored_once(located):
    stamps = [e.stamp for e in located.keyframes]
    assert stamps == sorted(set(stamps))
    assert located.winner.state is State.TRACKING
    assert located.winner.station is not None
    assert located.query


def test_written_files_match_the_fixes(located, world_map, tmp_path):
    out = tmp_path / "deep" / "out"
    write(located, world_map, out)
    for picture in ("trajectory.png", "descriptors.png"):  # of an earlier run
        (out / picture).write_bytes(b"old")
    write(located, world_map, out)
    assert sorted(p.name for p in out.iterdir()) == ["result.json", "trajectory.tum"]
    stamps, poses = read_tum(out / "trajectory.tum")
    np.testing.assert_allclose(stamps, [f.stamp for f in located.posed])
    np.testing.assert_allclose(poses, [f.T_map_body for f in located.posed], atol=1e-5)
    result = json.loads((out / "result.json").read_text())
    assert result["state"] == "TRACKING"
    assert result["first_fix_stamp"] == located.first.stamp
    np.testing.assert_allclose(result["T_map_odom"], located.posed[-1].T_map_odom)
    level = located.posed[-1].protection
    assert result["protection_level"] == level.to_json()
    assert (result["frames"], result["posed"]) == (7, len(located.posed))
    timings = result["timings_s"]
    assert 0 < timings["p50"] <= timings["p95"] <= timings["p99"]
    assert len(result["keyframes"]) == len(located.keyframes)
    assert {"stamp", "state", "reason", "score", "rival", "station", "shift"} <= set(result["keyframes"][0])
    assert all(0 <= k["score"] <= 1 for k in result["keyframes"])


def test_summary_has_state_place_and_time(located):
    text = summary(located)
    assert "TRACKING" in text
    assert f"{len(located.posed)} of 7 frames" in text
    assert "step time" in text
    level = located.posed[-1].protection
    assert f"m, within {level.horizontal:.2f} m, in height {level.vertical:.2f} m, but for 1 in 1,000" in text
    nothing = RunResult(3, [Fix(0.0, State.SEARCHING)], skipped=["000001.ply: empty"])
    assert "0 of 3 frames" in summary(nothing)
    assert "000001.ply: empty" in summary(nothing)


def fix(stamp, posed, cause=None, reason=None):
    """A fix at the origin, or of a robot that has lost its place, with a reason of its cause."""
    pose = (np.eye(4), np.eye(4), np.eye(6)) if posed else (None, None, None)
    state = State.TRACKING if posed else State.LOST
    reason = f"{cause} at {stamp:g}" if reason is None else reason
    return Fix(stamp, state, *pose, evidence=KeyframeEvidence(stamp, state, reason, cause=cause))


def test_calibration_is_written_and_summarized_as_the_mount_that_it_adds_to(world_map):
    leaning = Calibration(pitch=np.radians(2.9))
    upside_down = RunResult(2, [replace(fix(1.0, True), calibration=leaning)], mount=Mount(roll=np.pi))
    found = json.loads(json.dumps(upside_down.to_json(world_map)))["calibration"]
    assert found["pitch_deg"] == 2.9
    assert found["says"][0].startswith("sensor leans 2.9 deg in pitch beyond its mount: corrected; ")
    assert "set --mount=180,2.9,0,0,0,0 to silence" in found["says"][0]
    assert found["says"][0] in summary(upside_down)
    searching = RunResult(1, [Fix(1.0, State.SEARCHING, calibration=leaning)])  # it may be why
    assert "the vehicle or the sensor" in searching.to_json(world_map)["calibration"]["says"][0]  # of one scan
    nothing = RunResult(1, []).to_json(world_map)
    assert nothing["calibration"] is nothing["mount"] is None
    mounted = RunResult(1, [], mount=Mount(yaw=np.radians(30.0), x=1.0)).to_json(world_map)["mount"]
    assert mounted == {"roll_deg": 0, "pitch_deg": 0, "yaw_deg": 30.0, "x_m": 1.0, "y_m": 0, "z_m": 0}


def test_calibration_is_silent_beside_a_fault_that_may_have_spoilt_it(world_map):
    late = Calibration(delay=0.3, sigma_delay=0.01)
    for cause, count in ((RejectionReason.MIXED, 0), (RejectionReason.FITNESS, 1)):
        found = RunResult(2, [fix(0.0, True), replace(fix(1.0, False, cause), calibration=late)])
        assert len(found.to_json(world_map)["calibration"]["says"]) == count
        assert len(found.fixes[1].to_json()["calibration"]["says"]) == count
        assert summary(found).count("set --cloud-delay=0.30: the first poses are off by it") == count


def test_damaged_frames_are_skipped_and_listed(world_map, world_run, world_drive, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(world_run, run)
    (run / "frames" / "000000.ply").write_bytes(b"nonsense")
    write_cloud(run / "frames" / "000002.ply", world_drive.clouds[2][:5])
    calls = []
    found = locate(world_map, open_run(run), progress=lambda *call: calls.append(call))
    assert [(done, total) for done, total, _ in calls] == [(k + 1, 7) for k in range(7)]
    assert calls[0][2] is calls[2][2] is None
    assert len(found.fixes) == 5
    assert len(found.skipped) == 2
    assert all(name in "".join(found.skipped) for name in ("000000.ply", "000002.ply"))
    for fix in found.posed:
        k = round((fix.stamp - 100.0) / 0.5)
        assert pose_error(fix.T_map_body, world_drive.T_map_body[k])[0] < 0.08


def test_run_without_usable_frame_is_an_error(world_map, world_drive, tmp_path):
    run = small_world.write_run(tmp_path / "run", world_drive, 3)
    for path in (run / "frames").iterdir():
        path.write_bytes(b"nonsense")
    with pytest.raises(InputError, match=r"not one of 3 frames.*000000\.ply"):
        locate(world_map, open_run(run))


def test_single_scan_is_enough_where_no_other_place_fits(world_map, world_drive, tmp_path):
    """A scan stored far from its zero keeps its own frame."""
    away = np.array([30_000.0, -20_000.0, 100.0])
    write_cloud(tmp_path / "scan.ply", world_drive.clouds[3].astype(np.float64), away)
    found = locate(world_map, open_run(tmp_path / "scan.ply"))
    (fix,) = found.fixes
    assert fix.state is State.TRACKING
    truth = world_drive.T_map_body[3] @ pose_from(np.eye(3), -away)
    seen = np.array([*away, 1.0])
    # the file's own coordinates of the sensor lead to where the sensor stood
    np.testing.assert_allclose((fix.T_map_body @ seen)[:3], (truth @ seen)[:3], atol=0.1)


def test_unwritable_results_are_an_error(located, world_map, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write the results"):
        write(located, world_map, tmp_path / "file" / "out")


def test_interruptions_are_reported_with_their_reason(world_map):
    spells = [(4, False, "no place stands out"), (3, True, ""), (2, False, "the scan fits less well"), (1, True, "")]
    spells += [(1 + k % 3, k % 2 == 0, f"reason {k}") for k in range(1, 8)]
    fixes, stamp = [], 10.0
    for frames, posed, reason in spells:
        for _ in range(frames):
            fixes.append(fix(stamp, posed, reason=reason))
            stamp += 0.5
    found = RunResult(len(fixes), fixes)
    assert [spell.frames for spell in found.interruptions] == [2, 2, 1, 3, 2]
    first = found.to_json(world_map)["interruptions"][0]
    assert first == {"first_stamp": 13.5, "last_stamp": 14.0, "frames": 2, "reason": "the scan fits less well"}
    text = summary(found)
    assert "2 frames from 3.5 s to 4.0 s: the scan fits less well" in text
    assert "3 frames in 2 more places: see result.json" in text
    assert "without a pose" not in summary(RunResult(1, fixes[4:5]))
    assert not RunResult(4, fixes[:4]).interruptions  # before the first fix it is being sought


def test_faults_of_sensors_are_reported_whether_there_are_poses_or_not(world_map):
    repeated, clock = RejectionReason.REPEATED, RejectionReason.CLOCK
    spells = [(10.0, True, None), (10.5, False, repeated), (11.0, False, None), (11.5, False, repeated)]
    found = RunResult(5, [fix(*spell) for spell in [*spells, (12.0, True, clock)]])
    assert found.to_json(world_map)["faults"] == [
        {"cause": "repeated", "first_stamp": 10.5, "last_stamp": 11.5, "frames": 2, "reason": f"{repeated} at 11.5"},
        {"cause": "clock", "first_stamp": 12.0, "last_stamp": 12.0, "frames": 1, "reason": f"{clock} at 12"},
    ]
    assert re.search(r"^FAULT repeated +2 frames from 0\.5 s to 1\.5 s: .* at 11\.5$", summary(found), re.MULTILINE)
    distrust = "; poses before it are not to be trusted"
    axes = fix(13.0, False, RejectionReason.CONVENTIONS)
    assert re.search(rf"^FAULT conventions .*{distrust}$", summary(RunResult(6, [*found.fixes, axes])), re.MULTILINE)
    assert distrust not in summary(found)
    assert distrust not in summary(RunResult(6, [axes, fix(14.0, True)]))  # it went by
    assert RunResult(6, [axes, fix(14.0, True)]).trusted
    assert not any(RunResult(6, fixes).trusted for fixes in ([*found.fixes, axes], [axes], []))
    unposed = RunResult(2, found.fixes[1:3])
    assert "FAULT repeated" in summary(unposed)
    assert "FAULT" not in summary(RunResult(1, found.fixes[:1]))


def test_run_without_a_pose_has_the_nodes_last_reason_and_the_work_that_it_had_no_time_for():
    def status(reason, ending=False, **counters):
        counted = {"searches": 1, "searches_skipped": 0, "dropped": 0} | counters
        told = {"state": "SEARCHING", "reason": reason, "last_frame_ns": None, "counters": counted}
        return told | {"node": {"ending": ending}}

    end = status("the node is shutting down", ending=True)
    idle = [status("waiting for clouds"), status("too little has been seen"), end]
    assert from_stream([0.0, 0.1], [], idle).reason == "too little has been seen"
    busy = [status("too little has been seen", dropped=1, searches_skipped=3), end]
    late = "the machine had no time for 1 of 2 frames and 3 of 4 keyframes to search for"
    assert from_stream([0.0, 0.1], [], busy).reason == f"{late}; too little has been seen"
    assert from_stream([0.0, 0.1], [], []).reason == ""
    tracked = [busy[0] | {"state": "TRACKING", "last_frame_ns": 100_000_000}, end]
    pose = {"stamp_ns": 0, "position": [0, 0, 0], "orientation": [0, 0, 0, 1], "covariance": [0] * 36, "confidence": 1}
    located = from_stream([0.0, 0.1], [pose], tracked)
    assert [gap.reason for gap in located.interruptions] == ["no pose arrived"]
    assert (located.dropped, located.reason) == (late, "")
