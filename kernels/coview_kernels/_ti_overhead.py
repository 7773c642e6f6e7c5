# mypy: ignore-errors
"""Taichi source of overhead.py: scatters point by point on one thread; a pass takes 3 to 8 ns per point."""

from coview_kernels import runtime

ti = runtime.library()
f32, f64, i32 = ti.f32, ti.f64, ti.i32

FLOATS = ti.types.ndarray(ti.f32, 1)
DOUBLES = ti.types.ndarray(ti.f64, 1)
LONGS = ti.types.ndarray(ti.i64, 1)
BYTES = ti.types.ndarray(ti.u8, 1)


@ti.func
def cell_of(points: ti.template(), k, frame: ti.template(), rows, columns):
    """Return x and y of a point relative to the corner, and its cell, -1 for none."""
    x, y = points[3 * k] - frame[0], points[3 * k + 1] - frame[1]
    column, row = ti.floor(x * frame[2]), ti.floor(y * frame[2])
    cell = -1
    if column >= 0 and column < ti.cast(columns, f32) and row >= 0 and row < ti.cast(rows, f32):
        cell = ti.cast(row, i32) * columns + ti.cast(column, i32)
    return x, y, cell


@runtime.kernel
def lowest(points: FLOATS, frame: FLOATS, rows: i32, columns: i32, out: FLOATS):
    """Keep the lowest height of each cell; ``frame``: x, y of the corner, cells per metre."""
    ti.loop_config(serialize=True)
    for k in range(points.shape[0] // 3):
        _, _, cell = cell_of(points, k, frame, rows, columns)
        if cell >= 0:
            out[cell] = ti.min(out[cell], points[3 * k + 2])


@runtime.kernel
def near(
    points: FLOATS, frame: FLOATS, rows: i32, columns: i32, level: FLOATS, band: f32, count: LONGS, total: DOUBLES
):
    """Count the points within ``band`` of a cell's level, and sum their heights above it."""
    ti.loop_config(serialize=True)
    for k in range(points.shape[0] // 3):
        _, _, cell = cell_of(points, k, frame, rows, columns)
        if cell >= 0:
            off = points[3 * k + 2] - level[cell]
            if ti.abs(off) < band:
                count[cell] += 1
                total[cell] += ti.cast(off, f64)


@runtime.kernel
def columns_of(
    points: FLOATS, frame: FLOATS, rows: i32, columns: i32, ground: FLOATS, wide: i32, occupied: BYTES, top: FLOATS,
    seen: BYTES,
):  # fmt: skip
    """Fill columns; ``frame`` also has ground cells per metre, levels per metre, lower, upper and ground bounds."""
    ti.loop_config(serialize=True)
    high, top_level = ground.shape[0] // wide, occupied.shape[0] // (rows * columns) - 1
    for k in range(points.shape[0] // 3):
        x, y, cell = cell_of(points, k, frame, rows, columns)
        if cell >= 0:
            u = ti.min(ti.max(ti.cast(x * frame[3] - 0.5, f64), 0.0), ti.cast(wide - 1, f64))
            v = ti.min(ti.max(ti.cast(y * frame[3] - 0.5, f64), 0.0), ti.cast(high - 1, f64))
            j, i = ti.min(ti.cast(u, i32), ti.max(wide - 2, 0)), ti.min(ti.cast(v, i32), ti.max(high - 2, 0))
            u -= ti.cast(j, f64)
            v -= ti.cast(i, f64)
            right, down = ti.min(j + 1, wide - 1), ti.min(i + 1, high - 1)
            one = ti.cast(1.0, f64)
            upper = ti.cast(ground[i * wide + j], f64) * (one - u) + ti.cast(ground[i * wide + right], f64) * u
            lower = ti.cast(ground[down * wide + j], f64) * (one - u) + ti.cast(ground[down * wide + right], f64) * u
            above = points[3 * k + 2] - ti.cast(upper * (one - v) + lower * v, f32)
            if above >= frame[5] and above < frame[6]:
                at = ti.min(ti.cast(above * frame[4], i32), top_level)  # a product may be rounded up to the bound
                occupied[at * (rows * columns) + cell] = ti.cast(1, ti.u8)
            top[cell] = ti.max(top[cell], ti.min(above, frame[6]))
            if above < frame[7]:
                seen[cell] = ti.cast(1, ti.u8)
