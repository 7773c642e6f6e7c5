"""A fix and a pose message as separate numbers, as plain data, in one line, and as what can be a key."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from coview_stream.geometry.transforms import pose_from, quat_to_matrix, rot_z
from coview_stream.localization.result import Fix
from coview_stream.localization.state import State
from coview_stream.messages.json_messages import encode_pose
from coview_stream.messages.types import PoseMessage

T = pose_from(rot_z(0.3), [84_321.25, 445_678.5, 3.0])
COVARIANCE = np.diag(np.square([0.01, 0.02, 0.03, 0.001, 0.002, 0.003]))


def fix():
    return Fix(12.5, State.TRACKING, T.copy(), T.copy(), COVARIANCE.copy(), 0.99999)


def message(covariance=COVARIANCE):
    return PoseMessage(1_700_000_000_250_000_000, "rover1", "TRACKING", T.copy(), covariance, 0.9, "ab" * 32)


@pytest.mark.parametrize("pose", [fix(), message()])
def test_numbers_are_those_of_matrix_and_covariance(pose):
    np.testing.assert_array_equal(pose.position, T[:3, 3])
    assert pose.yaw == pytest.approx(0.3)
    np.testing.assert_allclose(quat_to_matrix(pose.quaternion), T[:3, :3], atol=1e-12)
    np.testing.assert_allclose(pose.stddev, [0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    pose.position[:] = 0.0  # a copy
    np.testing.assert_array_equal(pose.T_map_body, T)


def test_fix_without_a_pose_has_no_numbers():
    lost = Fix(12.5, State.LOST)
    assert (lost.position, lost.yaw, lost.quaternion, lost.stddev) == (None,) * 4
    assert repr(lost) == "Fix(12.500 s, LOST)"
    assert lost.to_json().keys() == fix().to_json().keys()
    assert lost.to_json()["position"] is None


def test_real_fixes_can_be_written_as_json(world_fixes):
    for known in world_fixes:
        data = json.loads(json.dumps(known.to_json(), allow_nan=False))
        assert data["state"] == known.state.reported
        assert "\n" not in repr(known)
        assert len(repr(known)) < 300
    assert known.state is State.TRACKING
    np.testing.assert_array_equal(data["position"], known.position)
    np.testing.assert_array_equal(np.reshape(data["covariance"], (6, 6)), known.covariance)
    assert repr(known).startswith(f"Fix({known.stamp:.3f} s, TRACKING: x ")
    assert repr(fix()).endswith("sigma 0.037 m, wrong: 1 in 100,000)")


def test_doubted_fix_is_reported_as_ambiguous():
    assert Fix(1.0, State.DOUBTED).to_json()["state"] == "AMBIGUOUS"


def test_pose_message_is_written_as_the_native_message():
    pose = message()
    assert pose.to_json() == json.loads(encode_pose(pose).payload)
    assert pose.stamp == 1_700_000_000.25
    assert repr(pose) == (
        "PoseMessage('rover1', 1700000000.250 s, TRACKING: x 84321.25, y 445678.50, z 3.00 m, yaw 17.2 deg, "
        "sigma 0.037 m)"
    )


def test_pose_message_without_a_covariance_says_null():
    pose = message(np.full((6, 6), np.nan))
    assert pose.to_json()["covariance"] is None
    assert np.isnan(pose.stddev).all()
    assert "sigma" not in repr(pose)


@pytest.mark.parametrize("make", [fix, message])
def test_poses_are_equal_to_themselves_only_and_can_be_keys(make):
    one, other = make(), make()
    assert one == one
    assert one != other
    assert other in [one, other]
    assert len({one: 1, other: 2}) == 2


def test_fix_survives_pickling():
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fix())).T_map_body, T)


def test_a_state_is_its_name():
    assert f"{State.TRACKING}" == str(State.TRACKING) == State.TRACKING == "TRACKING"
