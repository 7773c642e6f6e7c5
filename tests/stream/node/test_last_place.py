"""The last pose on disk: comes back as it was, or not at all, and never as an exception."""

import json
import logging
import os
from dataclasses import replace

import numpy as np
import pytest
from se3 import exp_se3

from coview_stream.geometry.transforms import pose_from
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.stream.node.last_place import LastPlace, default_folder, file_of, load, save

SHA = "0123456789abcdef" * 4
UTM = [512_345.678_901, 5_403_210.123_456, 287.4]
LAST = LastPlace(SHA, 1_700_000_000_123_456_789, exp_se3(np.array([0.02, -0.01, 2.1, *UTM])))


def same(a, b):
    assert (a.map_sha256, a.stamp_ns) == (b.map_sha256, b.stamp_ns)
    np.testing.assert_array_equal(a.T_map_body, b.T_map_body)  # every bit


def test_newest_pose_comes_back(tmp_path):
    folder = tmp_path / "made" / "now"
    save(folder, "r1", replace(LAST, stamp_ns=LAST.stamp_ns - 5, T_map_body=np.eye(4)))
    path = save(folder, "r1", LAST)
    assert [path.name] == [p.name for p in folder.iterdir()] == ["r1-0123456789abcdef.json"]
    loaded = load(folder, "r1", SHA)
    same(loaded, LAST)
    assert loaded.T_map_body.dtype == np.float64


@pytest.mark.parametrize(
    "known",
    [
        Calibration(0.01, -0.05, 0.03, 1e-4, 0.002, 0.001, 1e-5),
        Calibration(heading=-0.5, lever_x=0.6, delay=-0.3, sigma_heading=0.01, sigma_lever=0.1, sigma_delay=0.004),
        CalibrationEstimator(sensor_leans=False).calibration,  # lidar odometry knows the tilt: its sigma is zero
    ],
)
def test_calibration_comes_back_with_the_pose(tmp_path, known):
    save(tmp_path, "r1", replace(LAST, calibration=known))
    assert load(tmp_path, "r1", SHA).calibration == known
    save(tmp_path, "r1", LAST)
    assert load(tmp_path, "r1", SHA).calibration is None


@pytest.mark.parametrize(
    "wrong",
    [
        *(5, [1.0], {"roll": "x"}, {"pitch": 1.5}, {"sigma_tilt": -0.1}, {"scale": float("nan")}),
        *({"ground": float("nan")}, {"heading": 4.0}, {"lever_x": 200.0}, {"delay": 59.0}),
        {"sigma_delay": -1.0},
    ],
)
def test_calibration_of_no_robot_spoils_the_file(tmp_path, caplog, wrong):
    path = save(tmp_path, "r1", LAST)
    document = json.loads(path.read_text()) | {"calibration": wrong}
    path.write_text(json.dumps(document))
    assert load(tmp_path, "r1", SHA) is None
    assert "no last pose that can be used" in caplog.text


def test_calibration_with_fields_of_another_release_is_read(tmp_path):
    path = save(tmp_path, "r1", LAST)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"calibration": {"pitch": 0.05, "phase_of_moon": 3}}))
    assert load(tmp_path, "r1", SHA).calibration == Calibration(pitch=0.05)


def test_each_robot_and_map_has_its_own_file(tmp_path, caplog):
    save(tmp_path, "r1", LAST)
    save(tmp_path, "r2", LAST)
    save(tmp_path, "r1", replace(LAST, map_sha256="f" * 64))
    assert len(list(tmp_path.iterdir())) == 3
    assert load(tmp_path, "r3", SHA) is None
    assert load(tmp_path, "r1", "e" * 64) is None
    assert load(tmp_path / "not there", "r1", SHA) is None
    assert not caplog.records


NAMES = ("site/hall 3/r1", "..", "a\\b", "C:r1", "Roboter Ä", "R1", "rué" * 90, "con", "a%2Fb", "r1.json", "-")


@pytest.mark.parametrize("name", NAMES)
def test_any_robot_name_gives_a_safe_file_name(tmp_path, name):
    save(tmp_path / "state", name, LAST)
    same(load(tmp_path / "state", name, SHA), LAST)
    (file,) = (tmp_path / "state").iterdir()
    assert file.name.isascii()
    assert len(file.name) < 120
    assert not set(file.name) & set('\\/:*?"<>|')


def test_file_names_are_unique_ignoring_case(tmp_path):
    names = [*NAMES, "r1", "con/", "a/b", "rué" * 91, "CON"]
    assert len({file_of(tmp_path, n, SHA).name.lower() for n in names}) == len(names)


def document(**changes):
    fields = {
        "format": "coview_stream last pose", "version": 1, "robot": "r1", "map_sha256": SHA, "stamp_ns": 5,
        "T_map_body": np.eye(4).tolist(),
    } | changes  # fmt: skip
    return json.dumps({name: value for name, value in fields.items() if value is not None})


USELESS = {
    "empty": "",
    "cut off": document()[:-20],
    "no text": b"\xff\xfe\x00\x80",
    "a list": "[1, 2]",
    "something else": document(format="result"),
    "a later version": document(version=2),
    "no version": document(version=None),
    "another robot": document(robot="r2"),
    "another map with the same 16 digits": document(map_sha256=SHA[:16] + "0" * 48),
    "no pose": document(T_map_body=None),
    "3 x 3": document(T_map_body=np.eye(3).tolist()),
    "ragged": document(T_map_body=[[1, 0], [0]]),
    "words": document(T_map_body=[["a"] * 4] * 4),
    "not finite": document(T_map_body=pose_from(np.eye(3), [np.nan, 0, 0]).tolist()),
    "scaled": document(T_map_body=(2.0 * np.eye(4)).tolist()),
    "mirrored": document(T_map_body=np.diag([1.0, -1.0, 1.0, 1.0]).tolist()),
    "no stamp": document(stamp_ns=None),
    "endless stamp": document(stamp_ns=float("inf")),
    "deep": "[" * 60_000,
    "long": document() + " " * 70_000,
    "huge number": '{"format": "coview_stream last pose", "version": ' + "9" * 5000 + "}",
}


@pytest.mark.parametrize("kind", USELESS)
def test_unusable_content_is_a_warning_naming_the_file(tmp_path, caplog, kind):
    content = USELESS[kind]
    path = file_of(tmp_path, "r1", SHA)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert load(tmp_path, "r1", SHA) is None
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert str(path) in record.getMessage()
    assert len(record.getMessage()) < len(str(path)) + 250
    save(tmp_path, "r1", LAST)  # and the next pose takes its place
    assert load(tmp_path, "r1", SHA) is not None


def test_failed_save_raises_and_keeps_the_old_pose(tmp_path, full_disk):
    save(tmp_path, "r1", LAST)
    with full_disk(100), pytest.raises(OSError, match="too large"):
        save(tmp_path, "r1", replace(LAST, stamp_ns=9))
    same(load(tmp_path, "r1", SHA), LAST)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        save(tmp_path / "file", "r1", LAST)


@pytest.mark.skipif(os.name != "posix", reason="modes and links as in POSIX")
def test_only_the_owner_may_read_and_no_link_is_followed(tmp_path):
    folder = tmp_path / "state"
    foreign = tmp_path / "foreign"
    foreign.write_text("mine")
    path = save(folder, "r1", LAST)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert path.stat().st_mode & 0o777 == 0o600
    path.unlink()
    path.symlink_to(foreign)
    save(folder, "r1", LAST)
    assert foreign.read_text() == "mine"
    assert not path.is_symlink()


@pytest.mark.skipif(os.name != "posix", reason="links and pipes as in POSIX")
@pytest.mark.parametrize("kind", ["directory", "link", "pipe"])
def test_anything_but_a_file_is_a_warning(tmp_path, caplog, kind):
    path = file_of(tmp_path, "r1", SHA)
    if kind == "link":
        path.symlink_to(save(tmp_path / "elsewhere", "r1", LAST))
    else:
        (os.mkfifo if kind == "pipe" else os.mkdir)(path)
    assert load(tmp_path, "r1", SHA) is None
    assert f"{path}: the last pose cannot be read" in caplog.text


@pytest.mark.parametrize(
    ("named", "folder"),
    [("{}", "coview-stream"), *((name, "home/.local/state/coview-stream") for name in ("", "relative"))],
)
def test_default_state_folder(monkeypatch, tmp_path, named, folder):
    monkeypatch.setenv("XDG_STATE_HOME", named.format(tmp_path))
    monkeypatch.setenv("HOME", f"{tmp_path}/home")
    assert default_folder() == tmp_path / folder
