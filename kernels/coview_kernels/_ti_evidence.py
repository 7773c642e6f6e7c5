# mypy: ignore-errors
"""Taichi source of evidence.py: one pass over the scan, one over the map, one over a frame; each on one thread.

A pass takes less than waking the threads is worth, and serves that wait for each other would wait for it.
"""

from coview_kernels import runtime
from coview_kernels._ti_nearest import SLACK, cell_of, gap, walk

ti = runtime.library()
f32, f64, i32 = ti.f32, ti.f64, ti.i32

Floats = ti.types.ndarray(f32, 1)
Doubles = ti.types.ndarray(f64, 1)
Integers = ti.types.ndarray(i32, 1)
Bytes = ti.types.ndarray(ti.u8, 1)

HIGH, LOW = 1, 2  # kinds of points
# settings of match: the pose by rows (12), the grid's frame (8), then these, and two rasters
REACH, SEARCH, OFF, RISE, WALLS, SURVEY = 20, 21, 22, 23, 24, 31
# a raster: corner (2), edge of the cells, numbers of cells (2), steps from a cell to the next (2)
EDGE, COUNT, STEP = 2, 3, 5
# settings of free_space: T_body_map by rows (12), then these
PLACE, LOWEST, FARTHEST, NEAREST, SLACK_AT, SLOPE, BEAM = 12, 15, 16, 17, 18, 19, 20
BLOCK = 64
PI = 3.141592653589793


@ti.func
def moved(settings: ti.template(), x, y, z):
    return ti.Vector([
        settings[4 * d] * x + settings[4 * d + 1] * y + settings[4 * d + 2] * z + settings[4 * d + 3]
        for d in ti.static(range(3))
    ])  # fmt: skip


@ti.func
def raster_cell(settings: ti.template(), first: ti.template(), x, y) -> i32:
    """Place of the cell in the raster's memory, -1 outside."""
    edge = settings[first + EDGE]
    i, j = ti.floor((x - settings[first]) / edge), ti.floor((y - settings[first + 1]) / edge)
    cell = -1
    if i >= 0 and j >= 0 and i < settings[first + COUNT] and j < settings[first + COUNT + 1]:
        cell = ti.cast(i * settings[first + STEP] + j * settings[first + STEP + 1], i32)
    return cell


@ti.func
def any_within(frame: ti.template(), starts: ti.template(), rows: ti.template(), x, y, z, reach) -> i32:
    """Tell whether the cloud has a point nearer than ``reach``; the point's own column is asked first."""
    size, per_metre = frame[3], frame[4]
    nx, ny, nz = ti.cast(frame[5], i32), ti.cast(frame[6], i32), ti.cast(frame[7], i32)
    u, v, w = x - frame[0], y - frame[1], z - frame[2]
    low = cell_of((w - reach - SLACK) * per_metre, nz)
    high = cell_of((w + reach + SLACK) * per_metre, nz) + 1
    ix, iy = cell_of(u * per_metre, nx), cell_of(v * per_metre, ny)
    first, last = cell_of((u - reach - SLACK) * per_metre, nx), cell_of((u + reach + SLACK) * per_metre, nx)
    begin_y, end_y = cell_of((v - reach - SLACK) * per_metre, ny), cell_of((v + reach + SLACK) * per_metre, ny)
    wide, limit = last - first + 1, reach * reach
    columns = wide * (end_y - begin_y + 1)
    found, k = 0, -1
    while found == 0 and k < columns:
        i, j = ix, iy
        if k >= 0:
            i, j = first + k % wide, begin_y + k // wide
        across = gap(ix, i, u, size)
        along = gap(iy, j, v, size)
        if across * across + along * along < limit and (k < 0 or i != ix or j != iy):
            column = (i * ny + j) * nz
            p, end = starts[column + low], starts[column + high]
            while p < end:
                ex = x - ti.cast(ti.bit_cast(rows[4 * p], f32), f64)
                ey = y - ti.cast(ti.bit_cast(rows[4 * p + 1], f32), f64)
                ez = z - ti.cast(ti.bit_cast(rows[4 * p + 2], f32), f64)
                p += 1
                if ex * ex + ey * ey + ez * ez < limit:
                    found, p = 1, end
        k += 1
    return found


@ti.kernel
def match(
    settings: Doubles,
    starts: Integers,
    rows: Integers,
    normals: Floats,
    walls: Floats,
    survey: Bytes,
    points: Floats,
    kinds: Bytes,
    counts: Integers,
):
    """Count of the points: surveyed, high, high and near, high and covered, low, low and on the map's ground."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        frame = ti.Vector([settings[12 + k] for k in ti.static(range(8))])
        reach, search = settings[REACH], settings[SEARCH]
        surveyed, high, near, covered, low, grounded = 0, 0, 0, 0, 0, 0
        for n in range(kinds.shape[0]):
            at = moved(settings, ti.cast(points[3 * n], f64), ti.cast(points[3 * n + 1], f64),
                       ti.cast(points[3 * n + 2], f64))  # fmt: skip
            cell = raster_cell(settings, SURVEY, at[0], at[1])
            if cell >= 0 and survey[ti.max(cell, 0)] > 0:
                kind = ti.cast(kinds[n], i32)
                surveyed += 1
                if kind == HIGH:
                    high += 1
                    if any_within(frame, starts, rows, at[0], at[1], at[2], reach) > 0:
                        near += 1
                        covered += 1
                    else:
                        under = raster_cell(settings, WALLS, at[0], at[1])
                        if under >= 0 and walls[ti.max(under, 0)] > at[2] - settings[RISE]:
                            covered += 1
                elif kind == LOW:
                    low += 1
                    _best, row, _beyond = walk(frame, starts, rows, at[0], at[1], at[2], search * search, 0.0)
                    if row >= 0:
                        normal = 3 * rows[4 * row + 3]
                        off, length = ti.cast(0.0, f64), ti.cast(0.0, f64)
                        for d in ti.static(range(3)):
                            off += (at[d] - ti.cast(ti.bit_cast(rows[4 * row + d], f32), f64)) * normals[normal + d]
                            length += ti.cast(normals[normal + d], f64) * normals[normal + d]
                        grounded += ti.cast(ti.abs(off) < settings[OFF] * ti.sqrt(length), i32)
        counts[0], counts[1], counts[2] = surveyed, high, near
        counts[3], counts[4], counts[5] = covered, low, grounded


@ti.func
def arctan(y, x) -> f32:
    """Angle of a direction from the first axis, in [-pi, pi], to 1e-6."""
    ax, ay = ti.abs(x), ti.abs(y)
    steep = ay > ax
    t = ti.select(steep, ax, ay) / ti.max(ti.select(steep, ay, ax), 1e-30)
    s = t * t
    # minimax polynomial of atan(t), to 3e-7
    angle = t * (0.999996112 + s * (-0.33317368 + s * (0.198078154 + s * (-0.132333416 + s * (
        0.0796236637 + s * (-0.0336042135 + s * 0.00681179107))))))  # fmt: skip
    angle = ti.select(steep, ti.cast(0.5 * PI, f32) - angle, angle)
    angle = ti.select(x < 0, ti.cast(PI, f32) - angle, angle)
    return ti.select(y < 0, -angle, angle)


@ti.func
def beam_of(x: f32, y: f32, z: f32, per_radian: f32, columns: i32) -> i32:
    """Cell of a direction: row by row upwards, turning left from straight behind."""
    turn = arctan(y, x) + ti.cast(PI, f32)
    rise = arctan(z, ti.sqrt(x * x + y * y)) + ti.cast(0.5 * PI, f32)
    # neither is below zero but by rounding, which truncation takes to zero
    return ti.cast(rise * per_radian, i32) * columns + ti.cast(turn * per_radian, i32)


@ti.kernel
def beams(
    points: Floats, every: i32, least: f32, per_radian: f32, columns: i32,
    nearest: Floats, farthest: Floats, hits: Integers,
):  # fmt: skip
    """Add every so-many-th point to its cell, if it is farther than ``least``; by blocks, as the bins of polar.py."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        ranges, cells = ti.Vector.zero(f32, BLOCK), ti.Vector.zero(i32, BLOCK)
        rows = (points.shape[0] // 3 + every - 1) // every
        for block in range((rows + BLOCK - 1) // BLOCK):
            n = ti.min(BLOCK, rows - block * BLOCK)
            for j in range(n):
                i = 3 * (block * BLOCK + j) * every
                x, y, z = points[i], points[i + 1], points[i + 2]
                ranges[j] = ti.sqrt(x * x + y * y + z * z)
                cells[j] = beam_of(x, y, z, per_radian, columns)
            for j in range(n):
                far, cell = ranges[j], cells[j]
                if far > least:
                    nearest[cell] = ti.min(nearest[cell], far)
                    farthest[cell] = ti.max(farthest[cell], far)
                    hits[cell] = hits[cell] + 1


@ti.kernel
def free_space(settings: Doubles, points: Floats, every: i32, columns: i32, limits: Floats, counts: Integers):
    """Count of every so-many-th map point those that rays met and those that they passed through.

    ``limits``: of each cell the nearest return, then of each the farthest; below any range where nothing counts.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        x0, y0 = settings[PLACE], settings[PLACE + 1]
        farthest, lowest, per_radian = settings[FARTHEST], settings[LOWEST], ti.cast(settings[BEAM], f32)
        cells = limits.shape[0] // 2
        met, passed = 0, 0
        rows = points.shape[0] // 3
        for k in range((rows + every - 1) // every):
            i = 3 * k * every
            x, y, z = ti.cast(points[i], f64), ti.cast(points[i + 1], f64), ti.cast(points[i + 2], f64)
            if (x - x0) * (x - x0) + (y - y0) * (y - y0) < farthest * farthest and z > lowest:
                at = moved(settings, x, y, z)
                far = at.norm()
                if far > settings[NEAREST]:
                    slack = settings[SLACK_AT] + settings[SLOPE] * far
                    cell = beam_of(
                        ti.cast(at[0], f32), ti.cast(at[1], f32), ti.cast(at[2], f32), per_radian, columns
                    )  # fmt: skip
                    if far < limits[cell] - slack:
                        passed += 1
                    elif far <= limits[cells + cell] + slack:
                        met += 1
        counts[0], counts[1] = met, passed
