"""Scores against a likelihood field: the kernel as its twin, and both as plain geometry."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import coview_kernels as kernels
from coview_kernels import reference
from coview_kernels.field import FieldKernel, FieldMap, FieldScan
from coview_kernels.mapped import Windows
from coview_kernels.reference.field import NO_GROUND, NOT_SURVEYED, TILE, FieldLayers, Plan

Scene = tuple[FieldMap, FieldScan, np.ndarray, np.ndarray]


def street(rng: np.random.Generator) -> tuple[FieldMap, np.ndarray]:
    """A flat street of 3 x 3 tiles (48 m) with walls; the map, and the walls' points."""
    walls = []
    for x, y, length, along in ((10, 12, 20, 0), (8, 30, 26, 0), (12, 10, 14, 1), (38, 14, 20, 1), (22, 36, 8, 1)):
        t, z = rng.uniform(0, length, 1500), rng.uniform(0, 6, 1500)
        side = np.full_like(t, 0.25)
        walls.append(np.column_stack([x + (t if along == 0 else side), y + (side if along == 0 else t), z]))
    points = np.concatenate(walls)
    column, row, level = np.floor(points * 2).astype(int).T
    occupied = np.zeros((3 * TILE, 3 * TILE), dtype=np.uint64)
    np.bitwise_or.at(occupied, (row, column), np.uint64(1) << level.astype(np.uint64))
    tiles = np.array([[r, c, 0] for r in range(3) for c in range(3)], dtype=np.int32)
    shape = (9, TILE, TILE)
    cut = occupied.reshape(3, TILE, 3, TILE).transpose(0, 2, 1, 3).reshape(shape)
    edge = np.zeros(shape, dtype=np.uint8)
    edge[4, :5, :5] = 40
    ground = np.zeros(shape, dtype=np.int16)
    ground[2, :6] = NO_GROUND
    return FieldMap(tiles, np.ascontiguousarray(cut).view(np.int64), ground, edge), points


def scan_at(points: np.ndarray, pose: np.ndarray, rng: np.random.Generator) -> FieldScan:
    """Scan of the walls and the ground from ``pose`` (x, y, z, yaw); the robot's pivot is 1.5 m above the ground."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    high = points[points[:, 2] > 1.0][::3]
    flat = np.column_stack([rng.uniform(2, 46, (400, 2)), np.zeros(400)])
    free = np.column_stack([rng.uniform(2, 46, (300, 2)), rng.uniform(1, 6, 300)])
    seen = [((p - pose[:3]) @ turn).astype(np.float32) for p in (high, flat, free)]
    return FieldScan(*seen)


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(11)
    field, points = street(rng)
    pose = np.array([24.0, 22.0, 1.5, 0.4])
    return field, scan_at(points, pose, rng), pose, rng.uniform([8, 8, 0.5, -3], [40, 40, 2.5, 3], (40, 4))


def test_pose_is_found_from_three_metres_and_six_degrees_off(scene: Scene):
    field, scan, pose, _ = scene
    starts = pose + np.array([[0, 0, 0, 0], [2.6, -2.2, 0.8, 0.1], [-2.9, 2.4, -1.0, -0.1], [0.4, 0.3, 0.2, 0.03]])
    found = kernels.field_scores(field, scan, starts)
    off = np.abs(found.pose - pose)
    assert (off[:, :2] < 0.3).all()
    assert (off[:, 2] < 0.05).all()
    assert (off[:, 3] < np.radians(0.8)).all()
    assert (found.near > 0.95 * found.structure).all()
    assert (found.grounded > 0.8 * found.low).all()


def test_near_refinement_follows_drift_and_wanders_no_farther(scene: Scene):
    field, scan, pose, others = scene
    found = kernels.field_scores(field, scan, [pose + np.array([0.3, -0.25, 0.2, 0.01])], kernels.Move.NEAR)
    off = np.abs(found.pose[0] - pose)
    assert off[:2].max() < 0.2
    assert off[2] < 0.05
    assert off[3] < np.radians(0.6)
    moved = np.abs(kernels.field_scores(field, scan, others, kernels.Move.NEAR).pose - others)
    assert moved[:, :2].max() <= 0.375 + 1e-4
    assert moved[:, 3].max() <= np.radians(0.75) + 1e-4


def test_kernel_agrees_with_its_numpy_twin(scene: Scene):
    field, scan, pose, others = scene
    starts = np.vstack([pose, others])
    corner = np.array([*field.corner[::-1] * 16.0, 0, 0])
    Move = kernels.Move
    for move, levels, coarse in (
        (Move.NONE, -1, False),
        (Move.HEIGHT, 0, False),
        (Move.FAR, 2, True),
        (Move.NEAR, 2, False),
    ):
        poses, counts = reference.field_scores(field.layers, Plan(*scan.parts, levels, coarse), starts - corner)
        found = kernels.field_scores(field, scan, starts, move)
        # a point on a cell's edge may round to either side; a few of a thousand do
        same = (np.abs(found.pose - poses - corner) < 0.02).all(axis=1)
        assert same.mean() > 0.9
        assert np.abs(np.column_stack(found[1:])[same] - counts[same]).max() <= 6


def test_structure_counts_at_all_64_levels_and_at_the_six_neighbours():
    rng = np.random.default_rng(5)
    cells = rng.random((TILE, TILE, 64)) < 0.05
    words = np.bitwise_or.reduce(cells.astype(np.uint64) << np.arange(64, dtype=np.uint64), axis=2)
    flat = np.zeros((1, TILE, TILE))
    field = FieldMap(
        np.zeros((1, 3), np.int32), words.view(np.int64)[None], flat.astype(np.int16), flat.astype(np.uint8)
    )
    at = np.array(list(np.ndindex(TILE, TILE, 64)))
    points = (0.5 * at[:, [1, 0, 2]] + 0.25).astype(np.float32)
    near = np.pad(cells, ((1, 1), (1, 1), (0, 0)))
    near = near[1:-1, :-2] | near[1:-1, 2:] | near[:-2, 1:-1] | near[2:, 1:-1]
    near |= cells | np.roll(cells, 1, axis=2) | np.roll(cells, -1, axis=2)
    for rows, shift in ((at[:, 2] < 32, 0.0), (at[:, 2] >= 32, 0.0), (at[:, 2] >= 0, 32.0)):  # heights repeat by 32 m
        scan = FieldScan(points[rows], points[:0], points[rows])
        found = kernels.field_scores(field, scan, [[0.0, 0.0, shift, 0.0]], kernels.Move.NONE)
        on, close = (int(mask[tuple(at[rows].T)].sum()) for mask in (cells, near))
        assert (found.on[0], found.near[0], found.passed[0]) == (on, close, on)
        beside = kernels.near_structure(field, points[rows], [0.0, 0.0, shift, 0.0], [[0.0, 0.0], [0.5, 0.0]])
        moved = np.pad(near[:, 1:], ((0, 0), (0, 1), (0, 0)))
        assert beside.sum(axis=1).tolist() == [close, moved[tuple(at[rows].T)].sum()]


def test_floor_above_the_lowest_surface_is_ground_where_the_map_has_points():
    occupied = np.zeros((1, TILE, TILE), dtype=np.int64)
    ground, edge = np.zeros((1, TILE, TILE), dtype=np.int16), np.zeros((1, TILE, TILE), dtype=np.uint8)
    occupied[0, 5, 5:8], ground[0, 5, 6], ground[0, 5, 7] = 1 << 6, NO_GROUND, NOT_SURVEYED
    field = FieldMap(np.zeros((1, 3), np.int32), occupied, ground, edge)
    low = np.array([[x, 2.6, z] for x, z in ((2.6, 3.1), (3.1, 3.1), (3.6, 3.1), (4.1, 3.1), (2.6, 0.1), (2.6, 1.0))])
    scan = FieldScan(low[:0].astype(np.float32), low.astype(np.float32), low[:0].astype(np.float32))
    found = kernels.field_scores(field, scan, np.zeros((1, 4)), kernels.Move.NONE)
    corner = np.array([*field.corner[::-1] * 16.0, 0.0, 0.0])
    twin = reference.field_scores(field.layers, Plan(*scan.parts, -1, False), np.zeros((1, 4)) - corner)[1][0]
    assert (found.low[0], found.grounded[0]) == (twin[3], twin[4]) == (5, 3)


def test_one_map_scores_one_scan_after_another(scene: Scene):
    field, scan, _, others = scene
    other = FieldScan(scan.structure[::2], scan.low[::3], scan.free[::2])
    first = kernels.field_scores(field, scan, others)
    second = kernels.field_scores(field, other, others[:7])
    assert len(second.pose) == 7
    assert second.structure.max() <= len(other.structure) < first.structure.max()
    for alone in (replace(field), copy.deepcopy(field), pickle.loads(pickle.dumps(field))):
        for one, again in zip(kernels.field_scores(alone, other, others[:7]), second, strict=True):
            np.testing.assert_array_equal(one, again)
    for one, again in zip(kernels.field_scores(field, scan, others), first, strict=True):
        np.testing.assert_array_equal(one, again)


def test_unsurveyed_cells_are_left_out(scene: Scene):
    field, scan, pose, _ = scene
    half = kernels.field_scores(field, scan, [pose + np.array([24.0, 0, 0, 0])], kernels.Move.NONE)
    away = kernels.field_scores(field, scan, [pose + np.array([500.0, -300.0, 0, 0])])
    assert 0.2 * len(scan.structure) < half.structure[0] < 0.8 * len(scan.structure)
    assert not any(int(n[0]) for n in away[1:])
    assert np.isfinite(away.pose).all()


def test_walls_below_a_roof_edge_are_covered():
    field, _ = street(np.random.default_rng(3))
    below = np.column_stack([np.full(50, 17.0), np.full(50, 17.0), np.linspace(1, 9, 50)]).astype(np.float32)
    empty = np.zeros((0, 3), dtype=np.float32)
    found = kernels.field_scores(field, FieldScan(below, empty, empty), np.zeros((1, 4)), kernels.Move.NONE)
    assert found.structure[0] == 50
    assert found.covered[0] == 50
    assert found.near[0] == 0


def test_points_moved_by_whole_cells_are_looked_up_where_they_lie(scene: Scene):
    field, scan, truth, _ = scene
    shifts = np.array([(0.0, 0.0), (3.0, -2.0), (-7.0, 8.0), (60.0, 0.0), (0.5, -90.0)])
    near = kernels.near_structure(field, scan.structure, truth, shifts)
    for mask, (x, y) in zip(near, shifts, strict=True):
        moved = kernels.field_scores(field, scan, [truth + np.array([x, y, 0.0, 0.0])], kernels.Move.NONE)
        assert abs(int(mask.sum()) - int(moved.near[0])) <= 1  # a point on an edge may round
    assert near[0].mean() > 0.5
    assert not near[3:].any()


def test_empty_scan_and_no_hypotheses_are_answered(scene: Scene):
    field, scan, pose, _ = scene
    empty = np.zeros((0, 3), dtype=np.float32)
    found = kernels.field_scores(field, FieldScan(empty, empty, empty), [pose])
    assert np.abs(found.pose[0, :3] - pose[:3]).max() <= 4.0
    assert not any(int(n[0]) for n in found[1:])
    assert len(kernels.field_scores(field, scan, np.empty((0, 4))).pose) == 0


def test_wrong_shapes_and_poses_are_refused(scene: Scene):
    field, scan, pose, _ = scene
    with pytest.raises(ValueError, match="poses"):
        kernels.field_scores(field, scan, pose)
    with pytest.raises(ValueError, match="NaN"):
        kernels.field_scores(field, scan, [pose * np.nan])
    with pytest.raises(ValueError, match="structure"):
        kernels.field_scores(field, FieldScan(scan.structure[:, :2], scan.low, scan.free), [pose])


def test_layers_made_in_small_batches_are_the_same(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    field, whole = scene[0], scene[0].layers
    monkeypatch.setattr("coview_kernels.field._BATCH", 3)
    monkeypatch.setattr("coview_kernels.field._BAND", 2)
    assert whole.table.shape[0] > 4
    names = []
    made = field.made_layers(lambda name, shape, kind: names.append(name) or np.zeros(shape, kind))
    assert names == ["words", "surface", "coarse"]
    for one, other in zip(made, whole, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", FieldLayers._fields)
def test_layers_that_are_not_those_of_the_tiles_are_refused(scene: Scene, name: str):
    field = scene[0]
    with pytest.raises(ValueError, match="not those of the tiles"):
        replace(field, stored=field.layers._replace(table=field.layers.table + 1))
    with pytest.raises(ValueError, match=name):
        replace(field, stored=field.layers._replace(**{name: getattr(field.layers, name)[:-1]}))
    with pytest.raises(ValueError, match=name):
        replace(field, stored=field.layers._replace(**{name: getattr(field.layers, name).astype(np.uint32)}))


def test_field_of_a_file_is_gone_through_by_windows_with_the_same_scores(
    scene: Scene, tmp_path: Path, windows: Callable[[int, int], None]
):
    field, scan, pose, others = scene
    np.save(tmp_path / "bits.npy", field.layers.words)
    bits = np.load(tmp_path / "bits.npy", mmap_mode="r")
    stored = replace(field, stored=field.layers._replace(words=bits))
    windows(1 << 14, 2 * bits[0].nbytes)
    assert len(list(Windows(bits))) == 5
    assert stored.layers is stored.stored
    starts = np.vstack([others, pose, np.add(pose, [500.0, -300.0, 0.0, 0.0])])  # some beside the map
    for poses in (starts, pose[None]):
        for one, other in zip(*(kernels.field_scores(each, scan, poses) for each in (field, stored)), strict=True):
            np.testing.assert_array_equal(one, other)


def test_tiles_beyond_what_32_bits_count_are_looked_up(scene: Scene, tmp_path: Path):
    """More than 268 km2: the same tiles under the highest numbers, in files that are holes but for these."""
    field, scan, pose, others = scene
    layers, last = field.layers, (1 << 20) + 50
    number = np.where(layers.table > 4, layers.table + last, layers.table)
    far = np.concatenate([[0], np.unique(number[number > 0])])
    sparse = {}
    for name in ("base", "words", "surface"):
        own = getattr(layers, name)
        made = np.memmap(tmp_path / name, own.dtype, "w+", shape=(last + len(own), *own.shape[1:]))
        made[far] = own
        sparse[name] = made
    large = layers._replace(table=number.astype(np.int32), **sparse)
    assert large.words.size > 2**31
    corner = np.array([*field.corner[::-1] * 16.0, 0.0, 0.0])
    starts = np.vstack([others, pose, pose + np.array([0.0, 0.0, 16.0, 0.0])]) - corner  # upper words, too
    plan = Plan(*scan.parts, 2, True)

    def scores(each: FieldLayers) -> tuple[np.ndarray, np.ndarray]:
        if kernels.backend() == "numpy":
            return reference.field_scores(each, plan, starts.copy())
        return FieldKernel(each)(scan, 2, True, starts.copy())

    both = (kernels.submit(scores, each) for each in (layers, large))
    for one, other in zip(*both, strict=True):
        np.testing.assert_array_equal(one, other)
