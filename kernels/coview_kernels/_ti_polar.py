# mypy: ignore-errors
"""Taichi source of polar.py. Every chunk of points has bins of its own: atomics on shared ones are slower."""

from coview_kernels import launch, runtime, sectors

ti = runtime.library()

Floats = ti.types.ndarray(ti.f32, 1)
Doubles = ti.types.ndarray(ti.f64, 1)
Integers = ti.types.ndarray(ti.i32, 1)
Shorts = ti.types.ndarray(ti.i16, 1)
SPAN = launch.SPAN
covisible = runtime.kernels("covisibility").covisible

HALF = sectors.HALF
LOWEST = -3.4028235e38


@ti.func
def bin_of(
    dx: ti.f32,
    dy: ti.f32,
    rings: ti.i32,
    sectors: ti.i32,
    params: ti.template(),
    edges: ti.template(),
    guesses: ti.template(),
) -> ti.i32:
    """Bin of an offset by comparing it with the edges as in sectors.py; R S at and beyond ``r_max``.

    ``edges``: the R + 1 squared ring edges, then the S + 1 rays as x, y.
    """
    x = ti.cast(dx, ti.f64)
    y = ti.cast(dy, ti.f64)
    r2 = x * x + y * y
    b = rings * sectors
    if r2 < edges[rings]:
        # both guesses are off by one at most
        ring = ti.cast(ti.sqrt(ti.cast(r2, ti.f32)) * ti.cast(params[3], ti.f32), ti.i32)
        ring = ti.min(ring, rings - 1)
        if r2 < edges[ring]:
            ring -= 1
        elif r2 >= edges[ring + 1]:
            ring += 1
        ax = ti.abs(dx)
        ay = ti.abs(dy)
        octant = ti.cast(ay > ax, ti.i32) + 2 * ti.cast(dx < 0, ti.i32) + 4 * ti.cast(dy < 0, ti.i32)
        ratio = ti.min(ax, ay) / ti.max(ti.max(ax, ay), 1e-30)
        steps = ti.cast(params[4], ti.i32)
        s = guesses[octant * (steps + 1) + ti.cast(ratio * steps, ti.i32)]
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
    return b


@ti.func
def add_point(
    px: ti.f64,
    py: ti.f64,
    pz: ti.f64,
    first: ti.i32,
    rings: ti.i32,
    sectors: ti.i32,
    params: ti.template(),
    edges: ti.template(),
    guesses: ti.template(),
    cells: ti.template(),
    bins: ti.template(),
):
    """Add a point to the chunk's bins, which begin at ``first``: greatest height, sum of heights, count.

    ``params``: centre x, y, z, rings per metre, steps of the guesses, cells per metre, r_max. Five points of six
    lie in a cell that no edge crosses. Bin R S is for what the circle leaves of the square.
    """
    dx = ti.cast(px - params[0], ti.f32)
    dy = ti.cast(py - params[1], ti.f32)
    if ti.cast(ti.max(ti.abs(dx), ti.abs(dy)), ti.f64) < params[6]:
        scale = ti.cast(params[5], ti.f32)
        column = ti.min(ti.cast(dx * scale + float(HALF), ti.i32), 2 * HALF - 1)
        row = ti.min(ti.cast(dy * scale + float(HALF), ti.i32), 2 * HALF - 1)
        b = ti.cast(cells[row * (2 * HALF) + column], ti.i32)
        if b < 0:
            b = bin_of(dx, dy, rings, sectors, params, edges, guesses)
        at = first + 3 * b
        h = ti.cast(ti.cast(pz - params[2], ti.f32), ti.f64)
        bins[at] = ti.max(bins[at], h)
        bins[at + 1] = bins[at + 1] + h  # += would be atomic: a locked instruction, 20 times as slow
        bins[at + 2] = bins[at + 2] + 1.0


@ti.func
def clear_bins(first: ti.i32, size: ti.i32, bins: ti.template()):
    """Empty a chunk's bins."""
    for b in range(size):
        bins[first + 3 * b] = LOWEST
        bins[first + 3 * b + 1] = 0.0
        bins[first + 3 * b + 2] = 0.0


@ti.func
def merge_bins(
    chunks: ti.i32,
    size: ti.i32,
    bins: ti.template(),
    highest: ti.template(),
    total: ti.template(),
    count: ti.template(),
):
    """Join the chunks' bins."""
    for b in range(size):
        top = bins[3 * b]
        height = bins[3 * b + 1]
        number = bins[3 * b + 2]
        for c in range(1, chunks):
            other = 3 * (c * (size + 1) + b)
            top = ti.max(top, bins[other])
            height += bins[other + 1]
            number += bins[other + 2]
        highest[b] = ti.select(number > 0, ti.cast(top, ti.f32), ti.cast(0.0, ti.f32))
        total[b] = ti.cast(height, ti.f32)
        count[b] = ti.cast(number, ti.i32)


@ti.kernel
def describe(
    points: Floats,
    rows: ti.i32,
    chunks: ti.i32,
    rings: ti.i32,
    sectors: ti.i32,
    params: Doubles,
    edges: Doubles,
    guesses: Integers,
    cells: Shorts,
    bins: Doubles,
    dropped: Integers,
    highest: Floats,
    total: Floats,
    count: Integers,
    value: Floats,
):
    """Polar bins of ``rows`` points and what is co-visible.

    ``params`` goes on with vertical, hide, scale and eye of :func:`covisible`; hide < 0: leave ``value`` alone.
    All arrays are flat: an index into more axes costs a read of the shape and a product each time.
    """
    size = rings * sectors
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (rows + chunks - 1) // chunks
            first = 3 * c * (size + 1)
            clear_bins(first, size + 1, bins)
            bad = 0
            for i in range(ti.min(rows, c * step), ti.min(rows, (c + 1) * step)):
                x = ti.cast(points[3 * i], ti.f64)
                y = ti.cast(points[3 * i + 1], ti.f64)
                z = ti.cast(points[3 * i + 2], ti.f64)
                # NaN and inf stay in the sum, whose bits show them; three float32 do not overflow a float64
                if ((ti.bit_cast(x + y + z, ti.i64) >> 52) & 0x7FF) == 0x7FF:
                    bad += 1
                else:
                    add_point(x, y, z, first, rings, sectors, params, edges, guesses, cells, bins)
            dropped[c] = bad

    ti.loop_config(serialize=True)
    for _ in range(1):
        merge_bins(chunks, size, bins, highest, total, count)
        vertical = ti.cast(params[7], ti.i32)
        hide = ti.cast(params[8], ti.i32)
        scale = ti.cast(params[9], ti.i32)
        if hide >= 0:
            covisible(0, rings, sectors, vertical, hide, scale, params[10], highest, total, count, value)


@ti.kernel
def station_bins(
    stations: ti.i32,
    chunks: ti.i32,
    size: ti.i32,
    top: Floats,
    points: Integers,
    heights: Floats,
    base: Integers,
    ground: Floats,
    starts: Integers,
    offsets: Integers,
    highest: Floats,
    total: Floats,
    count: Integers,
):
    """Bin b of a station gathers the cells ``base + offsets[starts[b]:starts[b + 1]]`` of the padded raster.

    The cells are sorted by bin, so a bin is summed in registers and stored once.
    """
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (stations + chunks - 1) // chunks
            for m in range(ti.min(stations, c * step), ti.min(stations, (c + 1) * step)):
                floor = ti.cast(ground[m], ti.f64)
                at_station = base[m]
                for b in range(size):
                    best = ti.cast(LOWEST, ti.f32)
                    number = 0
                    height = ti.cast(0.0, ti.f64)
                    for k in range(starts[b], starts[b + 1]):
                        at = at_station + offsets[k]
                        best = ti.max(best, top[at])
                        number += points[at]
                        height += ti.cast(heights[at], ti.f64)
                    if number > 0:
                        highest[m * size + b] = ti.cast(ti.cast(best, ti.f64) - floor, ti.f32)
                        total[m * size + b] = ti.cast(height - number * floor, ti.f32)
                        count[m * size + b] = number
