"""Changed ground is left out, the height goes on without it, and the variance covers the heights that are possible."""

from dataclasses import replace

import numpy as np
import pytest
from huts import GROUND, with_huts

import coview_kernels as kernels
from coview_stream.basemap.likelihood_field import field_arrays, field_of
from coview_stream.geometry.protection import NO_OTHER
from coview_stream.geometry.transforms import exp_so3, pose_from, transform
from coview_stream.localization.calibration.ground_change import GroundChange
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud

HERE = np.array([0.0, 0.0, 1.5])
"""Position of the body above the ground as surveyed."""


class Site:
    """Rolling ground with huts on it: walls and flat roofs, 60 x 60 m; ``now`` digs the ground."""

    def __init__(self, huts=24, seed=5):
        self.rng = rng = np.random.default_rng(seed)
        places = rng.uniform(-27, 27, (huts, 2))
        rows = np.column_stack([places, self.level(places), rng.uniform(3.0, 7.0, huts)])
        self.points, normals, above = with_huts(self.level(GROUND), rows)
        self.ground = ~above
        surveyed = np.ones((32, 32), dtype=bool)
        self.field = field_of(field_arrays(self.points, normals, surveyed, np.array([-32.0, -32.0]), 2.0))
        self.target = LocalMap(self.points, normals)

    @staticmethod
    def level(xy):
        return 0.4 * np.sin(xy[:, 0] / 7.0) + 0.3 * np.cos(xy[:, 1] / 9.0)

    def now(self, change=lambda xy: np.zeros(len(xy))):
        """Scan from the middle, odometry frame, which is the map's; ``change`` (N,) metres of the ground."""
        points = self.points + self.rng.normal(0.0, 0.02, self.points.shape).astype(np.float32)
        points[self.ground, 2] += change(points[self.ground, :2]).astype(np.float32)
        height = np.where(self.ground, 0.0, points[:, 2] - self.level(points[:, :2])).astype(np.float32)
        near = np.flatnonzero((np.hypot(points[:, 0], points[:, 1]) < 28.0) & ((height < 0.5) | (height > 1.0)))
        return RegistrationCloud(points[near], height[near] > 0.5, height[near])


def view(change, site, scan, registered=0.0, driven=1.0):
    """One view at a registered height that is ``registered`` metres off; the scan without changed ground, the rise."""
    T = pose_from(np.eye(3), [0.0, 0.0, registered])
    left = change.without_changed(scan, T, HERE, site.target)
    return left, change.learn(T, HERE, site.target, driven, 0.004**2 * driven)


@pytest.fixture(scope="module")
def site():
    return Site()


def test_ground_as_surveyed_is_kept_and_other_heights_become_improbable(site):
    change, sigmas = GroundChange(site.field), []
    for _ in range(12):
        left, rise = view(change, site, site.now())
        sigmas.append(change.others.variance**0.5)
        assert rise == 0.0
    assert len(left.points) == pytest.approx(len(site.now().points), rel=0.01)
    assert left.changed < 0.02
    assert change.others.reach < 0.5
    assert sigmas[-1] < 0.02 < sigmas[0]
    assert change.probability < 0.01
    assert change.metres == 0.0


def test_ground_far_from_any_that_the_survey_has_is_kept_to_the_last_point(site):
    xy = np.stack(np.meshgrid(*[np.arange(-78.0, 79.0, 4.0)] * 2), axis=-1).reshape(-1, 2)
    far = np.column_stack([xy, site.level(xy)])[np.abs(xy).max(axis=1) > 48.0].astype(np.float32)
    none = np.zeros(len(far), dtype=bool)
    for change in (GroundChange(site.field) for _ in range(5)):
        for _ in range(2):
            scan = site.now()
            points = np.concatenate([scan.points, far])
            above, height = np.append(scan.above, none), np.append(scan.height, np.zeros(len(far), dtype=np.float32))
            wide = RegistrationCloud(points, above, height)
            left, _ = view(change, site, wide)
        assert (np.abs(left.points[:, :2]).max(axis=1) > 48.0).sum() == len(far)


def test_ground_that_is_dug_beside_the_robot_is_left_out_and_the_height_stays(site):
    """As on the ramp of a pit: half of the patches lie below the survey's, at many depths."""

    def pit(xy):
        return -2.5 * np.clip((xy[:, 0] - 2.0) / 8.0, 0.0, 1.0)

    change = GroundChange(site.field)
    for _ in range(3):
        view(change, site, site.now())
    for _ in range(6):
        scan = site.now(pit)
        left, rise = view(change, site, scan)
        assert rise == 0.0
    assert 0.3 < left.changed < 0.6
    kept = left.points[~left.above]
    assert np.mean(kept[:, 0] < 4.0) > 0.95
    assert left.dug == pytest.approx(2.5, abs=0.3)
    assert change.others.variance < 0.1**2


def test_height_goes_on_into_a_pit_of_which_nothing_else_is_seen(site):
    """The ground is a copy of the survey's two metres below: by itself it says that the robot has risen."""
    change = GroundChange(site.field)
    for _ in range(6):
        view(change, site, site.now())
    for _ in range(6):
        left, rise = view(change, site, site.now(lambda xy: np.full(len(xy), -2.0)))
        assert rise == 0.0
    assert left.changed > 0.9
    assert change.metres == pytest.approx(-2.0, abs=0.1)
    assert change.probability > 0.9
    _, rise = view(change, site, site.now())  # out again
    assert rise == 0.0


def test_height_goes_on_through_a_level_pit_where_nothing_else_shows_it():
    bare = Site(huts=0)
    change = GroundChange(bare.field)
    for _ in range(60):
        view(change, bare, bare.now())
    for _ in range(25):
        assert view(change, bare, bare.now(lambda xy: np.full(len(xy), -2.0)))[1] == 0.0
    assert change.probability > 0.9


@pytest.mark.parametrize("depth", [-2.0, 1.5])
def test_robot_that_starts_on_changed_ground_is_put_where_structure_has_it(site, depth):
    """Registered to the survey's ground at first, with a variance that covers it."""
    change, off, rises = GroundChange(site.field), -depth, []
    for k in range(10):
        _, rise = view(change, site, site.now(lambda xy: np.full(len(xy), depth)), off)
        if k == 0:
            assert change.others.variance**0.5 > 0.1 * abs(depth)
        rises.append(rise)
        off += rise
    assert abs(off) < 0.3
    assert sum(rise != 0.0 for rise in rises) <= 2


def test_without_structure_both_heights_stay_possible():
    bare = Site(huts=0)
    change = GroundChange(bare.field)
    for _ in range(5):
        _, rise = view(change, bare, bare.now(lambda xy: np.full(len(xy), -2.0)), 2.0)
        assert rise == 0.0
    assert change.others.variance**0.5 > 0.15
    change.clear()
    assert change.others == NO_OTHER
    assert change.probability == 0.0


def test_ground_that_comes_back_is_stood_on_again(site):
    """Odometry has drifted by 0.3 m in height, in a pit."""
    change, height = GroundChange(site.field), 0.0
    for k in range(14):
        drift = 0.3 * np.clip((k - 4) / 4.0, 0.0, 1.0)
        scan = site.now(lambda xy: np.full(len(xy), -2.0)) if 4 <= k < 8 else site.now()
        scan.points[:, 2] += drift
        T, position = pose_from(np.eye(3), [0.0, 0.0, height]), np.array([0.0, 0.0, 1.5 + drift])
        change.without_changed(scan, T, position, site.target)
        height += change.learn(T, position, site.target, 1.0, 0.004**2)
    assert height == pytest.approx(-0.3, abs=0.15)


def test_heights_of_the_field_are_those_of_the_ground(site):
    at = np.float32([[3.2, -4.1, 50.0], [-20.0, 11.0, -3.0], [500.0, 0.0, 0.0]])
    heights = kernels.ground_heights(site.field, at)
    np.testing.assert_allclose(heights[:2], site.level(at[:2, :2]), atol=0.15)
    assert np.isnan(heights[2])


def test_odometry_frame_that_leans_is_no_changed_ground(site):
    """A degree of lean raises the way by odometry by 0.7 m in 40 m; the height above the ground stays."""
    lean = pose_from(exp_so3(np.array([0.0, np.radians(1.0), 0.0])), np.zeros(3))
    change = GroundChange(site.field)
    scan = site.now()
    for x in np.arange(0.0, 40.0, 2.0):
        here = transform(lean, (HERE + np.array([x, 0.0, 0.0]))[None])[0]  # odometry has driven on
        back = pose_from(np.eye(3), [-x, 0.0, 0.0]) @ np.linalg.inv(lean)  # and the site repeats itself
        moved = replace(scan, points=transform(np.linalg.inv(back), scan.points).astype(np.float32))
        change.without_changed(moved, back, here, site.target)
        assert change.learn(back, here, site.target, 2.0, 2 * 0.004**2) == 0.0
    assert change.probability < 0.01
    assert change.others.reach < 0.5


def test_height_that_drifts_within_odometrys_sigma_is_no_changed_ground():
    """Every registration puts the ground on the survey's; nothing else shows a height."""
    bare, rng, sigma = Site(huts=0), np.random.default_rng(3), 0.015
    change, drift = GroundChange(bare.field), 0.0
    for _ in range(80):
        drift += sigma * rng.normal()
        scan = bare.now()
        scan.points[:, 2] += drift
        back, here = pose_from(np.eye(3), [0.0, 0.0, -drift]), HERE + np.array([0.0, 0.0, drift])
        change.without_changed(scan, back, here, bare.target)
        assert change.learn(back, here, bare.target, 1.0, sigma**2) == 0.0
        assert change.probability < 0.05
    assert change.others.reach < 0.5


def test_ground_offset_that_becomes_known_is_no_changed_ground():
    """The more the ground is lowered, the higher the robot is registered: odometry does not climb."""
    bare = Site(huts=0)
    change = GroundChange(bare.field)
    for offset in [*np.linspace(0.0, 0.5, 12), *np.full(40, 0.5)]:
        assert view(change, bare, bare.now().lowered(offset), offset)[1] == 0.0
    assert change.probability < 0.05
    assert change.others.reach < 0.5
