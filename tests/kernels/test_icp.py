"""Registration kernel against its NumPy twin: same pose, evidence and end for many scenes, starts and priors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_cases import parallel_parts
from scipy.spatial.transform import Rotation

from coview_kernels import PointGrid, Prior, Scale, align_planes, reference
from coview_kernels.reference.icp import Plan

SCALES = (Scale(1.5, 0.5, 0.02, 1e-3), Scale(0.8, 0.26, keep=0.85), Scale(0.4, 0.13, keep=0.7))
FIXED = {"iterations": 15}


def pose(rotation_vector, translation):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T[:3, 3] = translation
    return T


def room(rng, noise):
    """Points (K, 3) and normals of a floor, two walls and a pillar, 0.3 m apart, somewhere on the map."""
    u, v = (a.ravel() for a in np.meshgrid(np.arange(0, 12, 0.3), np.arange(0, 4, 0.3)))
    zero = np.zeros_like(u)
    parts = [
        (np.stack([u, 3 * v, zero], 1), [0, 0, 1]),
        (np.stack([u, zero, v], 1), [0, 1, 0]),
        (np.stack([zero, u, v], 1), [1, 0, 0]),
        (np.stack([zero + 7, 5 + 0.2 * u, v], 1), [1, 0, 0]),
        (np.stack([7 + 0.2 * u, zero + 5, v], 1), [0, 1, 0]),
    ]
    points = np.concatenate([p for p, _ in parts]) + rng.uniform(-200, 200, 3)
    normals = np.concatenate([np.tile(np.array(n, np.float32), (len(p), 1)) for p, n in parts])
    return (points + noise * rng.normal(size=points.shape)).astype(np.float32), normals


def scan_of(points, rng, truth, outliers, noise):
    """A scan (N, 3) of some of the points from ``truth``, which of it is above the floor, and its middle."""
    some = rng.permutation(len(points))[:900]
    seen = points[some] + noise * rng.normal(size=(len(some), 3))
    stray = seen[: int(outliers * len(seen))]
    stray += rng.uniform(-2, 2, stray.shape)
    above = seen[:, 2] > points[:, 2].min() + 0.5
    back = np.linalg.inv(truth)
    local = (seen @ back[:3, :3].T + back[:3, 3]).astype(np.float32)
    return local, above, local.mean(axis=0, dtype=np.float64)


def both(grid, normals, local, above, T, pivot, prior=None, scales=SCALES, min_pairs=50, **changes):
    """Answers of the kernel and of its twin."""
    options = FIXED | changes
    ours = align_planes(grid, normals, local, above, T, pivot, scales, prior=prior, min_pairs=min_pairs, **options)
    belief = None if prior is None else (np.asarray(prior.T_map_source), np.asarray(prior.information))
    plan = Plan(T, pivot, scales, options["iterations"], min_pairs, belief)
    return ours, reference.align_planes(grid.tree, normals, local, above, plan)


def assert_same(ours, plain, pivot):
    """1e-6 m at the pivot and 1e-7 rad: sums are rounded in another order."""
    assert (ours is None) == (plain is None)
    if ours is None:
        return
    assert (ours.pairs, ours.iterations, ours.converged) == (plain.pairs, plain.iterations, plain.converged)
    middle = np.append(pivot, 1.0)
    np.testing.assert_allclose(ours.T_map_source @ middle, plain.T_map_source @ middle, rtol=0, atol=1e-6)
    np.testing.assert_allclose(ours.T_map_source[:3, :3], plain.T_map_source[:3, :3], rtol=0, atol=1e-7)
    scale = np.abs(plain.information).max()
    np.testing.assert_allclose(ours.information, plain.information, rtol=1e-6, atol=1e-7 * scale)
    assert ours.rmse == pytest.approx(plain.rmse, rel=1e-6, abs=1e-9)


@pytest.mark.slow
@settings(max_examples=25)
@given(
    st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3]), st.booleans(), st.sampled_from([1, 3]),
    st.sampled_from([(1, 1, 1), (4, 2, 1), (3, 3, 3)]), st.booleans(),
)  # fmt: skip
def test_kernel_agrees_with_numpy(seed, outliers, believed, threads, every, scattered):
    rng = np.random.default_rng(seed)
    points, normals = room(rng, 0.01)
    if scattered:  # planarity; registration may end a step of the lattice, 0.3 m, off
        normals *= rng.choice([1.0, 0.6, 0.1, 0.0], (len(points), 1)).astype(np.float32)
    truth = pose([0, 0, rng.uniform(-3, 3)], rng.uniform(-9, 9, 3))
    local, above, pivot = scan_of(points, rng, truth, outliers, 0.02)
    start = truth @ pose(rng.normal(0, 0.02, 3), np.zeros(3))
    start[:3, 3] += truth[:3, :3] @ pivot - start[:3, :3] @ pivot + rng.uniform(-0.4, 0.4, 3)
    local[::97] = np.nan
    prior = Prior(start, np.diag([1e4, 1e4, 1e3, 50.0, 40.0, 90.0])) if believed else None
    with parallel_parts(threads):
        scales = tuple(scale._replace(every=n) for scale, n in zip(SCALES, every, strict=True))
        ours, plain = both(PointGrid(points), normals, local, above, start, pivot, prior, scales)
    assert_same(ours, plain, pivot)
    assert np.linalg.norm((ours.T_map_source - truth) @ np.append(pivot, 1.0)) < (0.4 if scattered else 0.1)


def test_scatter_tells_of_all_directions_whatever_its_normals():
    """Crowns over a floor, whose normals all look up: with planarity 1 nothing would hold the scan in the plane."""
    rng = np.random.default_rng(5)
    crowns = rng.uniform([0, 0, 3], [14, 14, 8], (30, 3))
    blobs = (crowns[:, None] + rng.normal(0, 0.25, (30, 60, 3))).reshape(-1, 3)
    floor = np.column_stack([rng.uniform(0, 14, (2500, 2)), np.zeros(2500)])
    points = np.concatenate([blobs, floor]).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    seen = np.concatenate([(crowns[:, None] + rng.normal(0, 0.25, (30, 40, 3))).reshape(-1, 3), floor[::4]])
    local, above, pivot = seen.astype(np.float32), np.arange(len(seen)) < 1200, np.array([7.0, 7.0, 1.0])
    start = pose([0, 0, 0.03], [0.4, -0.3, 0.05])
    off = {}
    for planarity in (0.0, 1.0):
        normals = up.copy()
        normals[: len(blobs)] *= planarity
        ours, plain = both(PointGrid(points), normals, local, above, start, pivot)
        assert_same(ours, plain, pivot)
        off[planarity] = np.linalg.norm((ours.T_map_source @ np.append(pivot, 1.0))[:2] - pivot[:2])
    assert off[0.0] < 0.1 < 0.2 < off[1.0]


def test_pairs_of_equal_distance_are_kept_together():
    """Lattices seen exactly, a sixteenth of a metre off: all of a kind are equally far, and stay or go together."""
    u, v = (a.ravel() for a in np.meshgrid(np.arange(0, 8, 0.25), np.arange(0, 8, 0.25)))
    parts = np.stack([u, v, 0 * u], 1), np.stack([0 * u + 16, u, v + 1], 1)
    points = np.concatenate(parts).astype(np.float32)
    normals = np.repeat(np.float32([[0, 0, 1], [1, 0, 0]]), len(u), axis=0)
    local, above = points[::3], points[::3, 2] > 0.5
    for start in (np.eye(4), pose([0, 0, 0], [0.0625, 0, 0.0625])):
        ours, plain = both(
            PointGrid(points), normals, local, above, start, np.zeros(3), scales=SCALES[:1], iterations=1
        )
        assert_same(ours, plain, np.zeros(3))
        assert ours.pairs == len(local)
        np.testing.assert_allclose(ours.T_map_source, np.eye(4), atol=1e-6)


def test_converges_from_a_start_half_a_radian_off():
    """The increment's rotation is exact, not linear: half a radian in one step."""
    rng = np.random.default_rng(2)
    points, normals = room(rng, 0.01)
    middle = points.mean(axis=0, dtype=np.float64)
    local, above, pivot = scan_of(points, rng, pose([0, 0, 0], middle), 0.0, 0.0)
    start = pose([0.05, -0.1, 0.5], np.add(middle, [0.5, -0.4, 0.3]))
    ours, plain = both(PointGrid(points), normals, local, above, start, pivot, scales=(Scale(9.0, 3.0), *SCALES))
    assert_same(ours, plain, pivot)


def test_one_kind_of_point_or_few_pairs():
    rng = np.random.default_rng(3)
    points, normals = room(rng, 0.01)
    middle = points.mean(axis=0, dtype=np.float64)
    truth = pose([0, 0, 1.0], middle)
    local, above, pivot = scan_of(points, rng, truth, 0.1, 0.01)
    grid = PointGrid(points)
    for kind in (np.zeros_like(above), np.ones_like(above), np.arange(len(above)) == 7):
        assert_same(*both(grid, normals, local, kind, truth, pivot), pivot)
    far = truth + 0.0
    far[2, 3] += 50.0
    for start, min_pairs in ((far, 50), (truth, 650)):
        ours, plain = both(grid, normals, local, above, start, pivot, min_pairs=min_pairs)
        assert ours is None
        assert plain is None


def test_prior_decides_unobservable_directions():
    """A bare floor leaves heading and place free; the mean of a sure belief is where they end."""
    u, v = (a.ravel() for a in np.meshgrid(np.arange(0, 12, 0.3), np.arange(0, 12, 0.3)))
    floor = np.stack([u, v, 0 * u], 1).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (len(floor), 1))
    local = floor[::3]
    pivot = local.mean(axis=0, dtype=np.float64)
    mean = pose([0, 0, 0.05], [0.3, -0.2, 0.0])
    belief = Prior(mean, np.diag([1.0, 1.0, 1e6, 1e6, 1e6, 1.0]))
    ours, plain = both(PointGrid(floor), up, local, np.zeros(len(local), bool), np.eye(4), pivot, belief)
    assert_same(ours, plain, pivot)
    np.testing.assert_allclose(ours.T_map_source, mean, atol=2e-3)


def test_empty_map_or_source_returns_none():
    none = np.empty((0, 3))
    cloud, up = np.random.default_rng(4).normal(size=(99, 3)), np.tile([0.0, 0, 1], (99, 1))
    options = {"T": np.eye(4), "pivot": np.zeros(3), "scales": SCALES, **FIXED}
    assert align_planes(PointGrid(none), none, cloud, np.ones(99), **options) is None
    assert align_planes(PointGrid(cloud), up, none, np.ones(0), **options) is None


def test_errors_name_the_argument():
    cloud = np.zeros((2, 3))
    good = {
        "normals": cloud, "source": cloud, "kind": np.ones(2), "T": np.eye(4), "pivot": np.zeros(3),
        "scales": SCALES, **FIXED,
    }  # fmt: skip
    bad = {
        "normals": cloud[:1], "source": np.zeros(3), "kind": np.ones(3), "T": np.full((4, 4), np.nan),
        "pivot": [0, 0, np.inf], "scales": [Scale(0.0, 1.0)], "iterations": 0,
        "prior": Prior(np.eye(4), np.full((6, 6), np.inf)),
    }  # fmt: skip
    for name, value in bad.items():
        with pytest.raises(ValueError, match=name.rstrip("s")):
            align_planes(PointGrid(cloud), **(good | {name: value}))


def test_min_pairs_and_shares_of_scales_are_checked():
    cloud = np.random.default_rng(2).uniform(-5, 5, (300, 3)).astype(np.float32)
    arguments = PointGrid(cloud), np.tile(np.float32([0, 0, 1]), (300, 1)), cloud, np.zeros(300, bool)
    assert align_planes(*arguments, np.eye(4), np.zeros(3), SCALES, **FIXED, min_pairs=1) is not None
    with pytest.raises(ValueError, match="min_pairs must be at least 1"):
        align_planes(*arguments, np.eye(4), np.zeros(3), SCALES, **FIXED, min_pairs=0)
    apart, over = [Scale(1.0, 1.0, every=3), Scale(0.5, 1.0, every=2)], [Scale(1.0, 1.0, keep=1.1)]
    for scales, reason in ((apart, "multiple of the next"), (over, "keep must lie in")):
        with pytest.raises(ValueError, match=reason):
            align_planes(*arguments, np.eye(4), np.zeros(3), scales, **FIXED)
