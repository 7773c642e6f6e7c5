# mypy: ignore-errors
"""Taichi source of polar.py. Every chunk of points has bins of its own: atomics on shared ones are slower."""

from coview_kernels import runtime

ti = runtime.library()

LOWEST = -3.4028235e38


@ti.kernel
def polar_bin(
    points: ti.types.ndarray(ti.f32, 2),
    cx: ti.f64,
    cy: ti.f64,
    cz: ti.f64,
    rings: ti.i32,
    sectors: ti.i32,
    per_metre: ti.f32,
    edges: ti.types.ndarray(ti.f64, 1),
    guesses: ti.types.ndarray(ti.i32, 2),
    bins: ti.types.ndarray(ti.f64, 3),
):
    """Leave in bins, by chunk and bin: greatest height, sum of heights, count; in its last row the dropped.

    ``edges``: the R + 1 squared ring edges, then the S + 1 rays as x, y. Few and packed arrays: passing one
    costs 10 us, as much as 600 points.
    """
    chunks = bins.shape[0]
    steps = guesses.shape[1] - 1
    r2_max = edges[rings]
    n = points.shape[0]
    step = (n + chunks - 1) // chunks
    ti.loop_config(block_dim=1)
    for c in range(chunks):
        for b in range(rings * sectors):
            bins[c, b, 0] = LOWEST
        bad = 0
        for i in range(ti.min(n, c * step), ti.min(n, (c + 1) * step)):
            px = ti.cast(points[i, 0], ti.f64)
            py = ti.cast(points[i, 1], ti.f64)
            pz = ti.cast(points[i, 2], ti.f64)
            # NaN and inf stay in the sum, whose bits show them; three float32 do not overflow a float64
            if ((ti.bit_cast(px + py + pz, ti.i64) >> 52) & 0x7FF) == 0x7FF:
                bad += 1
                continue
            dx = ti.cast(px - cx, ti.f32)
            dy = ti.cast(py - cy, ti.f32)
            x = ti.cast(dx, ti.f64)
            y = ti.cast(dy, ti.f64)
            r2 = x * x + y * y
            if r2 >= r2_max:
                continue
            # both guesses are off by one at most; comparing with the edges, as in sectors.py, sets them right
            ring = ti.min(ti.cast(ti.sqrt(ti.cast(r2, ti.f32)) * per_metre, ti.i32), rings - 1)
            if r2 < edges[ring]:
                ring -= 1
            elif r2 >= edges[ring + 1]:
                ring += 1
            ax = ti.abs(dx)
            ay = ti.abs(dy)
            octant = ti.cast(ay > ax, ti.i32) + 2 * ti.cast(dx < 0, ti.i32) + 4 * ti.cast(dy < 0, ti.i32)
            ratio = ti.min(ax, ay) / ti.max(ti.max(ax, ay), 1e-30)
            s = guesses[octant, ti.cast(ratio * steps, ti.i32)]
            ray = rings + 1 + 2 * s
            lx = edges[ray]
            ly = edges[ray + 1]
            ux = edges[ray + 2]
            uy = edges[ray + 3]
            if lx * y < ly * x and lx * x + ly * y > 0:
                s = ti.select(s == 0, sectors - 1, s - 1)
            elif ux * y >= uy * x and ux * x + uy * y > 0:
                s = ti.select(s == sectors - 1, 0, s + 1)
            b = ring * sectors + s
            h = ti.cast(ti.cast(pz - cz, ti.f32), ti.f64)
            bins[c, b, 0] = ti.max(bins[c, b, 0], h)
            bins[c, b, 1] += h
            bins[c, b, 2] += 1.0
        bins[c, rings * sectors, 0] = ti.cast(bad, ti.f64)


@ti.kernel
def station_bins(
    top: ti.types.ndarray(ti.f32, 1),
    points: ti.types.ndarray(ti.i32, 1),
    heights: ti.types.ndarray(ti.f32, 1),
    base: ti.types.ndarray(ti.i32, 1),
    ground: ti.types.ndarray(ti.f32, 1),
    starts: ti.types.ndarray(ti.i32, 1),
    offsets: ti.types.ndarray(ti.i32, 1),
    highest: ti.types.ndarray(ti.f32, 2),
    total: ti.types.ndarray(ti.f32, 2),
    count: ti.types.ndarray(ti.i32, 2),
):
    """Bin b of a station gathers the cells ``base + offsets[starts[b]:starts[b + 1]]`` of the padded raster.

    The cells are sorted by bin, so a bin is summed in registers and stored once.
    """
    for m in range(base.shape[0]):
        floor = ti.cast(ground[m], ti.f64)
        for b in range(highest.shape[1]):
            best = ti.cast(LOWEST, ti.f32)
            number = 0
            height = ti.cast(0.0, ti.f64)
            for k in range(starts[b], starts[b + 1]):
                at = base[m] + offsets[k]
                best = ti.max(best, top[at])
                number += points[at]
                height += ti.cast(heights[at], ti.f64)
            if number > 0:
                highest[m, b] = ti.cast(ti.cast(best, ti.f64) - floor, ti.f32)
                total[m, b] = ti.cast(height - number * floor, ti.f32)
                count[m, b] = number
