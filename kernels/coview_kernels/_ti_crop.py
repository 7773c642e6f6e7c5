# mypy: ignore-errors
"""Taichi source of crop.py: one pass measures the points around a place, another sorts them by cell."""

from coview_kernels import runtime
from coview_kernels._ti_nearest import cell_of

ti = runtime.library()
f32, f64, i32 = ti.f32, ti.f64, ti.i32

Floats = ti.types.ndarray(f32, 1)
Doubles = ti.types.ndarray(f64, 1)
Integers = ti.types.ndarray(i32, 1)
Bytes = ti.types.ndarray(ti.i8, 1)

FINITE = 3.4028235e38
# settings: centre (2) and squared radius; for sort also the grid's frame (8)
RADIUS, FRAME = 2, 3


@ti.func
def inside(settings: ti.template(), x: f32, y: f32, z: f32) -> i32:
    """Return whether a point lies within the radius; false for NaN."""
    dx, dy = ti.cast(x, f64) - settings[0], ti.cast(y, f64) - settings[1]
    return ti.cast(dx * dx + dy * dy < settings[RADIUS], i32) & ti.cast(ti.abs(z) <= FINITE, i32)


@runtime.kernel
def measure(points: Floats, spans: Integers, settings: Doubles, bounds: Floats, count: Integers):
    """Write lowest (3) and highest (3) coordinates of the points inside, and their number."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        around = ti.Vector([settings[k] for k in ti.static(range(3))])
        low, high = ti.Vector([FINITE, FINITE, FINITE]), ti.Vector([-FINITE, -FINITE, -FINITE])
        number = 0
        for s in range(spans.shape[0] // 2):
            for n in range(spans[2 * s], spans[2 * s + 1]):
                x, y, z = points[3 * n], points[3 * n + 1], points[3 * n + 2]
                if inside(around, x, y, z) > 0:
                    p = ti.Vector([x, y, z])
                    low, high = ti.min(low, p), ti.max(high, p)
                    number += 1
        for d in ti.static(range(3)):
            bounds[d] = low[d]
            bounds[3 + d] = high[d]
        count[0] = number


@runtime.kernel
def sort(
    points: Floats, normals: Bytes, spans: Integers, settings: Doubles,
    cell: Integers, starts: Integers, rows: Integers, planes: Floats,
):  # fmt: skip
    """Sort the points inside by cell with a counting sort; crop.py describes the output.

    ``starts`` is zeros at first; ``cell`` has room for every point of the spans.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        number = ti.Vector([settings[k] for k in ti.static(range(11))])
        nx, ny = ti.cast(number[FRAME + 5], i32), ti.cast(number[FRAME + 6], i32)
        nz = ti.cast(number[FRAME + 7], i32)
        at = 0
        for s in range(spans.shape[0] // 2):
            for n in range(spans[2 * s], spans[2 * s + 1]):
                x, y, z = points[3 * n], points[3 * n + 1], points[3 * n + 2]
                c = -1  # not inside
                if inside(number, x, y, z) > 0:
                    u, v, w = ti.cast(x, f64), ti.cast(y, f64), ti.cast(z, f64)
                    i = cell_of((u - number[FRAME]) * number[FRAME + 4], nx)
                    j = cell_of((v - number[FRAME + 1]) * number[FRAME + 4], ny)
                    c = (i * ny + j) * nz + cell_of((w - number[FRAME + 2]) * number[FRAME + 4], nz)
                    starts[c] = starts[c] + 1
                cell[at] = c
                at += 1
        end = 0
        for k in range(starts.shape[0]):
            end += starts[k]
            starts[k] = end
        # backwards, so that points of a cell keep their order; each start ends at the beginning of its cell
        for r in range(spans.shape[0] // 2):
            b = spans.shape[0] - 2 - 2 * r
            for m in range(spans[b + 1] - spans[b]):
                n = spans[b + 1] - 1 - m
                at -= 1
                here = cell[at]
                if here >= 0:
                    place = starts[here] - 1
                    starts[here] = place
                    for d in ti.static(range(3)):
                        rows[4 * place + d] = ti.bit_cast(points[3 * n + d], i32)
                        planes[3 * place + d] = ti.cast(normals[3 * n + d], f32) / 127.0
                    rows[4 * place + 3] = place
