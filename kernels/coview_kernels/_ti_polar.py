# mypy: ignore-errors
"""Taichi source of polar.py. Every chunk of points has its own bins, as atomics on shared bins are slower.

A store to an argument is never vectorised (it might alias the others), a store to a local vector is. Points are
therefore processed in blocks: their bins are computed to float32 accuracy, eight points at a time, into a local vector;
then the points are added to the bins one by one; the few points near an edge are compared with it exactly.
"""

from coview_kernels import launch, runtime

ti = runtime.library()
f32, f64, i32 = ti.f32, ti.f64, ti.i32

Floats = ti.types.ndarray(f32, 1)
Doubles = ti.types.ndarray(f64, 1)
Integers = ti.types.ndarray(i32, 1)
SPAN = launch.SPAN
SERIAL = runtime.workers() == 1  # waking the pool costs 50 us even for one thread

BLOCK = 64
FINITE = 3.4028235e38
LOWEST = -FINITE
# offsets of the bins behind the grid's
OUTSIDE, BROKEN, NEAR, BEHIND = 0, 1, 2, 3


@ti.func
def polar(dx: f32, dy: f32, rings: f32, sectors: f32, per_metre: f32):
    """Return range in rings, at most ``rings + 1.5``, to 1e-6 ``rings``; angle in sectors, to 3e-6 ``sectors``."""
    far = ti.sqrt(dx * dx + dy * dy) * per_metre
    far = ti.select(far < rings + 1.5, far, rings + 1.5)
    ax, ay = ti.abs(dx), ti.abs(dy)
    steep = ay > ax
    longer = ti.select(steep, ay, ax)
    t = ti.select(steep, ax, ay) / ti.select(longer > 1e-30, longer, 1e-30)
    s = t * t
    # minimax polynomial of atan(t), to 1.2e-5 rad, in turns
    turn = t * (0.15913367 + s * (-0.05256963 + s * (0.02867322 + s * (-0.01355302 + s * 0.00331759))))
    turn = ti.select(steep, 0.25 - turn, turn)
    turn = ti.select(dx < 0, 0.5 - turn, turn)
    turn = ti.select(dy < 0, 1.0 - turn, turn)
    return far, turn * sectors


@ti.func
def exact_bin(dx: f32, dy: f32, rings: i32, sectors: i32, per_metre: f32, edges: ti.template()) -> i32:
    """Return the bin of an offset, compared with the edges as in reference/polar.py; R S at and beyond ``r_max``.

    ``edges``: the R + 1 squared ring edges, then the S + 1 rays as x, y.
    """
    x, y = ti.cast(dx, f64), ti.cast(dy, f64)
    r2 = x * x + y * y
    b = rings * sectors
    if r2 < edges[rings]:
        # both guesses are off by at most one
        far, angle = polar(dx, dy, ti.cast(rings, f32), ti.cast(sectors, f32), per_metre)
        ring = ti.min(ti.cast(far, i32), rings - 1)
        if r2 < edges[ring]:
            ring -= 1
        elif r2 >= edges[ring + 1]:
            ring += 1
        s = ti.min(ti.cast(angle, i32), sectors - 1)
        ray = rings + 1 + 2 * s
        lx, ly, ux, uy = edges[ray], edges[ray + 1], edges[ray + 2], edges[ray + 3]
        if lx * y < ly * x and lx * x + ly * y > 0:
            s = ti.select(s == 0, sectors - 1, s - 1)
        elif ux * y >= uy * x and ux * x + uy * y > 0:
            s = ti.select(s == sectors - 1, 0, s + 1)
        b = ring * sectors + s
    return b


@ti.func
def add(
    start: i32, n: i32, first: i32, points: ti.template(), rings: i32, sectors: i32,
    params: ti.template(), edges: ti.template(), highest: ti.template(), count: ti.template(), total: ti.template(),
):  # fmt: skip
    """Add ``n`` points, at most BLOCK, to the bins that begin at ``first``; see ``bins``."""
    size = rings * sectors
    cx, cy, cz = params[0], params[1], params[2]
    per_metre = ti.cast(params[3], f32)
    all_rings, all_sectors = ti.cast(rings, f32), ti.cast(sectors, f32)
    # within this distance from the middle of a ring or sector the bin is certain
    sure_ring, sure_sector = 0.5 - 1e-6 * (all_rings + 2.0), 0.5 - 4e-6 * all_sectors
    at, height = ti.Vector.zero(i32, BLOCK), ti.Vector.zero(f32, BLOCK)
    near = 0
    for j in range(n):
        i = 3 * (start + j)
        x, y, z = points[i], points[i + 1], points[i + 2]
        dx = ti.cast(ti.cast(x, f64) - cx, f32)
        dy = ti.cast(ti.cast(y, f64) - cy, f32)
        height[j] = ti.cast(ti.cast(z, f64) - cz, f32)
        far, angle = polar(dx, dy, all_rings, all_sectors, per_metre)
        ring, sector = ti.cast(far, i32), ti.cast(angle, i32)
        off_ring = ti.abs(far - ti.cast(ring, f32) - 0.5)
        off_sector = ti.abs(angle - ti.cast(sector, f32) - 0.5)
        b = ti.min(ring * sectors + sector, size)
        b = ti.select(off_ring > sure_ring, size + NEAR, b)
        b = ti.select(off_sector > sure_sector, size + NEAR, b)
        b = ti.select(far > all_rings + 1.0, size + OUTSIDE, b)
        # false for NaN
        finite = ti.cast(ti.abs(x) <= FINITE, i32) & ti.cast(ti.abs(y) <= FINITE, i32)
        finite &= ti.cast(ti.abs(z) <= FINITE, i32)
        b = ti.select(finite != 0, b, size + BROKEN)
        near += ti.cast(b == size + NEAR, i32)
        at[j] = first + b
    for j in range(n):
        b, h = at[j], height[j]
        top = highest[b]
        highest[b] = ti.select(top > h, top, h)
        count[b] = count[b] + 1  # += would be atomic: a locked instruction, 20 times as slow
        total[b] = total[b] + h
    if near > 0:
        for j in range(n):
            if at[j] == first + size + NEAR:
                i = 3 * (start + j)
                dx = ti.cast(ti.cast(points[i], f64) - cx, f32)
                dy = ti.cast(ti.cast(points[i + 1], f64) - cy, f32)
                b = first + exact_bin(dx, dy, rings, sectors, per_metre, edges)
                highest[b] = ti.max(highest[b], height[j])
                count[b] = count[b] + 1
                total[b] = total[b] + height[j]


@runtime.kernel
def bins(
    points: Floats, rows: i32, chunks: i32, rings: i32, sectors: i32,
    params: Doubles, edges: Doubles, highest: Floats, count: Integers, total: Doubles,
):  # fmt: skip
    """Add ``rows`` points to the bins of their chunks: greatest height, number, and sum of the heights.

    A chunk has R S bins and three more: points beyond ``r_max``, points that are not finite, points near an edge.
    ``params``: centre x, y, z, rings per metre. All arrays are flat, as an index into more axes costs a read of the
    shape and a product each time.
    """
    ti.loop_config(serialize=SERIAL)
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (rows + chunks - 1) // chunks
            begin, end = ti.min(rows, c * step), ti.min(rows, (c + 1) * step)
            first = c * (rings * sectors + BEHIND)
            for block in range((end - begin + BLOCK - 1) // BLOCK):
                start = begin + block * BLOCK
                n = ti.min(BLOCK, end - start)
                add(start, n, first, points, rings, sectors, params, edges, highest, count, total)


@runtime.kernel
def station_bins(
    stations: i32, chunks: i32, size: i32, top: Floats, points: Integers, base: Integers, ground: Floats,
    starts: Integers, offsets: Integers, highest: Floats, count: Integers,
):  # fmt: skip
    """Gather into bin b of a station the cells ``base + offsets[starts[b]:starts[b + 1]]`` of the padded raster.

    The cells are sorted by bin, so that a bin is summed in registers and stored once.
    """
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (stations + chunks - 1) // chunks
            for m in range(ti.min(stations, c * step), ti.min(stations, (c + 1) * step)):
                floor = ti.cast(ground[m], f64)
                at_station = base[m]
                for b in range(size):
                    best = ti.cast(LOWEST, f32)
                    number = 0
                    for k in range(starts[b], starts[b + 1]):
                        at = at_station + offsets[k]
                        best = ti.max(best, top[at])
                        number += points[at]
                    if number > 0:
                        highest[m * size + b] = ti.cast(ti.cast(best, f64) - floor, f32)
                        count[m * size + b] = number


@runtime.kernel
def station_means(
    stations: i32, chunks: i32, size: i32, total: Doubles, base: Integers, ground: Floats,
    starts: Integers, offsets: Integers, count: Integers, mean: Floats,
):  # fmt: skip
    """Write mean heights of the bins that ``station_bins`` counted; ``total``: sum of heights in each padded cell."""
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (stations + chunks - 1) // chunks
            for m in range(ti.min(stations, c * step), ti.min(stations, (c + 1) * step)):
                for b in range(size):
                    if count[m * size + b] > 0:
                        heights = ti.cast(0.0, f64)
                        for k in range(starts[b], starts[b + 1]):
                            heights += total[base[m] + offsets[k]]
                        mean[m * size + b] = ti.cast(heights / count[m * size + b] - ti.cast(ground[m], f64), f32)
