"""Who is believed about the tilt: registration, walls, or the ground, and how fast the odometry frame turns."""

import numpy as np
import pytest

from coview_stream.odometry.gravity import Plumb
from coview_stream.odometry.tilt_filter import Since, TiltFilter, upright

DEGREE = np.radians(1.0)
METRES = 0.5


def run(frame, walls, slope, frames=300, drift=0.0, outlier=None, facing=None):
    """Errors (K, 2) in degrees of the tilt that is left, and of registration's own; sigmas in degrees."""
    rng = np.random.default_rng(0)
    tilt, ground, left, own = np.zeros(2), np.array([1.0, -2.0]), [], []
    filtered = TiltFilter(10 * DEGREE)
    covariance = (2.0 * DEGREE) ** 2 / 50 * np.eye(2)
    for k in range(frames):
        tilt = tilt + np.array([drift, 0.0])
        n = rng.normal(0, frame, 2) * (k > 0)
        ground = ground + rng.normal(0, slope, 2)
        seen_walls = None if walls is None else (tilt + n + rng.normal(0, walls, 2)) * DEGREE
        seen_ground = (tilt + n + ground + (outlier[1] if outlier and k == outlier[0] else 0.0)) * DEGREE
        if facing is not None:
            seen_walls[facing] += rng.normal(0, 20) * DEGREE
            covariance[facing, facing] = (30 * DEGREE) ** 2
        R = upright(filtered.update(Plumb(seen_walls, covariance, seen_ground), METRES))
        turned = filtered.turn()
        tilt = tilt - turned / DEGREE
        own.append(tilt + n)
        left.append((R @ [*((tilt + n) * DEGREE), 1.0])[:2] / DEGREE)
    return np.array(left), np.array(own)


def jitter(errors):
    return np.sqrt((np.diff(errors[20:], axis=0) ** 2).mean())


def test_good_walls_outvote_registration_that_rings_hold_fast():
    left, own = run(frame=0.5, walls=0.05, slope=0.1)
    assert jitter(own) > 0.6
    assert jitter(left) < 0.15
    assert np.abs(left[20:]).max() < 0.4


def test_slow_drift_is_taken_out_by_walls():
    left, _ = run(frame=0.05, walls=0.1, slope=0.1, frames=600, drift=0.005)  # 3 degrees in all
    assert np.abs(left[-100:]).max() < 0.4


@pytest.mark.parametrize(
    ("walls", "facing", "most"),
    [(1.0, None, 1.3), (None, None, 1.3), (0.1, 1, 1.5)],
    ids=["bad walls", "ground alone", "walls that face one way"],
)
def test_good_registration_is_not_shaken(walls, facing, most):
    left, own = run(frame=0.03, walls=walls, slope=0.05, facing=facing)
    assert jitter(left) < most * jitter(own)


def test_jump_of_the_ground_does_not_tilt_the_pose():
    left, _ = run(frame=0.03, walls=0.3, slope=0.05, outlier=(200, 8.0))
    assert np.abs(left[195:205]).max() < 0.35


def test_frame_turns_slowly_for_gravity_learnt_late():
    filtered = TiltFilter(10 * DEGREE)
    turns = []
    for k in range(50):
        walls = np.array([0.0 if k == 0 else 3.0, 0.0]) * DEGREE
        filtered.update(Plumb(walls, (0.2 * DEGREE) ** 2 * np.eye(2), None), METRES)
        turns.append(np.linalg.norm(filtered.turn()) / DEGREE)
    assert 0.0 < max(turns) <= 1.5 * 0.2 * 3.0


def test_guess_is_tilted_as_walls_have_it_and_nothing_is_learnt():
    filtered = TiltFilter(0.5 * DEGREE)
    seen = Plumb(np.array([1.0, -2.0]) * DEGREE, (0.1 * DEGREE) ** 2 * np.eye(2), None)
    filtered.update(Plumb(np.zeros(2), seen.covariance, None), 0.0)
    before = filtered.frame_tilt
    assert filtered.expected(seen, 2.0 * DEGREE) / DEGREE == pytest.approx([1.0, -2.0], abs=0.25)
    assert filtered.frame_tilt == before


@pytest.mark.parametrize(("degrees", "believed"), [(27.0, False), (4.0, True)])
def test_body_is_not_turned_over_in_an_instant(degrees, believed):
    filtered = TiltFilter(0.5 * DEGREE)
    nothing, still = Plumb(None, np.eye(2), None), Since(np.zeros(2), 2.0 * DEGREE)
    for _ in range(50):
        filtered.update(nothing, METRES, still)
    seen = np.array([degrees, 0.0]) * DEGREE
    tilt = filtered.update(nothing, METRES, Since(seen, 2.0 * DEGREE))
    assert np.linalg.norm(tilt - (0.0 if believed else seen)) < 1.5 * DEGREE


def test_body_that_walls_and_ground_have_tilted_is_tilted():
    filtered = TiltFilter(0.5 * DEGREE)
    upright_seen = Plumb(np.zeros(2), (0.2 * DEGREE) ** 2 * np.eye(2), np.zeros(2))
    for _ in range(50):
        filtered.update(upright_seen, METRES, Since(np.zeros(2), 2.0 * DEGREE))
    tilt = filtered.update(upright_seen, METRES, Since(np.array([10.0, 0.0]) * DEGREE, 2.0 * DEGREE))
    assert np.linalg.norm(tilt) < 0.5 * DEGREE


def test_frames_without_walls_and_ground_are_left_alone():
    filtered = TiltFilter(DEGREE)
    nothing = Plumb(None, np.eye(2), None)
    for _ in range(5):
        assert (filtered.update(nothing, METRES) == 0).all()
        assert (filtered.turn() == 0).all()
    filtered.restart()
    assert (filtered.update(nothing, METRES) == 0).all()


def test_upright_turns_a_direction_to_z():
    tilt = np.array([0.3, -0.2])
    assert np.allclose(upright(tilt) @ [*tilt, np.sqrt(1 - tilt @ tilt)], [0, 0, 1])
    assert np.allclose(upright(np.zeros(2)), np.eye(3))
