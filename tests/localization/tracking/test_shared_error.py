"""What pairs say of a registration's error by disagreeing sector by sector."""

import numpy as np
import pytest
from courtyard import courtyard, source_of

from coview_stream.config import RegistrationConfig
from coview_stream.geometry.transforms import boxminus, pose_from
from coview_stream.localization.registration.clouds import LocalMap
from coview_stream.localization.registration.register import register
from coview_stream.localization.tracking.shared_error import FLOOR, SharedErrorModel, clustered_covariance, disagreement

CONFIG = RegistrationConfig()
PIVOT = np.array([0.0, 0.0, 1.5])


def street(rng, off):
    """Fronts of 25 houses and the ground before them; the map has each of them ``off`` (sigma, metres) elsewhere."""
    seen, mapped, normals = [], [], []
    for x in np.arange(-32.0, 33.0, 16.0):
        for y in np.arange(-32.0, 33.0, 16.0):
            axis = int(rng.integers(2))
            front = np.zeros((160, 3))
            front[:, 1 - axis] = rng.uniform(-3, 3, 160)
            front[:, 2] = rng.uniform(1.5, 6, 160)
            ground = np.column_stack([rng.uniform(-6, 6, (160, 2)), np.zeros(160)])
            n = np.eye(3)[axis]
            place = np.array([x + 8.0, y + 8.0, 0.0])
            seen += [front + place, ground + place]
            mapped += [front + place + n * rng.normal(0.0, off), ground + place + [0, 0, rng.normal(0.0, off)]]
            normals += [np.tile(n, (160, 1)), np.tile([0.0, 0.0, 1.0], (160, 1))]
    seen, mapped, normals = (np.concatenate(part).astype(np.float32) for part in (seen, mapped, normals))
    noise = rng.normal(0.0, 0.01, seen.shape).astype(np.float32)
    return source_of(seen + noise, np.eye(4)), LocalMap(mapped, normals)


def registered(seed, off):
    """Error (6,) of a registration, its clustered covariance, and the inverse Hessian's."""
    source, target = street(np.random.default_rng(seed), off)
    fit = register(source, np.eye(4), target, CONFIG, CONFIG.track, centre=PIVOT)
    T_body = fit.T_map_source @ pose_from(np.eye(3), PIVOT)
    spread = clustered_covariance(*disagreement(source, fit.T_map_source, target, PIVOT, CONFIG))
    return boxminus(T_body, pose_from(np.eye(3), PIVOT)), spread, np.linalg.inv(fit.information)


def nees(errors, covariances):
    """Mean squared Mahalanobis distance per degree of freedom."""
    return np.mean([e @ np.linalg.solve(C, e) for e, C in zip(errors, covariances, strict=True)]) / 6


@pytest.mark.slow
def test_clustered_covariance_matches_true_error_unlike_inverse_hessian():
    errors, spreads, hessians = zip(*(registered(seed, 0.03) for seed in range(40)), strict=True)
    assert 0.3 < nees(errors, spreads) < 1.5
    assert nees(errors, hessians) > 10


def test_clustered_covariance_grows_with_map_error():
    sigma = [np.sqrt(np.diag(registered(1, off)[1])) for off in (0.01, 0.02, 0.04)]
    assert (sigma[1] > 1.3 * sigma[0]).all()
    assert (sigma[2] > 1.3 * sigma[1]).all()


def layers(apart):
    """A courtyard, each surface mapped twice: by two passes ``apart`` metres to either side of where it is."""
    points, normals = courtyard()
    shift = np.where(np.arange(len(points)) % 2, apart, -apart)[:, None] * normals
    return source_of(points, np.eye(4)), LocalMap((points + shift).astype(np.float32), normals.astype(np.float32))


def test_curvature_is_less_where_surfaces_are_mapped_twice():
    """A wall between two layers pulls to neither: partners held, both maps would look equally certain."""
    thin, thick = (disagreement(*pair[:1], np.eye(4), pair[1], PIVOT, CONFIG)[1] for pair in map(layers, (0.0, 0.1)))
    assert (np.diag(thick) < np.diag(thin)).all()
    assert np.mean(np.diag(thick) / np.diag(thin)) < 0.75


def test_too_few_pairs_teach_nothing():
    source, target = street(np.random.default_rng(0), 0.03)
    assert disagreement(source, pose_from(np.eye(3), [500.0, 0, 0]), target, PIVOT, CONFIG) is None


def test_shared_error_is_scaled_covariance_of_the_last_metres_plus_floor():
    config = RegistrationConfig(shared=2.0)
    shared, floor = SharedErrorModel(config), np.diag(FLOOR**2)
    np.testing.assert_allclose(shared.covariance, floor)
    source, target = street(np.random.default_rng(0), 0.03)
    shared.learn(source, np.eye(4), target, PIVOT, 0.0)
    first = 4 * clustered_covariance(*disagreement(source, np.eye(4), target, PIVOT, config))
    np.testing.assert_allclose(shared.covariance, first + floor)
    better, same = street(np.random.default_rng(0), 0.0)
    shared.learn(better, np.eye(4), same, PIVOT, 1.9)  # too near to see anything new
    np.testing.assert_allclose(shared.covariance, first + floor)
    for metres in range(2, 42, 2):
        shared.learn(better, np.eye(4), same, PIVOT, metres)
    later = shared.covariance
    assert (np.diag(later) - FLOOR**2 < 0.2 * np.diag(first)).all()
    shared.learn(source, pose_from(np.eye(3), [500.0, 0, 0]), target, PIVOT, 50.0)  # nothing has a pair there
    np.testing.assert_array_equal(shared.covariance, later)
    shared.clear()
    np.testing.assert_allclose(shared.covariance, floor)


def test_own_error_is_what_the_next_registration_does_not_repeat():
    alike, others = SharedErrorModel(CONFIG), SharedErrorModel(CONFIG)
    assert alike.unknown
    assert not alike.own.any()
    for k in range(30):
        for model, seed in ((alike, 0), (others, k)):
            source, target = street(np.random.default_rng(seed), 0.03)
            model.learn(source, np.eye(4), target, PIVOT, 2.0 * k)
        if k == 0:  # nothing tells yet
            np.testing.assert_allclose(others.own, (others.covariance - np.diag(FLOOR**2)) / CONFIG.shared**2)
    assert not alike.unknown
    assert (np.diag(alike.own) < 0.1 * np.diag(alike.covariance)).all()
    assert (np.diag(others.own) > np.diag(others.covariance)).all()
    assert np.linalg.eigvalsh(others.own).min() > 0.0
