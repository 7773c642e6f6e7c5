"""Scores of hypotheses against a map's likelihood field, each first moved to the best pose around it.

A hypothesis is the pose of a scan: position and heading of a pivot in the scan. The kernel finds the best shift and
heading near each hypothesis, coarse to fine, and the height at which the scan's ground lies on the map's; then it
counts the points that the map explains there (:class:`FieldScores`). It only looks up cells, and searches no points.

1. Coarse: part of the scan's structure on cells of a metre, at all shifts of up to three metres and seven headings up
   to six degrees off; one pass over the points per heading, as shifts are neighbouring cells.
2. Height: the mean difference between the map's ground and the scan's, twice.
3. Fine: the eight neighbours half a metre away, and two headings a degree off at the best; then the same with half
   these steps. A point counts twice on half-metre cells with structure, once within half a metre of one.
4. Counts, with all points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, F64, I16, I32, I64, U8, U16, U64, Mask, as_finite64, as_float32
from coview_kernels.launch import Launch
from coview_kernels.mapped import Windows
from coview_kernels.reference.field import CELL, NOT_SURVEYED, TILE, FieldLayers, Plan
from coview_kernels.warm_up import SAMPLE, compiled_by

COARSE, FINE, LOW, LEVELS = 96, 160, 64, 2
"""Points of the coarse level, of a fine level and for the height; number of fine levels. With a third fewer points one
of 24 places was lost in one world; docs/results.md says how often the right place comes first."""

_MAX_TABLE = 1 << 21  # tiles in a map's bounding rectangle, 537 km2: kernels count in int32
_HALF, _LOWER = np.uint64(32), np.uint64(0xFFFFFFFF)  # bits of half a word, and its lower half
_MIDDLE = 1 << 31  # words of bits that a signed 32-bit index reaches; on larger maps it counts from this word
_BATCH = 512  # tiles at a time, to keep intermediate arrays small
_BAND = 16  # rows of tiles at a time, for the same reason

Zeros = Callable[[str, tuple[int, ...], type[np.generic]], npt.NDArray[Any]]
"""Allocates a writable array of zeros for a layer, by name, shape and type."""


class Move(Enum):
    """Range within which hypotheses are moved to the best pose around them."""

    NONE = "none"
    HEIGHT = "height"
    """To the map's ground, along z alone."""
    NEAR = "near"
    """By at most 0.375 m along x and y each and 0.75 degrees, fine levels only; and along z to the ground."""
    FAR = "far"
    """By at most 3.75 m along x and y each and 7.5 degrees; and along z to the ground."""


class FieldScores(NamedTuple):
    """Counts of the scan's points that the map explains at the best pose near each of H hypotheses."""

    pose: F64
    """(H, 4) x, y, z of the pivot in the map, metres, and heading of the scan's frame, radians."""
    structure: I32
    """(H,) structure points on surveyed cells; ``near``, ``covered`` and ``on`` are subsets."""
    near: I32
    """(H,) within about half a metre of map structure."""
    covered: I32
    """(H,) near, or below a roof edge."""
    low: I32
    """(H,) ground points on surveyed cells."""
    grounded: I32
    """(H,) ground points on the map's ground."""
    passed: I32
    """(H,) free points on map structure."""
    on: I32
    """(H,) structure points in a half-metre cell with map structure."""


@dataclass(frozen=True)
class FieldScan:
    """A levelled scan relative to the pivot, metres; neighbouring points follow one another.

    Its arrays must not change, as they are copied once for the kernel.
    """

    structure: F32
    """(N, 3) points above the ground."""
    low: F32
    """(G, 3) points on the ground."""
    free: F32
    """(F, 3) points in free space, which rays have passed."""

    @cached_property
    def parts(self) -> tuple[F32, F32, F32, F32, F32, F32]:
        """The points, and those of the levels, as in :class:`Plan`; ValueError if a shape is wrong."""
        structure, low, free = (as_float32(name, getattr(self, name), None, 3) for name in ("structure", "low", "free"))
        return structure, low, free, _spread(structure, COARSE), _spread(structure, FINE), _spread(low, LOW)

    @cached_property
    def columns(self) -> tuple[F32, ...]:
        """:attr:`parts` as the kernel reads them, (3, N) each."""
        return tuple(np.ascontiguousarray(points.T) for points in self.parts)


@dataclass(frozen=True, eq=False)
class FieldMap:
    """Rasters of a map in tiles of 32 x 32 cells of half a metre; row along y, column along x.

    Attributes:
        tiles: (T, 3) int32 row and column of each tile, and the base of its heights, metres.
        occupied: (T, 32, 32) int64; bit ``floor(2 z) mod 64`` is set if the cell has a point at height z.
        ground: (T, 32, 32) int16 centimetres above the tile's height, ``NO_GROUND`` or ``NOT_SURVEYED``.
        edge: (T, 32, 32) uint8 quarter metres above the tile's height, 0 for none.
        stored: existing layers, perhaps memory-mapped; None builds them at first use.

    Raises:
        ValueError: an array has a wrong shape or type, the layers do not match the tiles, or the map is too large for
            the indices of a kernel.
    """

    tiles: I32
    occupied: I64
    ground: I16
    edge: U8
    stored: FieldLayers | None = None

    def __post_init__(self) -> None:
        shape = (len(self.tiles), TILE, TILE)
        for name, kind, wanted in (
            ("tiles", np.int32, (len(self.tiles), 3)),
            ("occupied", np.int64, shape),
            ("ground", np.int16, shape),
            ("edge", np.uint8, shape),
        ):
            array = getattr(self, name)
            if array.shape != wanted or array.dtype != kind:
                raise ValueError(f"{name} is {array.dtype} {array.shape}, expected {np.dtype(kind)} {wanted}")
        low, high = (
            np.asarray(each, dtype=np.int64) for each in (self.corner, self.tiles[:, :2].max(axis=0, initial=0))
        )
        if len(self.tiles) and float(np.prod(high - low + 2.0)) >= _MAX_TABLE:
            raise ValueError(f"{len(self.tiles)} tiles from {low} to {high} are too many for one map")
        if self.stored is not None:
            self._check(self.stored)

    def _check(self, layers: FieldLayers) -> None:
        """Compare layers with the tiles, as a wrong table would make the kernel read elsewhere."""
        table, base = self._table()
        tiles, (rows, columns) = len(base), table.shape
        for name, kind, shape in (
            ("table", np.int32, table.shape),
            ("base", np.float32, base.shape),
            ("words", np.int64, (tiles, 2, TILE, TILE)),
            ("surface", np.int32, (tiles, TILE, TILE)),
            ("coarse", np.uint16, _coarse_shape(rows, columns)),
        ):
            array = getattr(layers, name)
            if array.shape != shape or array.dtype != kind:
                raise ValueError(f"layer {name} is {array.dtype} {array.shape}, expected {np.dtype(kind)} {shape}")
        if not (np.array_equal(layers.table, table) and np.array_equal(layers.base, base)):
            raise ValueError("the layers are not those of the tiles")

    @cached_property
    def corner(self) -> I64:
        """Row and column (2,) of the table's first tile, one before the first used tile."""
        return np.asarray(self.tiles[:, :2].min(axis=0, initial=1 << 30).astype(np.int64) - 1)

    @cached_property
    def layers(self) -> FieldLayers:
        """Rasters for the look-ups, 22 bytes per cell, built at first use unless they are stored."""
        return self.made_layers() if self.stored is None else self.stored

    @cached_property
    def kernel(self) -> FieldKernel:
        """Kernel with the :attr:`layers`."""
        return FieldKernel(self.layers)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the prepared launch."""
        return {name: value for name, value in self.__dict__.items() if name != "kernel"}

    def made_layers(
        self, zeros: Zeros = lambda _, shape, kind: np.zeros(shape, kind), done: Callable[[], object] = lambda: None
    ) -> FieldLayers:
        """Build the rasters, batch by batch, in arrays from ``zeros``; ``done`` is called after each batch.

        If the arrays are mapped from files, ``done`` may release their memory.
        """
        table, base = self._table()
        tiles = len(base)
        bits = zeros("words", (tiles, 2, TILE, TILE), np.int64)
        surface = zeros("surface", (tiles, TILE, TILE), np.int32)
        surface[:1] = NOT_SURVEYED & 0xFFFF
        for start in range(0, tiles - 1, _BATCH):
            part, into = slice(start, start + _BATCH), slice(start + 1, start + 1 + _BATCH)
            on = self.occupied[part].view(np.uint64)
            bits[into] = _packed(np.zeros_like(on), on)
            surface[into] = (self.edge[part].astype(np.int32) << 16) | (self.ground[part].astype(np.int32) & 0xFFFF)
            done()
        _fill_near(bits, table, done)
        coarse = zeros("coarse", _coarse_shape(*table.shape), np.uint16)
        _fill_coarse(coarse, bits, table, done)
        return FieldLayers(table, base, bits, surface, coarse)

    def _table(self) -> tuple[I32, F32]:
        """Return the number of each tile (R, C), 0 for none, and the base of its heights (T + 1,)."""
        shape = self.tiles[:, :2].max(axis=0, initial=0).astype(np.int64) - self.corner + 2
        table = np.zeros(np.maximum(shape, 2), dtype=np.int32)
        row, column = (self.tiles[:, :2] - self.corner).T
        table[row, column] = np.arange(1, len(self.tiles) + 1)
        return table, np.concatenate([[0.0], self.tiles[:, 2]]).astype(np.float32)


def field_scores(field: FieldMap, scan: FieldScan, poses: npt.ArrayLike, move: Move = Move.FAR) -> FieldScores:
    """Score hypotheses, each first moved to the best pose around it.

    Args:
        field: the map.
        scan: points to compare, relative to the pivot.
        poses: (H, 4) x, y, z of the pivot in the map, metres, and heading of the scan's frame, radians.
        move: how far the poses are moved.

    Raises:
        ValueError: a shape is wrong, or a pose not finite.
    """
    start = as_finite64("poses", poses, None, 4)
    plan = Plan(*scan.parts, {Move.NONE: -1, Move.HEIGHT: 0}.get(move, LEVELS), move is Move.FAR)
    layers, native = field.layers, field.kernel
    corner = np.array([*field.corner[::-1] * (TILE * CELL), 0.0, 0.0])
    # float32 resolves a tenth of a millimetre at a kilometre from the corner
    pose, counts = start - corner, np.zeros((len(start), 7), dtype=np.int32)
    for rows in _groups(layers, pose):
        pose[rows], counts[rows] = runtime.dispatch_here(
            native.ready,
            lambda at: native(scan, plan.levels, plan.coarse, at),
            lambda at: reference.field_scores(layers, plan, at),
            pose[rows],
        )
    return FieldScores(pose + corner, *np.ascontiguousarray(counts.T))


def _groups(layers: FieldLayers, start: F64) -> Iterator[slice | I64]:
    """Yield hypotheses to score together: all of them, or on a large mapped field window by window.

    Pages of neighbouring windows that the scan reaches stay in memory until the last group is done.
    """
    windows = Windows(layers.words)
    if not windows.several:
        yield slice(None)
        return
    rows, columns = np.clip(
        np.floor(start[:, 1::-1] / (TILE * CELL)).astype(np.int64), 0, np.array(layers.table.shape) - 1
    ).T
    tile = layers.table[rows, columns]
    if len(np.unique(windows.number(tile))) <= 1:  # the surroundings of one robot stay in memory
        yield slice(None)
        return
    for window in windows:
        chosen = np.flatnonzero((tile >= window.start) & (tile < window.stop))
        if len(chosen):
            yield chosen
    windows.release()


def unexplained(field: FieldMap, structure: F32, pose: npt.ArrayLike) -> Mask:
    """Mask structure points (N, 3) that lie at a pose (4,) on surveyed cells, neither near structure nor below an edge.

    Arguments are those of :func:`field_scores`. Runs in NumPy, as calls are rare and have one pose.
    """
    surveyed, _, covered, _ = reference.structure_at(field.layers, *_from_corner(field, structure, pose))
    return np.asarray(surveyed & ~covered)


def near_structure(field: FieldMap, structure: F32, pose: npt.ArrayLike, shifts: npt.ArrayLike) -> Mask:
    """Mask (H, N) structure points (N, 3) within about half a metre of map structure at shifts of a pose (4,).

    Shifts (H, 2) are x and y, whole cells, metres.
    """
    offsets = np.rint(np.asarray(shifts, dtype=np.float64)[:, ::-1] / CELL).astype(np.int64)
    points, at = _from_corner(field, structure, pose)
    return reference.near_shifted(field.layers, points, at, offsets)


def ground_heights(field: FieldMap, points: F32) -> F32:
    """Return the ground height (N,) of the map below or above points (N, 3), map frame, metres; NaN without ground."""
    corner = np.array([*field.corner[::-1] * (TILE * CELL), 0.0]).astype(np.float32)
    return reference.ground_heights(field.layers, as_float32("points", points, None, 3) - corner)


def _from_corner(field: FieldMap, structure: F32, pose: npt.ArrayLike) -> tuple[F32, F64]:
    at = as_finite64("pose", np.reshape(np.asarray(pose, dtype=np.float64), (1, -1)), 1, 4)[0]
    corner = np.array([*field.corner[::-1] * (TILE * CELL), 0.0, 0.0])
    return as_float32("structure", structure, None, 3), at - corner


class FieldKernel:
    """The kernel with the layers of a map; its launch keeps them and the points of the last scan."""

    def __init__(self, layers: FieldLayers) -> None:
        bits, first = layers.words.reshape(-1), 0
        if len(bits) > _MIDDLE:
            bits, first = bits[_MIDDLE:], -_MIDDLE
        self._of_map = (
            layers.coarse.reshape(-1), layers.coarse.shape[1], layers.coarse.shape[2], layers.table.reshape(-1),
            layers.table.shape[1], layers.base, bits, first, layers.surface.reshape(-1),
        )  # fmt: skip
        self._launch: Launch | None = None
        self._columns: tuple[F32, ...] = ()

    def ready(self) -> bool:
        """Return whether any thread may call it, as :meth:`Launch.ready`."""
        return self._launch is not None and self._launch.ready()

    def __call__(self, scan: FieldScan, levels: int, coarse: bool, start: F64) -> tuple[F64, I32]:
        """Compute :func:`reference.field_scores`."""
        poses, counts = np.ascontiguousarray(start), np.zeros((len(start), 7), dtype=np.int32)
        rest = levels, int(coarse), poses.reshape(-1), counts.reshape(-1), runtime.workers()
        if self._launch is None:
            self._launch = Launch("field", "score", *self._of_map, *scan.columns, *rest)
        else:
            new = rest if self._columns is scan.columns else (*scan.columns, *rest)
            count = len(self._of_map) + len(scan.columns) + len(rest)
            self._columns = ()  # an interrupt may leave columns of both scans
            for index, value in enumerate(new, count - len(new)):
                self._launch.put(index, value)
        self._columns = scan.columns
        self._launch()
        return poses, counts


def _spread(points: F32, count: int) -> F32:
    """Return ``count`` evenly spaced points, or all."""
    return points[np.arange(count) * len(points) // count] if len(points) > count else points


def _fill_near(bits: I64, table: I32, done: Callable[[], object]) -> None:
    """Set the bits near structure, at the bits on it and at their six neighbours half a metre away."""
    row, column = np.nonzero(table)
    for start in range(0, len(row), _BATCH):
        rows, columns = row[start : start + _BATCH], column[start : start + _BATCH]
        on = _on(bits[table[rows, columns]])
        padded = np.zeros((len(on), TILE + 2, TILE + 2), dtype=np.uint64)
        padded[:, 1:-1, 1:-1] = on
        padded[:, 0, 1:-1] = _on(bits[table[rows - 1, columns], :, -1])
        padded[:, -1, 1:-1] = _on(bits[table[rows + 1, columns], :, 0])
        padded[:, 1:-1, 0] = _on(bits[table[rows, columns - 1], :, :, -1])
        padded[:, 1:-1, -1] = _on(bits[table[rows, columns + 1], :, :, 0])
        one, rest = np.uint64(1), np.uint64(63)
        near = on | (on << one) | (on >> rest) | (on >> one) | (on << rest)
        near |= padded[:, :-2, 1:-1] | padded[:, 2:, 1:-1] | padded[:, 1:-1, :-2] | padded[:, 1:-1, 2:]
        bits[table[rows, columns]] = _packed(near, on)
        done()


def _packed(near: U64, on: U64) -> I64:
    """Return the words (T, 2, ...) of :attr:`FieldLayers.words` from the bits (T, ...) of all 64 heights."""
    return np.stack([(near & _LOWER) | (on << _HALF), (near >> _HALF) | (on & ~_LOWER)], axis=1).view(np.int64)


def _on(words: I64) -> U64:
    """Return the bits (T, ...) on structure of all 64 heights from words (T, 2, ...)."""
    both = np.ascontiguousarray(words).view(np.uint64)
    return (both[:, 0] >> _HALF) | (both[:, 1] & ~_LOWER)


def _fill_coarse(planes: U16, bits: I64, table: I32, done: Callable[[], object]) -> None:
    """Fill the coarse planes of :class:`FieldLayers`: bits are set within a metre of structure."""
    half, (rows, columns) = TILE // 2, table.shape
    one, rest = np.uint32(1), np.uint32(31)
    for start in range(0, rows, _BAND):
        stop = min(start + _BAND, rows)
        wide = slice(max(start - 1, 0), min(stop + 1, rows))  # a metre beyond the band is enough; a tile has more
        metres = _folded(bits, table[wide], done).transpose(0, 2, 1, 3).reshape(-1, columns * half)
        out = metres | (metres << one) | (metres >> rest) | (metres >> one) | (metres << rest)
        out[1:] |= metres[:-1]
        out[:-1] |= metres[1:]
        out[:, 1:] |= metres[:, :-1]
        out[:, :-1] |= metres[:, 1:]
        band = out[(start - wide.start) * half : (stop - wide.start) * half]
        for level, plane in enumerate(planes[..., start * half : stop * half]):
            packed = np.packbits((band >> np.uint32(level)) & one, axis=1, bitorder="little").astype(np.uint16).T
            plane[:-1] = packed
            plane[:-2] |= packed[1:] << np.uint16(8)
        done()


def _folded(bits: I64, table: I32, done: Callable[[], object]) -> npt.NDArray[np.uint32]:
    """Return the structure (R, C, 16, 16) of a table's tiles in one-metre cells, one bit per metre of height."""
    half, tiles = TILE // 2, table.reshape(-1)
    folded = np.zeros((len(tiles), half, half), dtype=np.uint32)
    used = np.flatnonzero(tiles)
    for start in range(0, len(used), _BATCH):
        part = used[start : start + _BATCH]
        cells = _on(bits[tiles[part]]).reshape(-1, half, 2, half, 2)
        folded[part] = _pairs(cells[:, :, 0, :, 0] | cells[:, :, 0, :, 1] | cells[:, :, 1, :, 0] | cells[:, :, 1, :, 1])
        done()
    return folded.reshape(*table.shape, half, half)


def _coarse_shape(rows: int, columns: int) -> tuple[int, int, int]:
    half = TILE // 2
    return 32, columns * half // 8 + 1, rows * half


def _pairs(words: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint32]:
    """Fold 64 bits into 32: a bit is set if either of two neighbours is."""
    both = (words | (words >> np.uint64(1))) & np.uint64(0x5555555555555555)
    for shift, mask in (
        (1, 0x3333333333333333), (2, 0x0F0F0F0F0F0F0F0F), (4, 0x00FF00FF00FF00FF),
        (8, 0x0000FFFF0000FFFF), (16, 0x00000000FFFFFFFF),
    ):  # fmt: skip
        both = (both | (both >> np.uint64(shift))) & np.uint64(mask)
    return both.astype(np.uint32)


def _compile() -> None:
    cells = np.zeros((1, TILE, TILE), dtype=np.int64)
    field = FieldMap(np.zeros((1, 3), np.int32), cells, cells.astype(np.int16), cells.astype(np.uint8))
    field_scores(field, FieldScan(SAMPLE, SAMPLE, SAMPLE), np.zeros((1, 4)))


compiled_by("field_scores", _compile)
