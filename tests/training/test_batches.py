"""Batches: the poses say where the queries stand after every rotation and reflection."""

import numpy as np
import pytest

from coview_stream.descriptors.birds_eye_view import CELL, LAYERS, Image
from coview_stream.training.batches import PIECE, augmented, draw_batch
from coview_stream.training.worlds import QUERY_CELLS, WorldViews

SIDE = 400


def world(seed: int) -> WorldViews:
    """Dots at random; queries are exact looks at them."""
    rng = np.random.default_rng(seed)
    aerial = np.zeros((LAYERS, SIDE, SIDE), dtype=np.uint8)
    aerial[0] = 255 * (rng.random((SIDE, SIDE)) < 0.03)
    corner = np.array([-100.0, -100.0])
    at = (np.arange(QUERY_CELLS) + 0.5 - QUERY_CELLS / 2) * CELL
    x, y = np.meshgrid(at, at)
    queries, poses = [], []
    for _ in range(12):
        px, py, yaw = rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-np.pi, np.pi)
        column = np.floor((np.cos(yaw) * x - np.sin(yaw) * y + px - corner[0]) / CELL).astype(int)
        row = np.floor((np.sin(yaw) * x + np.cos(yaw) * y + py - corner[1]) / CELL).astype(int)
        queries.append(aerial[:, row, column])
        poses.append([px, py, yaw])
    sensor = np.array(["os64"] * 12)
    return WorldViews(aerial, corner, np.stack(queries), np.array(poses), sensor, "dots", np.zeros(12), {})


def agreement(piece: np.ndarray, query: np.ndarray, pose: np.ndarray) -> float:
    """Share of a query's dots that lie within a cell of a dot of the piece."""
    row, column = np.nonzero(query[0])
    x, y = (column + 0.5 - QUERY_CELLS / 2) * CELL, (row + 0.5 - QUERY_CELLS / 2) * CELL
    c, s = np.cos(pose[2]), np.sin(pose[2])
    at = np.stack([s * x + c * y + pose[1], c * x - s * y + pose[0]])
    i, j = np.floor(at / CELL + PIECE / 2).astype(int)
    inside = (i > 0) & (j > 0) & (i < PIECE - 1) & (j < PIECE - 1)
    i, j = i[inside], j[inside]
    hits = [piece[0, i + di, j + dj] > 0 for di in (-1, 0, 1) for dj in (-1, 0, 1)]
    return float(np.any(hits, axis=0).mean())


@pytest.mark.parametrize("seed", range(4))
def test_batch_poses_match_query_positions_in_map_pieces(seed: int) -> None:
    worlds = [world(k) for k in range(3)]
    batch = draw_batch(worlds, 3, 4, np.random.default_rng(seed), augment=False)

    def agreements(poses: np.ndarray) -> list[float]:
        rows = zip(batch.piece_of, batch.queries, poses, strict=True)
        return [agreement(batch.pieces[owner], query, pose) for owner, query, pose in rows]

    assert min(agreements(batch.poses)) > 0.8  # turning by any angle drops some dots
    assert max(agreements(batch.poses + np.array([0.0, 0.0, 0.5]))) < 0.5


def test_equal_seeds_give_equal_batches() -> None:
    worlds = [world(k) for k in range(2)]
    first, second = (draw_batch(worlds, 2, 3, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.queries, second.queries)
    assert np.array_equal(first.poses, second.poses)
    other = draw_batch(worlds, 2, 3, np.random.default_rng(6))
    assert not np.array_equal(first.poses, other.poses)


TOP, SEEN, RELIEF = LAYERS - 3, LAYERS - 2, LAYERS - 1
SHAPE = (LAYERS, 96, 80)


class Draws:
    """Random numbers of a seed; those that decide whether a change is made are given."""

    def __init__(self, seed: int, *decisions: float) -> None:
        self._rng, self._decisions = np.random.default_rng(seed), list(decisions)

    def random(self, *args, **more):
        return self._rng.random(*args, **more) if args or not self._decisions else self._decisions.pop(0)

    def __getattr__(self, name):
        return getattr(self._rng, name)


@pytest.fixture
def image() -> Image:
    return np.random.default_rng(1).integers(1, 256, SHAPE).astype(np.uint8)


def changed(before: Image, after: Image) -> list[int]:
    return [k for k in range(LAYERS) if not np.array_equal(before[k], after[k])]


@pytest.mark.parametrize("aerial", [True, False])
@pytest.mark.parametrize("seed", range(12))
def test_augmentation_keeps_shape_type_and_original(image: Image, aerial: bool, seed: int) -> None:
    kept = image.copy()
    spoilt = augmented(image, aerial, np.random.default_rng(seed))
    assert spoilt.shape == SHAPE
    assert spoilt.dtype == np.uint8
    assert not np.shares_memory(spoilt, image)
    np.testing.assert_array_equal(image, kept)
    np.testing.assert_array_equal(spoilt, augmented(image, aerial, np.random.default_rng(seed)))


def test_augmentation_with_zero_probabilities_changes_nothing(image: Image) -> None:
    np.testing.assert_array_equal(augmented(image, True, Draws(0, 1, 1, 1, 1, 1)), image)


def test_fallen_trees_clear_disks_in_height_layers(image: Image) -> None:
    counts = []
    for seed in range(40):
        felled = augmented(image, True, Draws(seed, 0, 1, 1, 1, 1))
        np.testing.assert_array_equal(felled[SEEN:], image[SEEN:])
        gone = felled[TOP] == 0
        for layer in felled[: TOP + 1]:  # the same disks in all layers; elsewhere as it was
            np.testing.assert_array_equal(layer == 0, gone)
        np.testing.assert_array_equal(felled[:, ~gone], image[:, ~gone])
        counts.append(gone.sum() * CELL**2 / (SHAPE[1] * SHAPE[2] * CELL**2))
    # 20 disks a hectare on average, of about 10 m2 each, some cut by the edge
    assert 0.01 < np.mean(counts) < 0.03
    assert max(counts) > 0.03


@pytest.mark.parametrize(
    ("change", "aerial", "layers", "least", "most"),
    [
        ("thinner", True, {*range(LAYERS - 3), SEEN}, LAYERS - 2, LAYERS - 2),
        ("hidden below", True, {0, 1, 2}, 1, 3),
        ("hidden above", False, {*range(3, TOP + 1)}, 2, TOP - 2),
        ("denser", True, {*range(LAYERS - 3)}, LAYERS - 3, LAYERS - 3),
        ("relief", True, {RELIEF}, 1, 1),
    ],
)
def test_change_touches_its_own_layers(image: Image, change, aerial, layers, least, most) -> None:
    number = {"thinner": 1, "denser": 3, "relief": 4}.get(change, 2)
    outcomes = set()
    for seed in range(20):
        other = augmented(image, aerial, Draws(seed, *(int(k != number) for k in range(5))))
        touched = changed(image, other)
        assert set(touched) <= layers
        assert least <= len(touched) <= most
        assert change not in ("thinner", "hidden below", "hidden above") or (other <= image).all()
        outcomes.add(other.tobytes())
    assert len(outcomes) > 2
