"""Descriptor of a full virtual local scan beside NumPy: ``python -m bench describe``.

A full VLS is what 20 keyframes see within 50 m, one point per 0.5 m voxel: here a street of 40 m with its frames
(:mod:`bench.intake`) every 2 m, laid over crowns and facades, 131,072 points in the order of the keyframes. Bins
20 x 60, both channels that a map stores (greatest height, co-visible). The baseline is the plain reference; its
co-visibility serves us too, since one grid takes it less than a launch.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from bench.harness.rows import REPEAT, Row, against, medians
from bench.speed.intake import frame

_POINTS = 131_072
_LEAST = 10.0


def virtual_scan() -> npt.NDArray[np.float32]:
    """Points (131072, 3) of 20 keyframes 2 m apart; heights are spread, since one street has too few voxels."""
    from coview_kernels import reference

    rng = np.random.default_rng(1)
    parts = []
    for k in range(20):
        points = frame(k)
        points += np.array([2.0 * k - 20.0, 0.0, 0.0], dtype=np.float32)
        points[:, 1:] += rng.normal(0, 2.5, (len(points), 2)).astype(np.float32)
        parts.append(points[np.hypot(points[:, 0], points[:, 1]) < 50.0])
    unique = reference.transform_unique(np.concatenate(parts), np.eye(4), 0.5)[0]
    chosen = np.sort(rng.choice(len(unique), min(_POINTS, len(unique)), replace=False))
    return np.ascontiguousarray(unique[chosen])


def measure(repeat: int) -> list[float]:
    """Milliseconds of ours and the reference, then of binning alone, ours first."""
    import coview_kernels as kernels
    from coview_kernels import reference
    from coview_stream.config import DescriptorConfig
    from coview_stream.place.descriptor import describe

    points, centre, config = virtual_scan(), np.array([0.1, -0.2, -1.8]), DescriptorConfig()
    size = config.rings, config.sectors, config.radius

    def plain() -> list[npt.NDArray[np.float32]]:
        grid, _ = reference.polar_bin(points, centre, *size)
        highest = np.where(grid.count > 0, np.maximum(grid.max_height, 0.0), 0.0).astype(np.float32)
        return [highest, reference.coview(*grid, mode=config.visibility, eye=config.eye)]

    if not all(map(np.array_equal, describe(points, centre, config).values(), plain())):
        raise AssertionError("ours and NumPy disagree")
    return medians(
        *(lambda: describe(points, centre, config), plain),
        *(
            lambda: kernels.polar_bin(points, centre, *size),
            lambda: reference.polar_bin(points, centre, *size),
        ),
        repeat=repeat,
    )


def rows(quick: bool = False) -> Iterator[Row]:
    """Ratios of the whole and of its parts."""
    found = measure(5 if quick else REPEAT)
    for what, least, k in (("", _LEAST, 0), (", bins alone", None, 2)):
        yield against(f"describe, {_POINTS} points{what}", found[k], found[k + 1], "ms", least)
