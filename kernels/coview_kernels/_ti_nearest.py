# mypy: ignore-errors
"""Taichi source of nearest.py: a query walks rings of columns around its own until none can hold a nearer point."""

from coview_kernels import runtime

ti = runtime.library()

WHOLES = ti.types.ndarray(ti.i32, 1)  # rows are flat, four numbers each, so that an index does not read the shape
DOUBLES = ti.types.ndarray(ti.f64, 1)
POINTS, MATRIX = ti.types.ndarray(ti.f32, 2), ti.types.ndarray(ti.f64, 2)

SLACK = 1e-9  # metres, and share of the distance: more than rounding moves a face between two cells
FAR = 1e18  # metres: no face


@ti.func
def short_of(d) -> ti.f64:
    """Shorten a distance to a face of a cell by the possible rounding error."""
    return ti.max(d - SLACK - SLACK * ti.abs(d), ti.cast(0.0, ti.f64))


@ti.func
def gap(i, j, u, size) -> ti.f64:
    """Distance from ``u``, which lies in cell ``i``, to the near face of cell ``j``."""
    d = ti.cast(0.0, ti.f64)
    if j > i:
        d = short_of(j * size - u)
    elif j < i:
        d = short_of(u - (j + 1) * size)
    return d


@ti.func
def cell_of(cells, count) -> ti.i32:
    """Index of an offset given in cells; clamped as float, since far ones overflow an integer."""
    return ti.cast(ti.min(ti.max(cells, ti.cast(0, ti.f64)), ti.cast(count - 1, ti.f64)), ti.i32)


@ti.func
def walk(frame: ti.template(), starts: ti.template(), rows: ti.template(), x, y, z, limit, margin):
    """Find the nearest point within the square root of ``limit``.

    Returns its squared distance, its row (-1 if there is none), and a lower bound of the squared distance of all other
    points: the least of the second nearest's, ``limit``, and the square of the nearest's distance plus ``margin``.
    """
    size, per_metre = frame[3], frame[4]
    nx, ny, nz = ti.cast(frame[5], ti.i32), ti.cast(frame[6], ti.i32), ti.cast(frame[7], ti.i32)
    best = limit
    beyond = limit
    found = -1
    ring = 0
    # finds NaN and inf by their bits, as a host program may have told the compiler that there are no NaNs
    if ((ti.bit_cast(x + y + z, ti.i64) >> 52) & 0x7FF) == 0x7FF:
        ring = -1
    # offsets from the corner are only for cells; distances must round like the twin's
    u = x - frame[0]
    v = y - frame[1]
    w = z - frame[2]
    ix = cell_of(u * per_metre, nx)
    iy = cell_of(v * per_metre, ny)
    while ring >= 0:
        for i in range(ti.max(ix - ring, 0), ti.min(ix + ring, nx - 1) + 1):
            dx = gap(ix, i, u, size)
            j = iy - ring
            if dx * dx >= beyond:
                j = iy + ring + 1
            while j <= iy + ring:
                dy = gap(iy, j, v, size)
                left = beyond - dx * dx - dy * dy
                if j >= 0 and j < ny and left > 0:
                    dz = ti.sqrt(left) + SLACK
                    column = (i * ny + j) * nz
                    begin = starts[column + cell_of((w - dz) * per_metre, nz)]
                    end = starts[column + cell_of((w + dz) * per_metre, nz) + 1]
                    for p in range(begin, end):
                        ex = x - ti.cast(ti.bit_cast(rows[4 * p], ti.f32), ti.f64)
                        ey = y - ti.cast(ti.bit_cast(rows[4 * p + 1], ti.f32), ti.f64)
                        ez = z - ti.cast(ti.bit_cast(rows[4 * p + 2], ti.f32), ti.f64)
                        d2 = ex * ex + ey * ey + ez * ez
                        if d2 < best:
                            # without a margin the nearest bounds the search exactly
                            if margin > 0:
                                far = ti.sqrt(d2) + margin
                                beyond = ti.min(beyond, ti.min(best, far * far))
                            else:
                                beyond = d2
                            best = d2
                            found = p
                        elif d2 < beyond:
                            beyond = d2
                # the ring has every column of its first and last row, but only the ends of the others
                j += 1 if ti.abs(i - ix) == ring else 2 * ring
        # the nearest face of the columns outside the ring, on sides that have any
        reach = ti.cast(FAR, ti.f64)
        if ix > ring:
            reach = ti.min(reach, u - (ix - ring) * size)
        if ix + ring < nx - 1:
            reach = ti.min(reach, (ix + ring + 1) * size - u)
        if iy > ring:
            reach = ti.min(reach, v - (iy - ring) * size)
        if iy + ring < ny - 1:
            reach = ti.min(reach, (iy + ring + 1) * size - v)
        reach = short_of(reach)
        ring += 1
        if reach * reach >= beyond:
            ring = -1
    return best, found, beyond


@runtime.kernel
def nearest(frame: DOUBLES, starts: WHOLES, rows: WHOLES, queries: POINTS, T: MATRIX, radius: ti.f64, answer: MATRIX):
    """Write distances and indices, the rows of ``answer``, for queries with a point within ``radius``.

    ``frame``: the corner (3), edge, reciprocal edge and numbers (3) of the cells. Columns on the border extend to
    infinity. On one thread: most calls have some hundred queries, which take less time than waking another thread.
    """
    ti.loop_config(serialize=True)
    for n in range(queries.shape[0]):
        cells = ti.Vector([frame[k] for k in ti.static(range(8))])
        a = ti.cast(queries[n, 0], ti.f64)
        b = ti.cast(queries[n, 1], ti.f64)
        c = ti.cast(queries[n, 2], ti.f64)
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        best, found, _ = walk(cells, starts, rows, x, y, z, radius * radius, 0.0)
        if found >= 0:
            answer[0, n] = ti.sqrt(best)
            answer[1, n] = rows[4 * found + 3]


@runtime.kernel
def sort(points: POINTS, frame: DOUBLES, cell: WHOLES, starts: WHOLES, rows: WHOLES):
    """Sort the points by cell into ``rows`` with a counting sort; ``starts`` is zeros at first, one more than cells."""
    for n in range(points.shape[0]):
        nx, ny, nz = ti.cast(frame[5], ti.i32), ti.cast(frame[6], ti.i32), ti.cast(frame[7], ti.i32)
        i = cell_of((ti.cast(points[n, 0], ti.f64) - frame[0]) * frame[4], nx)
        j = cell_of((ti.cast(points[n, 1], ti.f64) - frame[1]) * frame[4], ny)
        k = cell_of((ti.cast(points[n, 2], ti.f64) - frame[2]) * frame[4], nz)
        cell[n] = (i * ny + j) * nz + k

    ti.loop_config(serialize=True)
    for _ in range(1):
        for n in range(points.shape[0]):
            starts[cell[n]] = starts[cell[n]] + 1
        end = 0
        for c in range(starts.shape[0]):
            end += starts[c]
            starts[c] = end
        # backwards, so that points of a cell keep their order; each start ends at the beginning of its cell
        for m in range(points.shape[0]):
            n = points.shape[0] - 1 - m
            place = starts[cell[n]] - 1
            starts[cell[n]] = place
            for d in ti.static(range(3)):
                rows[4 * place + d] = ti.bit_cast(points[n, d], ti.i32)
            rows[4 * place + 3] = n
