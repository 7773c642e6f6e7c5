"""Evidence as plain data and back."""

import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from coview_stream.geometry.transforms import pose_from, quat_to_matrix, rot_z
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.state import State
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.messages.json_messages import encode_pose
from coview_stream.messages.types import PoseMessage


@pytest.mark.parametrize("cause", [None, *RejectionReason])
def test_evidence_json_round_trip(world_fixes, cause):
    known = world_fixes[-1].evidence
    rounded = replace(
        known,
        score=round(known.score, 4),
        evidence=replace(known.evidence, **{k: round(v, 4) for k, v in vars(known.evidence).items()}),
        cause=cause,
        innovation=None if cause is None else 12.25,
    )
    assert KeyframeEvidence.from_json(json.loads(json.dumps(rounded.to_json()))) == rounded
    blind = KeyframeEvidence(1.5, State.TRACKING, "only 3 points to register", cause=cause)
    assert KeyframeEvidence.from_json(json.loads(json.dumps(blind.to_json()))) == blind


def test_evidence_of_an_earlier_version_can_be_read(world_fixes):
    """Results were written before there were causes, and without the shares where nothing had been registered."""
    data = world_fixes[0].evidence.to_json()
    del data["cause"], data["innovation"]
    assert KeyframeEvidence.from_json(data).cause is None
    blind = KeyframeEvidence(1.5, State.TRACKING, "only 3 points to register", cause=RejectionReason.BLIND)
    short = {key: value for key, value in blind.to_json().items() if value is not None}
    assert "near" not in short
    assert KeyframeEvidence.from_json(short | {"station": None, "shift": None}) == blind


def test_evidence_json_always_has_the_same_keys(world_fixes):
    known = world_fixes[-1].evidence.to_json()
    blind = KeyframeEvidence(1.5, State.SEARCHING, "too few points").to_json()
    assert list(blind) == list(known)
    shares = ("near", "covered", "ground", "free_space", "inside")
    assert [blind[name] for name in shares] == [None] * 5
    assert all(0.0 <= known[name] <= 1.0 for name in shares)


@pytest.mark.parametrize("number", [math.inf, -math.inf, math.nan])
def test_what_is_no_finite_number_is_written_as_null(number):
    """JSON has no other word for it."""
    names = ("innovation", "confidence", "by_chance")
    evidence = KeyframeEvidence(1.5, State.SEARCHING, "odd", **dict.fromkeys(names, number))
    data = json.loads(json.dumps(evidence.to_json(), allow_nan=False))
    assert [data[name] for name in names] == [None] * 3
    small = KeyframeEvidence(1.5, State.TRACKING, "", confidence=1.0 - 1e-12, by_chance=8.8377e-34).to_json()
    assert (small["confidence"], small["by_chance"]) == (1.0 - 1e-12, 8.84e-34)


def test_doubted_evidence_is_written_as_ambiguous_with_its_cause():
    """Files know four states."""
    doubted = KeyframeEvidence(1.5, State.DOUBTED, "covered", cause=RejectionReason.BLIND)
    data = doubted.to_json()
    assert (data["state"], data["cause"]) == ("AMBIGUOUS", "blind")
    assert KeyframeEvidence.from_json(data) == replace(doubted, state=State.AMBIGUOUS)
    assert Fix(1.0, State.DOUBTED).to_json()["state"] == "AMBIGUOUS"
    assert f"{State.TRACKING}" == str(State.TRACKING) == State.TRACKING == "TRACKING"


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
    assert known.state is State.TRACKING
    np.testing.assert_array_equal(data["position"], known.position)
    np.testing.assert_array_equal(np.reshape(data["covariance"], (6, 6)), known.covariance)
    assert repr(known).startswith(f"Fix({known.stamp:.3f} s, TRACKING: x ")
    assert repr(fix()).endswith("sigma 0.037 m, wrong: 1 in 100,000)")


def test_pose_message_is_written_as_the_native_message():
    pose = message()
    assert pose.to_json() == json.loads(encode_pose(pose).payload)
    assert pose.stamp == 1_700_000_000.25
    unsure = message(np.full((6, 6), np.nan))
    assert unsure.to_json()["covariance"] is None
    assert np.isnan(unsure.stddev).all()
    assert "sigma" not in repr(unsure)
    assert repr(pose) == (
        "PoseMessage('rover1', 1700000000.250 s, TRACKING: x 84321.25, y 445678.50, z 3.00 m, yaw 17.2 deg, "
        "sigma 0.037 m)"
    )


@pytest.mark.parametrize("make", [fix, message])
def test_poses_are_equal_to_themselves_only_and_can_be_keys(make):
    one, other = make(), make()
    assert one == one
    assert one != other
    assert other in [one, other]
    assert len({one: 1, other: 2}) == 2
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(one)).T_map_body, T)
