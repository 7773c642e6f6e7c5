"""The ground offset follows what structure shows of the height, and is nothing where structure shows none."""

import numpy as np
import pytest
from huts import GROUND, with_huts

from coview_stream.localization.calibration.ground_offset import GroundOffset
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud


def site(rng, canopies=True, count=24):
    """Flat ground with huts, perhaps with flat tops."""
    huts = [(x, y, 0.0, 4.0) for x, y in rng.uniform(-27, 27, (count, 2))]
    return with_huts(np.zeros(len(GROUND)), huts, canopies)


def learned(lift, canopies=True, times=30, offset=None):
    """Learn from a robot whose ground lies ``lift`` metres above the survey's, registered half way between the two."""
    rng = np.random.default_rng(5)
    points, normals, above = site(rng, canopies)
    noisy = points + rng.normal(0.0, 0.02, points.shape).astype(np.float32)
    noisy[~above, 2] += np.float32(lift)
    cloud = RegistrationCloud(noisy, above, points[:, 2].copy())
    T, offset, target = np.eye(4), offset or GroundOffset(), LocalMap(points, normals)
    T[2, 3] = -0.5 * lift
    for _ in range(times):
        offset.learn(offset.lower(cloud), T, target)
    return offset


def test_structure_tells_by_how_much_the_ground_has_risen():
    offset = learned(0.3)
    assert offset.metres == pytest.approx(0.3, abs=0.07)
    assert offset.probability > 0.7
    assert offset.sigma < 0.15


@pytest.mark.parametrize(
    ("lift", "canopies", "most"),
    [(-0.2, True, 1e-9), (-0.3, True, 1e-9), (0.0, True, 0.01), (0.3, False, 0.1)],
    ids=["below: may be growth", "far below", "as surveyed", "walls show no height"],
)
def test_no_offset_is_corrected_without_evidence_of_risen_ground(lift, canopies, most):
    """The robot's height follows the ground then."""
    offset = learned(lift, canopies)
    assert abs(offset.metres) <= most
    assert offset.probability < 0.5


def test_structure_that_stands_as_it_did_speaks_against_growth():
    """Where half of the patches have grown, the others tell that the ground lies where it did."""
    points, normals, above = site(np.random.default_rng(5))
    cloud = RegistrationCloud(points.copy(), above, points[:, 2].copy())
    cloud.points[above & (points[:, 0] > 0.0), 2] += np.float32(0.3)
    offset = GroundOffset()
    for _ in range(30):
        offset.learn(offset.lower(cloud), np.eye(4), LocalMap(points, normals))
    assert offset.metres == pytest.approx(0.0, abs=0.03)


@pytest.mark.slow
def test_offset_is_corrected_once_it_is_probable_and_its_end_is_followed_smoothly():
    """Grass that ends is no step in height."""
    offset = GroundOffset()
    rising = [learned(0.3, times=1, offset=offset).metres for _ in range(20)]
    assert rising[-1] == pytest.approx(0.3, abs=0.07)
    assert (np.diff(rising) >= 0.0).all()
    falling = [learned(0.0, times=1, offset=offset).metres for _ in range(40)]
    assert falling[-1] == pytest.approx(0.0, abs=0.02)
    assert np.abs(np.diff([rising[-1], *falling])).max() < 0.3 * rising[-1]


def test_offset_that_was_known_before_holds_until_another_is_told():
    offset = GroundOffset()
    offset.restore(0.3)
    assert offset.metres == pytest.approx(0.27, abs=0.03)
    assert 0.5 < offset.probability < 0.8
    assert learned(0.3, canopies=False, times=1, offset=offset).metres == pytest.approx(0.27, abs=0.06)
    offset.clear()  # another place of the same site
    assert offset.metres == pytest.approx(0.27, abs=0.03)
    assert learned(0.0, offset=offset).metres == pytest.approx(0.0, abs=0.08)  # it may be there, under growth


@pytest.mark.parametrize("metres", [0.0, 0.03, -0.02])
def test_next_to_nothing_restores_nothing(metres):
    offset = GroundOffset()
    offset.restore(0.3)  # another site
    offset.restore(metres)
    assert offset.metres == pytest.approx(0.0, abs=1e-9)
    assert offset.probability == pytest.approx(0.02, abs=0.01)


def test_too_few_points_tell_nothing_and_clear_forgets():
    points = np.zeros((3, 3), dtype=np.float32)
    offset = learned(0.3)
    offset.clear()
    offset.learn(RegistrationCloud(points, np.ones(3, bool), np.full(3, 2.0, np.float32)), np.eye(4), None)
    assert offset.metres == pytest.approx(0.0, abs=1e-9)
    assert offset.probability == pytest.approx(0.02, abs=0.01)


def test_the_ground_alone_is_lowered():
    points = np.float32([[0, 0, 0], [1, 0, 3]])
    cloud = RegistrationCloud(points, np.array([False, True]), np.float32([0, 3]))
    lowered = cloud.lowered(0.25).lowered(0.05)
    np.testing.assert_allclose(lowered.points[:, 2], [-0.3, 3.0], atol=1e-6)
    assert lowered.ground_offset == pytest.approx(0.3)
    assert lowered.every(1).ground_offset == pytest.approx(0.3)
    assert cloud.points[0, 2] == 0.0
