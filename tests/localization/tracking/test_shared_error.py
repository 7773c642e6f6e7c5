"""What pairs say of a registration's error by disagreeing place by place."""

from __future__ import annotations

import numpy as np
import pytest
from courtyard import courtyard, local_map, source_of

from coview_stream.config import RegistrationConfig
from coview_stream.geometry.transforms import boxminus, pose_from
from coview_stream.localization.registration.clouds import LocalMap
from coview_stream.localization.registration.register import register
from coview_stream.localization.tracking.shared_error import UNCLUSTERED, SharedErrorModel, clustered_covariance

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
    spread = clustered_covariance(source, fit.T_map_source, target, PIVOT, CONFIG)
    return boxminus(T_body, pose_from(np.eye(3), PIVOT)), spread, np.linalg.inv(fit.information)


def nees(errors, covariances):
    """Mean squared Mahalanobis distance per degree of freedom."""
    return np.mean([e @ np.linalg.solve(C, e) for e, C in zip(errors, covariances, strict=True)]) / 6


@pytest.mark.slow
def test_clustered_covariance_matches_true_error_unlike_inverse_hessian():
    errors, spreads, hessians = zip(*(registered(seed, 0.03) for seed in range(40)), strict=True)
    assert 0.5 < nees(errors, spreads) < 2.5
    assert nees(errors, hessians) > 10


def test_clustered_covariance_grows_with_map_error():
    sigma = [np.sqrt(np.diag(registered(1, off)[1])) for off in (0.01, 0.02, 0.04)]
    assert (sigma[1] > 1.3 * sigma[0]).all()
    assert (sigma[2] > 1.3 * sigma[1]).all()


def test_too_few_clusters_give_no_covariance():
    points, normals = courtyard()
    target = local_map(points, normals)
    few = np.abs(points[:, 0] - 3) + np.abs(points[:, 1] - 3) < 2
    source = source_of(points[few], np.eye(4))
    assert clustered_covariance(source, np.eye(4), target, PIVOT, CONFIG) is None


def test_shared_error_is_scaled_recent_covariance_plus_floor():
    config = RegistrationConfig(shared=2.0)
    rest = UNCLUSTERED**2
    shared = SharedErrorModel(config)
    np.testing.assert_allclose(shared.covariance, np.diag(rest))
    source, target = street(np.random.default_rng(0), 0.03)
    now = clustered_covariance(source, np.eye(4), target, PIVOT, config)
    shared.learn(source, np.eye(4), target, PIVOT)
    np.testing.assert_allclose(shared.covariance, 4 * now + np.diag(rest))
    better, same = street(np.random.default_rng(0), 0.0)
    for _ in range(20):
        shared.learn(better, np.eye(4), same, PIVOT)
    assert (np.diag(shared.covariance) - rest < 0.2 * 4 * np.diag(now)).all()
    before = shared.covariance
    shared.learn(source, pose_from(np.eye(3), [500.0, 0, 0]), target, PIVOT)  # nothing has a pair there
    np.testing.assert_array_equal(shared.covariance, before)
    shared.clear()
    np.testing.assert_allclose(shared.covariance, np.diag(rest))
