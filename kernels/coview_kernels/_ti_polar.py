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
    edge2: ti.types.ndarray(ti.f64, 1),
    rays: ti.types.ndarray(ti.f64, 2),
    guesses: ti.types.ndarray(ti.i32, 2),
    per_metre: ti.f32,
    highest: ti.types.ndarray(ti.f32, 2),
    total: ti.types.ndarray(ti.f64, 2),
    count: ti.types.ndarray(ti.i32, 2),
    dropped: ti.types.ndarray(ti.i32, 1),
):
    """Row c of the outputs belongs to chunk c of the points."""
    rings = edge2.shape[0] - 1
    sectors = rays.shape[0] - 1
    chunks = highest.shape[0]
    steps = guesses.shape[1] - 1
    n = points.shape[0]
    step = (n + chunks - 1) // chunks
    ti.loop_config(block_dim=1)
    for c in range(chunks):
        for b in range(highest.shape[1]):
            highest[c, b] = LOWEST
        bad = 0
        for i in range(ti.min(n, c * step), ti.min(n, (c + 1) * step)):
            px = points[i, 0]
            py = points[i, 1]
            pz = points[i, 2]
            all_three = ti.bit_cast(ti.cast(px, ti.f64) + ti.cast(py, ti.f64) + ti.cast(pz, ti.f64), ti.i64)
            if ((all_three >> 52) & 0x7FF) == 0x7FF:
                bad += 1
                continue
            x = ti.cast(ti.cast(ti.cast(px, ti.f64) - cx, ti.f32), ti.f64)
            y = ti.cast(ti.cast(ti.cast(py, ti.f64) - cy, ti.f32), ti.f64)
            r2 = x * x + y * y
            if r2 >= edge2[rings]:
                continue
            # both guesses are off by one at most; comparing with the edges, as sectors.py says, sets them
            # right
            ring = ti.min(ti.cast(ti.sqrt(ti.cast(r2, ti.f32)) * per_metre, ti.i32), rings - 1)
            if r2 < edge2[ring]:
                ring -= 1
            elif r2 >= edge2[ring + 1]:
                ring += 1
            ax = ti.abs(ti.cast(x, ti.f32))
            ay = ti.abs(ti.cast(y, ti.f32))
            octant = ti.cast(ay > ax, ti.i32) + 2 * ti.cast(x < 0, ti.i32) + 4 * ti.cast(y < 0, ti.i32)
            ratio = ti.min(ax, ay) / ti.max(ti.max(ax, ay), 1e-30)
            s = guesses[octant, ti.cast(ratio * steps, ti.i32)]
            lx = rays[s, 0]
            ly = rays[s, 1]
            ux = rays[s + 1, 0]
            uy = rays[s + 1, 1]
            if lx * y < ly * x and lx * x + ly * y > 0:
                s -= 1
                if s < 0:
                    s += sectors
            elif ux * y >= uy * x and ux * x + uy * y > 0:
                s += 1
                if s == sectors:
                    s = 0
            b = ring * sectors + s
            h = ti.cast(ti.cast(pz, ti.f64) - cz, ti.f32)
            highest[c, b] = ti.max(highest[c, b], h)
            total[c, b] += ti.cast(h, ti.f64)
            count[c, b] += 1
        dropped[c] = bad


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
