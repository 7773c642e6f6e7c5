import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coview_kernels import cast_rays, reference, triangle_tree


def soup(rng: np.random.Generator, count: int, lattice: bool) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles: anywhere, or on a lattice, where many are flat, or share edges and corners."""
    vertices = rng.uniform(-5, 5, (2 * count, 3))
    if lattice:
        vertices = vertices.round()
    return vertices.astype(np.float32), rng.integers(0, len(vertices), (count, 3)).astype(np.int32)


def brute(vertices, triangles, origin, towards):
    """The distance to the first triangle by solving o + t d = a + u (b - a) + v (c - a) for each; inf if none."""
    first = np.inf
    for a, b, c in vertices[triangles].astype(float):
        A = np.column_stack([b - a, c - a, -towards.astype(float)])
        if abs(np.linalg.det(A)) > 1e-12:
            u, v, t = np.linalg.solve(A, origin.astype(float) - a)
            if min(u, v, 1 - u - v) > -1e-9 and t >= 0:
                first = min(first, t)
    return first


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 3, 8, 13, 60]), st.booleans())
def test_kernel_twin_and_brute_force_agree(seed, count, lattice):
    rng = np.random.default_rng(seed)
    vertices, triangles = soup(rng, count, lattice)
    tree = triangle_tree(vertices, triangles)
    towards = rng.normal(size=(12, 3))
    towards[::3] = np.eye(3)[rng.integers(0, 3, 4)]  # along an axis
    towards = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    origins = rng.uniform(-6, 6, (12, 3)).astype(np.float32)  # off the lattice: an edge met exactly may go either way
    distance, row = cast_rays(tree, origins, towards)
    twin, twin_row = reference.cast_rays(tree, np.hstack([origins, towards]))
    expected = [brute(vertices, triangles, *ray) for ray in zip(origins, towards, strict=True)]
    np.testing.assert_allclose(twin, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(distance, twin, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(row < 0, np.isinf(distance))
    np.testing.assert_array_equal(twin_row < 0, np.isinf(twin))
    for k in np.flatnonzero(row >= 0):  # of two that lie in one another, either
        assert brute(vertices, triangles[row[k], None], origins[k], towards[k]) == pytest.approx(twin[k], abs=1e-5)


def test_no_ray_passes_between_two_triangles():
    """A closed box of 2 x 20 x 20 triangles a side: rays from inside through its corners and edges all meet it."""
    axis = np.linspace(-1.0, 1.0, 21)
    u, v = np.meshgrid(axis, axis, indexing="ij")
    flat = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    sides = [flat[:, order] * [sign] for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]) for sign in (1, -1)]
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).reshape(-1, 1)
    one = np.concatenate([corner + np.array(halves) for halves in ([0, 21, 22], [0, 22, 1])])
    tree = triangle_tree(np.concatenate(sides), np.concatenate([one + 441 * k for k in range(6)]))
    towards = np.concatenate(sides)
    towards = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    distance, _ = cast_rays(tree, np.zeros_like(towards), towards)
    np.testing.assert_allclose(np.abs(towards * distance[:, None]).max(axis=1), 1.0, atol=1e-5)


def test_no_rays_and_wrong_triangles():
    tree = triangle_tree(np.eye(3), [[0, 1, 2]])
    for answer in (cast_rays(tree, np.zeros((0, 3)), np.zeros((0, 3))), reference.cast_rays(tree, np.zeros((0, 6)))):
        assert [len(part) for part in answer] == [0, 0]
    for vertices, triangles in (
        (np.eye(3), np.zeros((0, 3))),
        (np.eye(3), [[0, 1, 3]]),
        (np.full((3, 3), np.nan), [[0, 1, 2]]),
    ):
        with pytest.raises(ValueError, match="triangle"):
            triangle_tree(vertices, triangles)
