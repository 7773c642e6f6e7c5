"""Registration: finds a known offset through outliers, states its covariance, lets a prior decide the rest."""

import weakref

import numpy as np
import pytest
from courtyard import courtyard, local_map, parts, plane, source_of
from se3 import exp_se3
from small_world import assert_pose, pose_error
from trackers import observed

from coview_kernels import Prior, Registration
from coview_stream.config import RegistrationConfig
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import boxminus, boxplus, pose_from, rot_z
from coview_stream.geometry.validation import check_covariance
from coview_stream.localization.registration import clouds
from coview_stream.localization.registration.clouds import LocalMap, LocalMaps, RegistrationCloud
from coview_stream.localization.registration.register import (
    SIGMA_FLOOR,
    WEAK_FROM,
    WEAK_LEVER,
    WEAK_SIGMA,
    gravity_information,
    propagate,
    register,
    registration_covariance,
    remove_prior,
)

CONFIG = RegistrationConfig()
TRUTH = pose_from(rot_z(0.7), [2.0, -1.0, 0.4])


@pytest.fixture(scope="module")
def target():
    return local_map(*courtyard())


@pytest.fixture(scope="module")
def scan(target):
    some = np.random.default_rng(1).permutation(len(target.points))[:3000]
    return source_of(target.points[np.sort(some)], TRUTH)


def with_outliers(scan, share):
    rng = np.random.default_rng(2)
    n = int(len(scan.points) * share / (1 - share))
    stray = rng.uniform([-12, -12, 0.6], [12, 12, 5], (n, 3)).astype(np.float32)
    return RegistrationCloud(
        np.concatenate([scan.points, stray]),
        np.concatenate([scan.above, np.ones(n, bool)]),
        np.concatenate([scan.height, stray[:, 2]]),
    )


@pytest.mark.parametrize(
    "offset",
    [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0.08, 1.0, -0.8, 0.2],
        [0.02, -0.02, -0.1, -1.2, 0.5, -0.3],
        [-0.03, 0.03, 0.05, 0.3, 1.3, 0.4],
    ],
)
def test_known_six_dof_offset_is_found(target, scan, offset):
    start = TRUTH @ exp_se3(np.array(offset, float))
    result = register(scan, start, target, CONFIG, CONFIG.search)
    assert_pose(result.T_map_source, TRUTH, 0.01, 0.05)
    assert result.converged
    assert result.rmse < 0.01
    assert result.pairs > 1000
    assert 0 < result.iterations <= CONFIG.iterations * len(CONFIG.search)


@pytest.mark.parametrize("centre", [None, np.zeros(3), np.array([8.0, -5.0, 1.0])], ids=["no pivot", "zero", "pivot"])
def test_registration_with_forty_percent_outliers(target, scan, centre):
    start = TRUTH @ exp_se3(np.array([0.01, 0.0, 0.06, 0.8, -0.7, 0.1]))
    crowd = with_outliers(scan, 0.4)
    result = register(crowd, start, target, CONFIG, CONFIG.search, centre=centre)
    assert_pose(result.T_map_source, TRUTH, 0.03, 0.15)


@pytest.mark.parametrize(
    ("x", "y", "degrees"), [(1.5, 0.0, 8.0), (1.06, -1.06, -8.0), (-2.5, 0.0, 8.0), (1.77, -1.77, -8.0)]
)
def test_start_metres_off_is_found_in_few_iterations(world_map, world_drive, x, y, degrees):
    """Were the coarse scales trimmed, the nearest pairs would hold each of these starts half a metre off or more."""
    truth = world_drive.T_map_body[4]
    scan, target = observed(world_drive.clouds[4], truth), LocalMaps(world_map, 50.0).around(truth[:3, 3])
    start = truth @ pose_from(rot_z(np.radians(degrees)), [x, y, 0.0]) @ np.linalg.inv(truth)
    found = register(scan.cloud, start, target, CONFIG, CONFIG.search, centre=truth[:3, 3], iterations=5)
    assert pose_error(found.T_map_source, np.eye(4))[0] < 0.02


def test_information_is_symmetric_and_reflects_observability(target, scan):
    corner = register(scan, TRUTH, target, CONFIG, (0.4,))
    np.testing.assert_allclose(corner.information, corner.information.T, rtol=1e-4, atol=1e-2)
    assert np.linalg.eigvalsh(corner.information).min() > 1
    flat = local_map(*parts(plane([-15, -15, 0], [30, 0, 0], [0, 30, 0])))
    floor = register(source_of(flat.points[::7], TRUTH), TRUTH, flat, CONFIG, (0.4,))
    # order (rx, ry, rz, x, y, z): a floor fixes tilt and height, not heading or place
    assert floor.information[[0, 1, 5], [0, 1, 5]].min() > 1e4 * floor.information[[2, 3, 4], [2, 3, 4]].max()


def test_empty_local_map_gives_no_registration(target, scan):
    assert register(scan, pose_from(np.eye(3), [500, 0, 0]), target, CONFIG, (1.0,)) is None
    thin = scan.every(3)
    assert thin.above.mean() == pytest.approx(scan.above.mean(), abs=0.01)
    few = RegistrationCloud(scan.points[:20], scan.above[:20], scan.height[:20])
    assert register(few, TRUTH, target, CONFIG, (1.0,)) is None


def test_weak_prior_does_not_outweigh_the_map(target, scan):
    wrong = TRUTH @ exp_se3(np.array([0, 0, 0.02, 0.3, 0.3, 0]))
    weak = Prior(wrong, np.diag(np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0]) ** -2))
    result = register(scan, wrong, target, CONFIG, CONFIG.search, weak)
    assert pose_error(result.T_map_source, TRUTH)[0] < 0.02


def test_local_maps_hold_all_points_within_radius_and_are_cached(world_map):
    maps, crops = LocalMaps(world_map, radius=6.0), {}
    for position in np.random.default_rng(3).uniform(-12, 12, (30, 3)):
        result = maps.around(position)
        wanted = np.hypot(*(world_map.points[:, :2] - position[:2]).T) < 6.0
        inside = np.hypot(*(result.points[:, :2] - position[:2]).T) < 6.0
        assert inside.sum() == wanted.sum()
        assert len(result.points) == len(result.normals)
        crops[id(result)] = result
    assert 1 < len(crops) <= 9


PLACES = np.array([[x, 0.0, 0.0] for x in (-16.0, 0.0, 16.0)])


def test_local_map_cache_drops_the_oldest_beyond_its_bytes(world_map):
    """And keeps one that is larger than the cache until the next."""
    sizes = [LocalMaps(world_map, radius=6.0).around(place).nbytes for place in PLACES]
    for max_bytes, kept in ((sum(sizes) - 1, [False, True, True]), (1, [False, False, True])):
        maps = LocalMaps(world_map, radius=6.0, max_bytes=max_bytes)
        refs = [weakref.ref(maps.around(place)) for place in PLACES]
        assert [ref() is not None for ref in refs] == kept
        assert maps.around(PLACES[-1]) is refs[-1]()


def test_local_maps_in_use_are_not_cut_again(world_map):
    maps = LocalMaps(world_map, radius=6.0, max_bytes=1)
    held = [maps.around(place) for place in PLACES]
    assert [maps.around(place) is crop for place, crop in zip(PLACES, held, strict=True)] == [True] * 3


def test_local_map_counts_all_bytes_it_keeps(world_map):
    crop = LocalMaps(world_map, radius=6.0).around(PLACES[1])
    bases = [array if array.base is None else array.base for array in (crop.points, crop.normals)]
    assert crop.nbytes == pytest.approx(sum({id(base): base.nbytes for base in bases}.values()), rel=0.1)


def test_local_map_without_points_is_none_and_is_cut_once(world_map, monkeypatch):
    maps, cuts, cut_points = LocalMaps(world_map, radius=6.0), [], clouds.cut_points
    monkeypatch.setattr(clouds, "cut_points", lambda *given: cuts.append(given) or cut_points(*given))
    assert [maps.around(np.array([x, 0.0, 0.0])) for x in (900.0, 901.0, 960.0, 900.0)] == [None] * 4
    assert len(cuts) == 2


@pytest.mark.slow
def test_propagated_heading_error_becomes_position_error():
    """Each of many poses drawn from a covariance drives 10 m ahead: their spread is the covariance carried along."""
    sigma = np.radians([0.1, 0.2, 1.0])
    C = np.diag([*sigma**2, 0.02**2, 0.03**2, 0.01**2])
    C[2, 3] = C[3, 2] = 0.5 * sigma[2] * 0.02
    step = pose_from(rot_z(0.3), [10.0, 2.0, 0.5])
    shift = (TRUTH @ step)[:3, 3] - TRUTH[:3, 3]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), C, 4000)
    ends = np.array([boxminus(boxplus(TRUTH, d) @ step, TRUTH @ step) for d in drawn])
    expected = propagate(C, shift)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.cov(ends.T) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.06)
    across = np.array([0.0, 0.0, 0.0, -shift[1], shift[0], 0.0]) / np.hypot(*shift[:2])
    sideways = np.hypot(*shift[:2]) * sigma[2]  # 0.18 m, and what the place was off by before
    assert np.sqrt(across @ expected @ across) == pytest.approx(sideways, rel=0.1)
    ahead = np.array([0.0, 0.0, 0.0, *shift[:2], 0.0]) / np.hypot(*shift[:2])
    assert np.sqrt(ahead @ expected @ ahead) < 0.2 * sideways


def test_gravity_informs_of_roll_and_pitch_alone():
    np.testing.assert_allclose(gravity_information(0.01), np.diag([1e4, 1e4, 0.0, 0.0, 0.0, 0.0]))


def information_of(sigma):
    """What a registration would report that is sure to ``sigma`` (6,) after inflation."""
    return np.diag((np.asarray(sigma) / CONFIG.inflation) ** -2.0)


def widened(sigma):
    """What becomes of a sigma (metres) that the map shows badly."""
    return sigma * np.hypot(1.0, sigma / WEAK_FROM)


def test_well_observed_directions_are_inflated_and_floored():
    sigma = np.array([2e-4, 2e-4, 2e-4, 0.002, 0.002, 0.002])
    result = registration_covariance(information_of(sigma), CONFIG)
    np.testing.assert_allclose(result, np.diag(sigma**2 + SIGMA_FLOOR**2), rtol=5e-3)


def test_weak_direction_is_widened_alone():
    """Along a tunnel that runs diagonally: the Hessian claims 0.3 m there, which noise in the normals can feign."""
    along = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]) / np.sqrt(2)
    strong = information_of([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01])
    weak = (CONFIG.inflation / 0.3) ** 2
    tunnel = strong + (weak - along @ strong @ along) * np.outer(along, along)
    result = registration_covariance(tunnel, CONFIG)
    assert np.sqrt(along @ result @ along) == pytest.approx(widened(0.3), rel=0.02)
    across = np.array([0.0, 0.0, 0.0, 1.0, -1.0, 0.0]) / np.sqrt(2)
    assert np.sqrt(across @ result @ across) < 0.025
    assert np.sqrt(result[2, 2]) < 1.5e-3


def test_angle_is_weak_by_displacement_at_the_lever_arm():
    """A degree moves 0.17 m at 10 m, which is weak; a twentieth of that hardly matters."""
    sigma = np.full(6, 0.001)
    sigma[2], sigma[0] = np.radians(1.0), np.radians(0.05)
    result = np.sqrt(np.diag(registration_covariance(information_of(sigma), CONFIG)))
    lever = WEAK_LEVER
    assert result[2] == pytest.approx(widened(sigma[2] * lever) / lever, rel=0.01)
    assert result[2] > 1.5 * sigma[2]
    assert result[0] == pytest.approx(np.hypot(sigma[0], SIGMA_FLOOR[0]), rel=0.05)


@pytest.mark.parametrize("weakest", [0.0, -1e-3, 1e-9])
def test_zero_information_gives_the_max_sigma(weakest):
    """Also where a subtraction has left a little less than nothing."""
    information = information_of([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01])
    information[4, 4] = weakest
    result = registration_covariance(information, CONFIG)
    check_covariance(result, "found")
    assert np.sqrt(result[4, 4]) == pytest.approx(WEAK_SIGMA, rel=1e-3)


def test_sigma_grows_continuously_as_information_falls():
    sigmas = np.geomspace(0.01, 30.0, 60)
    result = [
        np.sqrt(registration_covariance(information_of([1e-3] * 3 + [s, 0.01, 0.01]), CONFIG)[3, 3]) for s in sigmas
    ]
    steps = np.diff(np.log(result))
    assert (steps >= -1e-9).all()
    assert steps.max() < 0.3  # twice the step of the sigmas at most
    assert (np.array(result) >= np.minimum(sigmas, WEAK_SIGMA) * 0.999).all()


@pytest.mark.parametrize("bad", [np.eye(5), np.full((6, 6), np.nan)])
def test_invalid_information_matrix_is_refused(bad):
    with pytest.raises(InputError, match="information"):
        registration_covariance(bad, CONFIG)


def test_remove_prior_is_undone_by_fusing_the_prior():
    """The subtraction is exact where nothing is weak."""
    rng = np.random.default_rng(3)
    A, B = (m @ m.T + 50 * np.eye(6) for m in rng.standard_normal((2, 6, 6)) * 10)
    a = CONFIG.inflation**2
    mean, gap = TRUTH, np.array([0.0, 0.0, 1e-5, 0.03, -0.02, 0.05])
    measured = boxplus(mean, gap)
    total = A + a * B
    T = boxplus(mean, np.linalg.solve(total, A @ gap))
    T_found, information = remove_prior(Registration(T, total, 0.0, 0, 1, True), Prior(mean, B), CONFIG)
    np.testing.assert_allclose(information, A, rtol=1e-6, atol=1e-6 * np.abs(A).max())
    share = np.linalg.eigvals(np.linalg.solve(total, A)).real.min()
    slack = (0.01 / share) ** 2 * np.linalg.norm(gap) * np.linalg.cond(total)
    assert np.abs(boxminus(T_found, measured)).max() < slack


def test_unobserved_directions_stay_unobserved_after_remove_prior():
    """A bare floor: heading and place come from the prior alone, and must not come back as measured."""
    side = np.arange(-15, 15, 0.25)
    floor = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.column_stack([floor, np.zeros(len(floor))]).astype(np.float32)
    target = LocalMap(points, np.tile(np.float32([0, 0, 1]), (len(points), 1)))
    noisy_scan = RegistrationCloud(points[::7], np.zeros(len(points[::7]), bool), points[::7, 2])
    mean = boxplus(np.eye(4), np.array([0.0, 0.0, 0.01, 0.1, -0.1, 0.03]))
    prior = Prior(mean, np.diag(np.array([0.01, 0.01, 0.02, 0.2, 0.3, 0.1]) ** -2))
    fused = register(noisy_scan, mean, target, CONFIG, (0.4,), prior, np.zeros(3))
    T_found, information = remove_prior(fused, prior, CONFIG)
    sigma = np.sqrt(np.diag(registration_covariance(information, CONFIG)))
    assert (sigma[[0, 1, 5]] < 2 * SIGMA_FLOOR[[0, 1, 5]]).all()
    assert (sigma[3:5] > 9.0).all()
    assert sigma[2] > 0.9 * WEAK_SIGMA / WEAK_LEVER
    gap = boxminus(T_found, mean)
    assert abs(gap[5] + 0.03) < 0.005  # the floor is where it is
    assert np.abs(gap[2:5]).max() < 0.01  # the rest stays with the prior
