"""GICP: what is ours with a stand-in for small_gicp, and all of it with the library where it is installed."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec

import fake_small_gicp
import numpy as np
import pytest
from courtyard import courtyard, local_map, parts, plane, source_of
from se3 import exp_se3
from small_world import pose_error
from trackers import follow

from coview_kernels import Prior
from coview_stream.config import LocalizerConfig, RegistrationConfig
from coview_stream.errors import ConfigError, DependencyError
from coview_stream.geometry.transforms import boxminus, boxplus, exp_so3, pose_from, rot_z, transform
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration import gicp
from coview_stream.localization.registration.clouds import LocalMap, LocalMaps, RegistrationCloud
from coview_stream.localization.registration.register import register, registration_covariance, remove_prior
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.state import State
from coview_stream.stream.node.engines import open_engine

TRIMMED = RegistrationConfig()
CONFIG = RegistrationConfig(method="gicp")
DISTRUSTING = RegistrationConfig(method="gicp", inflation=8.0)
"""Pairs count for little, so that a prior comes through."""
TRUTH = pose_from(rot_z(0.7), [2.0, -1.0, 0.4])
TILTED = pose_from(exp_so3([0.2, -0.3, 0.7]), [2.0, -1.0, 0.4])
PIVOT = np.array([3.0, -2.0, 1.0])


@pytest.fixture(params=["stand-in", "small_gicp"])
def library(request, monkeypatch):
    """Whose residuals are used."""
    if request.param == "stand-in":
        monkeypatch.setitem(sys.modules, "small_gicp", fake_small_gicp)
    elif find_spec("small_gicp") is None:
        pytest.skip("small_gicp is not installed: pip install 'small-gicp>=1.0.1'")
    return request.param


@pytest.fixture
def target(library):
    return local_map(*courtyard())


def scan_of(target, T=TRUTH, count=3000, noise=0.02):
    some = np.sort(np.random.default_rng(1).permutation(len(target.points))[:count])
    exact = source_of(target.points[some], T)
    error = np.random.default_rng(2).normal(0, noise, exact.points.shape).astype(np.float32)
    return RegistrationCloud(exact.points + error, exact.above, exact.height)


# ---- our arithmetic


def pairs(seed=3, count=40):
    rng = np.random.default_rng(seed)
    return rng.uniform(-5, 5, (count, 3)), rng.uniform(-5, 5, (count, 3)), rng.standard_normal((count, 3))


def test_hessian_and_gradient_match_numerical_derivatives():
    """Against numerical derivatives of the cost, by steps as everyone else here takes them."""
    p, q, n = pairs()

    def residuals(T):
        return np.einsum("ij,ij->i", transform(T, p) - q, n)

    def slope(move):
        h = 1e-6
        return np.column_stack([(residuals(move(h * e)) - residuals(move(-h * e))) / (2 * h) for e in np.eye(6)])

    r = residuals(TILTED)
    theirs = slope(lambda d: TILTED @ exp_se3(d))
    ours = slope(lambda d: gicp.retract(TILTED, d, PIVOT))
    H, b = gicp.about_pivot(theirs.T @ theirs, theirs.T @ r, TILTED, PIVOT)
    np.testing.assert_allclose(H, ours.T @ ours, rtol=1e-6, atol=1e-5 * np.abs(H).max())
    np.testing.assert_allclose(b, ours.T @ r, rtol=1e-6, atol=1e-6 * np.abs(b).max())


def test_point_to_point_system_matches_its_residuals():
    p, q, _ = pairs()

    def gaps(T):
        return (transform(T, p) - q).ravel()

    h = 1e-6
    moves = [(gicp.retract(TILTED, h * e, PIVOT), gicp.retract(TILTED, -h * e, PIVOT)) for e in np.eye(6)]
    slope = np.column_stack([(gaps(a) - gaps(b)) / (2 * h) for a, b in moves])
    there = transform(TILTED, p)
    H, b = gicp.point_to_point_system(there, there - q, transform(TILTED, PIVOT[None])[0])
    np.testing.assert_allclose(H, slope.T @ slope, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(b, slope.T @ gaps(TILTED), rtol=1e-6, atol=1e-5)


def test_pairs_and_prior_fuse_as_two_gaussians():
    """From either mean the step leads to the one product of both."""
    rng = np.random.default_rng(4)
    A, B = (m @ m.T + 50 * np.eye(6) for m in 10 * rng.standard_normal((2, 6, 6)))
    gap = np.array([1e-6, -2e-6, 3e-6, 0.003, -0.002, 0.005])  # small: turns add up to first order only
    measured = gicp.retract(TILTED, gap, PIVOT)
    prior = Prior(TILTED, B)
    wanted = np.linalg.solve(A + B, A @ gap)
    for begin, gradient in ((TILTED, -A @ gap), (measured, np.zeros(6))):
        step, information = gicp.fused_step(A, gradient, begin, PIVOT, prior)
        np.testing.assert_array_equal(information, A + B)
        fit = gicp.retract(begin, step, PIVOT)
        away = transform(fit, PIVOT[None])[0] - transform(TILTED, PIVOT[None])[0]
        np.testing.assert_allclose(away, wanted[3:], atol=1e-7)
        np.testing.assert_allclose(boxminus(fit, TILTED)[:3], wanted[:3], atol=1e-7)


# ---- registrations


@pytest.mark.slow
@pytest.mark.parametrize("centre", [None, np.zeros(3), np.array([8.0, -5.0, 1.0])])
def test_gicp_and_trimmed_icp_agree_from_one_metre_and_five_degrees(target, centre):
    scan = scan_of(target)
    start = TRUTH @ exp_se3(np.array([0.01, -0.01, np.radians(5.0), 0.8, -0.6, 0.1]))
    fit, other = (register(scan, start, target, c, c.search, centre=centre, iterations=30) for c in (CONFIG, TRIMMED))
    assert pose_error(fit.T_map_source, TRUTH)[0] < 0.01
    metres, degrees = pose_error(fit.T_map_source, other.T_map_source)
    assert metres < 0.02
    assert degrees < 0.1
    assert fit.converged
    assert fit.pairs > 1000
    assert 0.005 < fit.rmse < 0.04
    np.testing.assert_allclose(fit.information, fit.information.T)
    assert np.linalg.eigvalsh(fit.information).min() > 1


def test_points_without_map_counterpart_are_trimmed_and_non_finite_ones_dropped(target):
    """A quarter of the scan stands in the air, half of that within reach of the walls; seven points are nowhere."""
    scan, rng = scan_of(target), np.random.default_rng(5)
    air = rng.uniform([-12, -12, 0.6], [12, 12, 5], (500, 3)).astype(np.float32)
    near = scan.points[scan.above][:500] + np.float32([0.25, 0.25, 0.0])
    stray = np.concatenate([air, near, np.full((7, 3), np.nan, np.float32)])
    crowd = RegistrationCloud(
        np.concatenate([scan.points, stray]),
        np.concatenate([scan.above, np.ones(len(stray), bool)]),
        np.concatenate([scan.height, np.full(len(stray), 2.0, np.float32)]),
    )
    start = TRUTH @ exp_se3(np.array([0.0, 0.0, 0.03, 0.3, -0.2, 0.1]))
    fit = register(crowd, start, target, CONFIG, CONFIG.search, centre=np.zeros(3))
    assert pose_error(fit.T_map_source, TRUTH)[0] < 0.03
    with pytest.raises(ValueError, match="finite"):
        register(scan, np.full((4, 4), np.nan), target, CONFIG, CONFIG.track)


@pytest.mark.parametrize("count", [0, 1, 19, 45])
def test_too_few_points_are_refused(target, count):
    scan = scan_of(target)
    few = RegistrationCloud(scan.points[:count], scan.above[:count], scan.height[:count])
    assert register(few, TRUTH, target, CONFIG, CONFIG.track, centre=np.zeros(3)) is None
    assert register(scan, pose_from(np.eye(3), [500, 0, 0]), target, CONFIG, CONFIG.track) is None
    tiny = LocalMap(target.points[:count], target.normals[:count])
    assert register(scan, TRUTH, tiny, CONFIG, CONFIG.track) is None


# ---- the prior


@pytest.fixture
def corridor(library):
    return local_map(
        *parts(
            plane([-30, -2, 0], [60, 0, 0], [0, 4, 0]),
            plane([-30, -2, 0], [60, 0, 0], [0, 0, 3]),
            plane([-30, 2, 0], [60, 0, 0], [0, 0, 3]),
        )
    )


def along(corridor, config, scales, off, start):
    """Registration of the middle of a corridor with ends out of sight, without noise; its prior is ``off``."""
    middle = source_of(corridor.points[np.abs(corridor.points[:, 0]) < 20][::5], np.eye(4))
    prior = Prior(boxplus(np.eye(4), off), np.diag(np.array([0.02, 0.02, 0.02, 0.1, 0.3, 0.3]) ** -2))
    return register(middle, boxplus(np.eye(4), start), corridor, config, scales, prior, np.zeros(3)), prior


def test_along_a_corridor_the_prior_decides(corridor):
    """It is off to the side, too, and there the walls do."""
    off, start = np.array([0.0, 0.0, 0.01, 0.5, 0.1, 0.05]), np.array([0.0, 0.0, 0.01, 0.2, 0.1, 0.05])
    gap = boxminus(along(corridor, DISTRUSTING, DISTRUSTING.track, off, start)[0].T_map_source, np.eye(4))
    assert gap[3] == pytest.approx(0.5, abs=0.03)
    assert np.abs(gap[[0, 1, 2, 4, 5]]).max() < 0.01


def test_corridor_direction_has_no_information(corridor):
    fused, prior = along(corridor, CONFIG, (0.4,), np.zeros(6), np.zeros(6))
    _, information = remove_prior(fused, prior, CONFIG)
    sigma = np.sqrt(np.diag(registration_covariance(information, CONFIG)))
    assert sigma[3] > 10 * sigma[4]
    assert sigma[4] < 0.02


def test_remove_prior_equals_gicp_without_prior(target):
    """The prior is off by centimetres and knows as much as the pairs."""
    scan = scan_of(target, TILTED, noise=0.01)
    mean = boxplus(TILTED, np.array([0.001, -0.001, 0.002, 0.03, -0.02, 0.015]))
    prior = Prior(mean, np.diag(np.array([0.002, 0.002, 0.002, 0.01, 0.01, 0.01]) ** -2))
    origin = np.zeros(3)
    alone = register(scan, mean, target, DISTRUSTING, DISTRUSTING.track, centre=origin, iterations=40)
    fused = register(scan, mean, target, DISTRUSTING, DISTRUSTING.track, prior, origin, iterations=40)
    T_found, information = remove_prior(fused, prior, DISTRUSTING)
    pulled = np.linalg.norm(boxminus(fused.T_map_source, alone.T_map_source)[3:])
    left = np.linalg.norm(boxminus(T_found, alone.T_map_source)[3:])
    assert pulled > 0.003
    assert left < 0.3 * pulled
    np.testing.assert_allclose(np.diag(information) / np.diag(alone.information), 1.0, atol=0.1)


# ---- where it is asked for


def test_unknown_registration_method_is_refused():
    with pytest.raises(ConfigError, match="trimmed-icp, gicp"):
        RegistrationConfig(method="icp")


def test_missing_small_gicp_is_named(monkeypatch, world_file):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    target = local_map(*courtyard())
    with pytest.raises(DependencyError, match=r"small-gicp .*pip install 'coview-stream\[gicp\]'"):
        register(scan_of(target), TRUTH, target, CONFIG, CONFIG.track)
    with pytest.raises(DependencyError, match="pip install"):
        open_engine("track", world_file, "0" * 64, LocalizerConfig(registration=CONFIG))


def test_global_search_uses_trimmed_icp(world_map):
    config = LocalizerConfig(registration=replace(CONFIG, keep=0.8))
    search = GlobalSearch(world_map, config, LocalMaps(world_map, 50.0))
    assert search.config.registration == replace(TRIMMED, keep=0.8)
    assert replace(search.config, registration=config.registration) == config


def test_drive_is_tracked_with_gicp(world_map, world_drive):
    pytest.importorskip("small_gicp", reason="small_gicp is not installed: pip install 'small-gicp>=1.0.1'")
    maps = LocalMaps(world_map, CONFIG.source_range)
    fixes = follow(Localizer(world_map, LocalizerConfig(registration=CONFIG), maps), world_drive)
    tracking = [k for k, fix in enumerate(fixes) if fix.state is State.TRACKING]
    assert len(tracking) >= 4
    for k in tracking:
        metres, degrees = pose_error(fixes[k].T_map_body, world_drive.T_map_body[k])
        assert metres < 0.08
        assert degrees < 0.4
        assert "surfaces" in vars(maps.around(world_drive.T_map_body[k][:3, 3]))
