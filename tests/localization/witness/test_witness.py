"""The witness on drives through a world: clouds that lie end the poses, and their cause is named."""

from types import SimpleNamespace

import numpy as np
import pytest
import small_world

from coview_stream.config import RegistrationConfig, TrackingConfig
from coview_stream.geometry.protection import protection_level
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, rotation_angle, transform
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import State
from coview_stream.localization.tracking.map_matching import MapMatch
from coview_stream.localization.tracking.monitor import MatchVerdict, RejectionReason
from coview_stream.localization.tracking.motion import Drift
from coview_stream.localization.tracking.pose_graph import Estimate
from coview_stream.localization.witness.cloud_motion import APART, CloudMotionMeter
from coview_stream.localization.witness.faults import FaultPosterior
from coview_stream.localization.witness.witness import Witness

BEGIN, DT = 18, 0.2  # frame of the fault; seconds, at two metres per second


def follow(world_map, way, clouds):
    """Return the fixes from the fault on, and the metres and degrees that the poses among them are off."""
    localizer, fixes, off = Localizer(world_map), [], []
    for k, cloud in enumerate(clouds):
        fix = localizer.step(cloud, way.T_odom_body[k], DT * k)
        if k >= BEGIN:
            fixes.append(fix)
        elif k > 10:
            assert fix.state is State.TRACKING
        if k >= BEGIN and fix.T_map_body is not None:
            gap = inverse(way.T_map_body[k]) @ fix.T_map_body
            off.append((np.linalg.norm(gap[:3, 3]), np.degrees(rotation_angle(gap))))
    return fixes, np.array(off).reshape(-1, 2)


def causes(fixes):
    return {fix.evidence.cause for fix in fixes}


@pytest.mark.slow
def test_bare_ground_shows_no_motion(scene):
    """Its noise looks like motions of decimetres, which no robot has made."""
    way = [pose_from(np.eye(3), [x, -4.0, small_world.SENSOR_HEIGHT]) for x in (-2.0, 2.0)]
    near = small_world.record_along(scene, way, 2.0)
    way = [pose_from(np.eye(3), [x, -4.0, small_world.SENSOR_HEIGHT]) for x in (100.0, 104.0)]
    far = small_world.record_along(scene, way, 2.0)
    meter = CloudMotionMeter(RegistrationConfig())
    for drive, seen in ((near, True), (far, False)):
        before, now = (
            RawScan(transform(T, cloud), T) for cloud, T in zip(drive.clouds[:2], drive.T_odom_body, strict=False)
        )
        assert (meter.measure(before, now, Calibration()) is not None) is seen


def test_foliage_is_no_cloud_of_another_place():
    """A lidar sees other leaves from each place; where walls end, clouds fit less, but so do their own surfaces."""
    rng = np.random.default_rng(5)
    ground = np.column_stack([*rng.uniform(-15.0, 15.0, (2, 4000)), rng.normal(-1.5, 0.02, 4000)])
    wall = np.column_stack([rng.uniform(-15.0, 15.0, 3000), rng.normal(6.0, 0.02, 3000), rng.uniform(-1.5, 4.0, 3000)])
    across = wall[:, [1, 0, 2]]
    meter, misfits = CloudMotionMeter(RegistrationConfig()), []
    for walls in (True, True, True, True, False, False, False, False):
        scans = []
        for x in (0.0, 1.0):
            bush = rng.uniform([-12.0, -12.0, -0.5], [12.0, 12.0, 3.0], (600, 3)) * rng.choice([-1.0, 1.0], (600, 1))
            bush[:, 2] = np.abs(bush[:, 2])
            seen = np.concatenate([ground, wall, across]) if walls else np.concatenate([ground, bush])
            scans.append(RawScan(seen.astype(np.float32), pose_from(np.eye(3), [x, 0.0, 0.0])))
        seen = meter.measure(*scans, Calibration())
        misfits.append(1.0 if seen is None else seen.misfit)
    assert max(misfits) < APART


def test_a_sparse_first_cloud_makes_no_later_one_unusual():
    """A cloud of few points has no surfaces of its own, which says nothing about how well clouds fit usually."""
    rng = np.random.default_rng(6)
    wall = np.column_stack([rng.uniform(-15.0, 15.0, 3000), rng.normal(6.0, 0.02, 3000), rng.uniform(-1.5, 4.0, 3000)])
    cloud = np.concatenate([wall, wall[:, [1, 0, 2]]])
    meter, misfits = CloudMotionMeter(RegistrationConfig()), []
    for step in (10, 1, 1, 1):
        before = RawScan(cloud.astype(np.float32), np.eye(4))
        now = RawScan(cloud[::step].astype(np.float32), pose_from(np.eye(3), [0.5, 0.0, 0.0]))
        motion = meter.measure(before, now, Calibration())
        assert motion is not None
        misfits.append(motion.misfit)
    assert max(misfits[1:]) < APART


class Steps(FaultPosterior):
    """Note of the steps that a witness compares."""

    def __init__(self):
        super().__init__()
        self.steps = []

    def add(self, step):
        self.steps.append(step)


def compared(clouds, scaled_at=None):
    """Return the steps that a witness compares: a cloud each metre and second, with too few points to register.

    At one of them it becomes known that odometry measures half of the way.
    """
    estimator, drift = CalibrationEstimator(), Drift.of(TrackingConfig())
    witness = Witness(RegistrationConfig(), estimator)
    witness.faults = Steps()
    for k, cloud in enumerate(clouds):
        if k == scaled_at:
            estimator.rescale(2.0, 0.01)
        T = pose_from(np.eye(3), [float(k), 0.0, 0.0])
        witness.add(float(k), cloud, RawScan(np.zeros((1, 3), dtype=np.float32), T), T)
        witness.while_searching(drift)
    return witness.faults.steps


@pytest.mark.parametrize("scaled_at", [0, 3])
def test_scale_of_odometry_is_applied_once(scaled_at):
    steps = compared([np.full((20, 3), k, dtype=np.float32) for k in range(6)], scaled_at)
    driven = [step.odometry.motion[0] for step in steps]
    metre = 2.0 if scaled_at == 0 else 1.0  # seen until then
    assert driven[1:-1] == pytest.approx([metre if k < scaled_at else 2.0 for k in range(2, len(driven))], rel=0.01)


def test_clouds_in_an_array_that_is_filled_anew_are_no_copies():
    def filled():
        array = np.zeros((20, 3), dtype=np.float32)
        for k in range(4):
            array[:] = min(k, 2)
            yield array

    assert [step.copied for step in compared(filled())] == [False, False, True]


def test_hours_without_a_hole_in_the_stamps_make_none_impossible():
    """Else the first cloud that is dropped would prove that all others are late."""
    steps = compared([np.zeros((1, 3), dtype=np.float32)] * 200)
    assert len(steps) == 199
    assert 0.005 < steps[-1].stamps.holes < 0.02


@pytest.mark.parametrize(("cause", "waits"), [(RejectionReason.VERIFIED, True), (RejectionReason.FITNESS, False)])
def test_a_comparison_waits_for_the_frame_after_a_registration_unless_the_map_contradicts(cause, waits):
    """A frame with both would take longest."""
    witness, T = Witness(RegistrationConfig(), CalibrationEstimator()), np.eye(4)
    odometry = SimpleNamespace(drift=Drift.of(TrackingConfig()))
    tracker = SimpleNamespace(odometry=odometry, protection_level=lambda: protection_level(0.01 * np.eye(6), 1.0))
    belief = Estimate(T, 1e-4 * np.eye(6))
    match = MapMatch.without_registration(MatchVerdict(cause, ""), belief)
    witness.faults = note = Steps()
    counts = []
    for k in range(4):
        witness.add(float(k), np.zeros((1, 3), np.float32), RawScan(np.zeros((1, 3), np.float32), T), T)
        assert not witness.between_registrations(tracker)
        counts.append(len(note.steps))
        witness.while_tracking(match, belief, tracker)
        counts.append(len(note.steps))
    assert counts == ([0, 0, 0, 0, 1, 1, 2, 2] if waits else [0, 0, 0, 1, 1, 2, 2, 3])


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_scan_that_is_repeated_ends_the_poses(world_map, way, noise):
    rng = np.random.default_rng(1)
    stuck = [(way.clouds[BEGIN] + rng.normal(0, noise, way.clouds[BEGIN].shape)).astype(np.float32) for _ in range(40)]
    fixes, off = follow(world_map, way, [*way.clouds[:BEGIN], *stuck][: len(way.clouds)])
    assert RejectionReason.REPEATED in causes(fixes)
    assert off[:, 0].max(initial=0.0) < 1.5
    assert all(fix.T_map_body is None for fix in fixes[5:])


@pytest.mark.slow
def test_identical_clouds_from_the_first_frame_are_named_within_five_seconds(world_map, way):
    localizer = Localizer(world_map)
    for k in range(round(5.0 / DT)):
        fix = localizer.step(way.clouds[0], way.T_odom_body[k], DT * k)
        off = 0.0 if fix.T_map_body is None else np.linalg.norm((fix.T_map_body - way.T_map_body[k])[:3, 3])
        assert off < 1.5
    assert fix.T_map_body is None
    assert fix.evidence.reason.startswith("the lidar repeats itself")


TURN, SIDEWAYS = rot_z(np.radians(-10.0)), np.array([0.0, 4.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lying", "cause", "words", "metres", "degrees"),
    [
        (lambda clouds: [cloud @ TURN for cloud in clouds[BEGIN:]], "mount", "turned by 10 degrees", np.inf, 5.0),
        (lambda clouds: [cloud + SIDEWAYS for cloud in clouds[BEGIN:]], "mount", "", 3.0, np.inf),
        (lambda clouds: clouds[BEGIN - 5 : -5], "clock", "", 1.5, np.inf),
    ],
    ids=["a sensor that turns on its mount", "clouds that jump", "late by a second: a queue has filled"],
)
def test_clouds_that_lie_end_the_poses(world_map, way, lying, cause, words, metres, degrees):
    clouds = [*way.clouds[:BEGIN], *(cloud.astype(np.float32) for cloud in lying(way.clouds))]
    fixes, off = follow(world_map, way, clouds)
    assert cause in causes(fixes)
    assert any(words in fix.evidence.reason for fix in fixes)
    assert off[:, 0].max(initial=0.0) < metres
    assert off[:, 1].max(initial=0.0) < degrees
