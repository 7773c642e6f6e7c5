"""``coview-stream locate``: files and exit code for success, failure and bad input."""

import json
import re
import shlex
import shutil

import numpy as np
import pytest

from coview_stream.cli import main
from coview_stream.clouds.trajectory import read_tum, write_tum


@pytest.mark.slow
def test_run_on_the_map_is_localized(world_file, world_run, world_drive, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["locate", str(world_file), str(world_run), "-o", str(out)]) == 0
    captured = capsys.readouterr()
    assert "TRACKING" in captured.out
    found = re.search(r"^found +after (.*) m: wrong (?:less than )?1 in [\d,]+$", captured.out, re.MULTILINE)
    assert captured.err == ""
    stamps, _ = read_tum(out / "trajectory.tum")
    result = json.loads((out / "result.json").read_text())
    assert found[1] == f"{result['first_fix_m']:.1f}"
    before = np.array(world_drive.T_odom_body)[: round((stamps[0] - 100.0) / 0.5) + 1, :3, 3]
    driven = np.linalg.norm(np.diff(before, axis=0), axis=1).sum()
    assert result["first_fix_m"] == pytest.approx(driven, abs=1e-3)
    assert result["confidence"] > 1.0 - 1e-4
    searched = [k for k in result["keyframes"] if k["stamp"] <= stamps[0]]
    assert all(0.0 <= k["confidence"] <= 1.0 and k["by_chance"] >= 0.0 for k in searched)
    assert searched[-1]["confidence"] == pytest.approx(result["confidence"], abs=1e-15)
    assert (out / "trajectory.png").exists()


@pytest.mark.slow
def test_smoothed_poses_are_written_beside_the_live_ones(world_file, world_run, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["locate", str(world_file), str(world_run), "-o", str(out), "--smooth", "--export", "csv"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"^smoothed +\d+ frames with a live pose, ", printed, re.MULTILINE)
    assert "trajectory.tum, filtered.tum, result.json, trajectory.csv, trajectory.png" in printed
    live, smoothed = (read_tum(out / name)[0] for name in ("filtered.tum", "trajectory.tum"))
    assert set(live) <= set(smoothed)
    lines = (out / "trajectory.csv").read_text().splitlines()
    kinds = [line.rsplit(",", 1)[1] for line in lines[1:]]
    assert (lines[0].rsplit(",", 1)[1], kinds.count("smoothed"), len(kinds)) == ("kind", len(live), len(smoothed))


def test_run_outside_the_map_exits_with_one(world_file, elsewhere_run, tmp_path, capsys):
    out = tmp_path / "out"
    given = ["--mount=0,0,1", "--cloud-delay=-0.01"]
    assert main(["locate", str(world_file), str(elsewhere_run), "-o", str(out), "--no-pictures", *given]) == 1
    captured = capsys.readouterr()
    assert "0 of 3 frames" in captured.out
    asked = shlex.join(["coview-stream", "doctor", str(world_file), "--run", str(elsewhere_run), *given])
    assert captured.out.endswith(f"\nwhy, and what to do: {asked}\n")
    assert captured.err == ""
    assert (out / "trajectory.tum").read_text() == ""
    result = json.loads((out / "result.json").read_text())
    assert result["state"] in ("SEARCHING", "AMBIGUOUS")
    assert result["T_map_odom"] is None
    assert result["first_fix_stamp"] is None
    assert result["first_fix_m"] is None
    assert result["confidence"] is None
    assert all(k["state"] in ("SEARCHING", "AMBIGUOUS") for k in result["keyframes"])
    assert sorted(p.name for p in out.iterdir()) == ["result.json", "trajectory.tum"]


def test_stamps_in_milliseconds_are_noted(world_file, elsewhere_run, tmp_path, capsys):
    stamps, poses = read_tum(elsewhere_run / "odometry.tum")
    write_tum(tmp_path / "ms.tum", 1000.0 * stamps, poses)
    given = ["-o", str(tmp_path / "out"), "--no-pictures", "--odometry", str(tmp_path / "ms.tum")]
    main(["locate", str(world_file), str(elsewhere_run), *given])
    err = capsys.readouterr().err
    assert err == f"{elsewhere_run}: stamps look like milliseconds, 500 from one frame to the next; write seconds\n"


@pytest.mark.slow
def test_clouds_of_identical_bytes_are_named_in_the_summary(world_file, world_run, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(world_run, run)
    first, *others = sorted((run / "frames").iterdir())
    for path in others:
        shutil.copy(first, path)
    main(["locate", str(world_file), str(run), "-o", str(tmp_path / "out"), "--no-pictures"])
    printed = capsys.readouterr().out
    assert "the lidar repeats itself" in printed
    assert printed.endswith(f"\nwhy, and what to do: coview-stream doctor {world_file} --run {run}\n")


def test_bad_paths_and_options_are_one_line(world_file, world_run, tmp_path, refused):
    out = ["-o", str(tmp_path / "out")]
    (tmp_path / "file").write_text("")
    wheel = tmp_path / "wheel.tum"
    write_tum(wheel, [1.0], [np.eye(4)])
    for arguments, text in (
        ([str(tmp_path / "none.coview"), str(world_run), *out], "none.coview"),
        ([str(world_run / "odometry.tum"), str(world_run), *out], "not a coview map"),
        ([str(world_run), str(world_file), *out], "is a run, no map"),
        ([str(world_file), str(tmp_path / "none"), *out], "none"),
        ([str(world_file), str(tmp_path), *out], tmp_path.name),
        ([str(world_file), str(world_run), "-o", str(tmp_path / "file")], "is a file"),
        ([str(world_file), str(world_run), "-o", str(world_run)], "lies in the run"),
        ([str(world_file), str(world_run), "-o", str(world_run / "out")], "lies in the run"),
        ([str(world_file), str(world_run), *out, "--odometry", str(tmp_path / "no.tum")], "no.tum"),
        ([str(world_file), str(world_run), *out, "--odometry", str(wheel)], "wheel.tum"),
        ([str(world_file), str(world_run), *out, "--reloc", "magic"], "--reloc"),
        ([str(world_file), str(world_run), *out, "--gravity", "level"], "--gravity goes with --odometry kiss-icp"),
        ([str(world_file), str(world_run), *out, "--odometry", "kiss-icp", "--gravity="], "ground, level, or three"),
        ([str(world_file), *out], "RUN"),
    ):
        assert text in refused("locate", *arguments)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        *(([f"--initial={text}"], "--initial") for text in ("here", "1", "1,2,3,4", "nan,2")),
        (["--initial=9000,9000"], "no ground within 5 m"),
        (["--within=200"], "--within"),
        (["--initial=1,2", "--within=3"], "--within"),
        (["--initial=1,2", "--within=x"], "--within"),
    ],
)
def test_bad_initial_place_or_circle_is_refused(world_file, world_run, tmp_path, refused, words, message):
    assert message in refused("locate", world_file, world_run, "-o", tmp_path / "out", *words)
    assert not (tmp_path / "out").exists()


def test_initial_places_of_robots_are_named():
    from coview_stream.cli.options import initial_guesses
    from coview_stream.errors import ConfigError

    found = initial_guesses(["a=1,2,90", "b=3,4"], ["a", "b"])
    assert (found["a"].x, found["a"].y, found["b"].yaw) == (1.0, 2.0, None)
    assert found["a"].yaw == pytest.approx(1.5708, abs=1e-4)
    assert initial_guesses(["1,2"], ["a"])["a"].y == 2.0
    for wrong in (["c=1,2"], ["1,2"], ["a=1"]):
        with pytest.raises(ConfigError):
            initial_guesses(wrong, ["a", "b"])
