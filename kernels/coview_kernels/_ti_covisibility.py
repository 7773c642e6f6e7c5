# mypy: ignore-errors
"""Taichi source of covisibility.py: chunks of grids in parallel, the sectors of a grid in sequence."""

from coview_kernels import launch, runtime

ti = runtime.library()
i32 = ti.i32

Floats = ti.types.ndarray(ti.f32, 1)
Integers = ti.types.ndarray(i32, 1)
SPAN = launch.SPAN


@ti.func
def describe_grid(
    at: i32, rings: i32, sectors: i32, paper: i32,
    highest: ti.template(), count: ti.template(), mean: ti.template(), value: ti.template(),
):  # fmt: skip
    """Write the context of the grid that begins at ``at``.

    Slopes are h / (i + 1) with i from 0, and are compared by exact products, see reference/. Bins that are only
    vertically visible get their greatest height, or 0 by the ``paper``. By the paper, bins that are visible both ways
    get their ``mean`` height, and bins on the line of sight are visible too.
    """
    size = rings * sectors
    points = ti.cast(0, ti.i64)
    for b in range(at, at + size):
        points += ti.max(count[b], 0)
    for j in range(sectors):
        best_h = ti.cast(0.0, ti.f64)
        best_a = 0
        for i in range(rings):
            b = at + i * sectors + j
            n = count[b]
            out = ti.cast(0.0, ti.f32)
            if n > 0:
                top = highest[b]
                h = ti.cast(top, ti.f64)
                a = i + 1
                dense = ti.cast(n, ti.i64) * size >= points
                if best_a == 0 or h * best_a > a * best_h or (paper == 1 and h * best_a == a * best_h):
                    best_h = h
                    best_a = a
                    out = top
                    if paper == 1 and dense:
                        out = mean[b]
                elif paper == 0 and dense:
                    out = top
            value[b] = out


@runtime.kernel
def coview(
    grids: i32, chunks: i32, rings: i32, sectors: i32, paper: i32,
    highest: Floats, count: Integers, mean: Floats, value: Floats,
):  # fmt: skip
    """Write the contexts of all grids."""
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (grids + chunks - 1) // chunks
            for m in range(ti.min(grids, c * step), ti.min(grids, (c + 1) * step)):
                at = m * rings * sectors
                describe_grid(at, rings, sectors, paper, highest, count, mean, value)
