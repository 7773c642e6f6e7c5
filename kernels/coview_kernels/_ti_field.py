# mypy: ignore-errors
"""Taichi source of field.py: a hypothesis after another on each thread, all of its levels in one go.

The coarse level is the one that vectorises: the shifts of a point by whole metres are neighbouring words of the
raster, whose bits are added to a local vector.
"""

from coview_kernels import runtime
from coview_kernels.launch import SPAN
from coview_kernels.reference.field import (
    EDGE_STEP,
    NOT_SURVEYED,
    ON_GROUND,
    REACH,
    TURN,
    TURNS,
    UNDER_EDGE,
    UPPER_FLOOR,
)

ti = runtime.library()

FLOATS = ti.types.ndarray(ti.f32, 1)
DOUBLES = ti.types.ndarray(ti.f64, 1)
WHOLES = ti.types.ndarray(ti.i32, 1)
BITS = ti.types.ndarray(ti.i64, 1)

WINDOW, LANES = 2 * REACH + 1, 8  # coarse shifts a side, and the same in whole registers
CENTIMETRE = 0.01


@ti.func
def cell_at(table: ti.template(), down, across, x, y):
    """Return the place in the layers of the cell that holds (x, y), in the empty tile where there is none."""
    i = ti.min(ti.max(ti.cast(ti.floor(2.0 * y), ti.i32), 0), 32 * down - 1)
    j = ti.min(ti.max(ti.cast(ti.floor(2.0 * x), ti.i32), 0), 32 * across - 1)
    tile = table[(i >> 5) * across + (j >> 5)]
    return (tile << 10) + ((i & 31) << 5) + (j & 31)


@ti.func
def ground_of(packed) -> ti.i32:
    """Return the ground's height, in the lower half of a word of the surface, with its sign."""
    return (packed << 16) >> 16


@ti.func
def bit(word, z):
    """Return the bit of height ``z`` in half metres."""
    return ti.cast((word >> (ti.cast(ti.floor(2.0 * z), ti.i64) & 63)) & 1, ti.i32)


@ti.func
def coarse_best(coarse: ti.template(), high, wide, structure: ti.template(), count, x, y, z, yaw):
    """Return the shift and the turn, in steps, at which most points are near structure; small ones first."""
    best, at, turn = -1, 0, 0
    for a in range(TURNS):
        angle = yaw + TURN * (a - TURNS // 2)
        c, s = ti.cos(angle), ti.sin(angle)
        hits = ti.Vector.zero(ti.i32, WINDOW * LANES)
        for p in range(count):
            q = spread(p, count, structure)
            u, v = structure[q], structure[q + 1]
            row = ti.cast(ti.floor(y + s * u + c * v), ti.i32)
            column = ti.cast(ti.floor(x + c * u - s * v), ti.i32)
            if row >= REACH and row < high - REACH and column >= REACH and column < wide - REACH - 1:
                level = ti.cast(ti.floor(z + structure[q + 2]), ti.i32) & 31
                first = (row - REACH) * wide + column - REACH
                for i in range(WINDOW):
                    for j in range(LANES):
                        hits[i * LANES + j] += (coarse[first + i * wide + j] >> level) & 1
        for i in range(WINDOW):
            for j in range(WINDOW):
                # of equal ones the nearest: a sixteenth of a point for each step
                off = ti.abs(i - REACH) + ti.abs(j - REACH) + ti.abs(a - TURNS // 2)
                value = 16 * hits[i * LANES + j] - off
                if value > best:
                    best, at, turn = value, i * WINDOW + j, a
    return at, turn


@ti.func
def spread(p, count, points: ti.template()):
    """Return the place of the ``p``-th of ``count`` points that are spread evenly over all."""
    return 3 * ti.cast(ti.cast(p, ti.i64) * (points.shape[0] // 3) // count, ti.i32)


@ti.func
def fine_hits(
    table: ti.template(), down, across, bits: ti.template(), structure: ti.template(), count, x, y, z, yaw, step,
    hits: ti.template(),
):  # fmt: skip
    """Count at a pose, and at the eight ``step`` metres away, points on structure and points near it."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    for p in range(count):
        q = spread(p, count, structure)
        u, v = x + c * structure[q] - s * structure[q + 1], y + s * structure[q] + c * structure[q + 1]
        level = ti.cast(ti.floor(2.0 * (z + structure[q + 2])), ti.i64) & 63
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                at = cell_at(table, down, across, u + step * (j - 1), v + step * (i - 1))
                hits[3 * i + j] += ti.cast(((bits[2 * at] >> level) & 1) + ((bits[2 * at + 1] >> level) & 1), ti.i32)


@ti.func
def rise(
    table: ti.template(), down, across, base: ti.template(), surface: ti.template(), low: ti.template(), count,
    x, y, z, yaw, reach,
) -> ti.f32:  # fmt: skip
    """Return by how much the scan has to rise to the map's ground, from points within ``reach`` of it."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    total, number = ti.cast(0.0, ti.f32), 0
    for p in range(count):
        q = spread(p, count, low)
        u, v = low[q], low[q + 1]
        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
        d = base[at >> 10] + CENTIMETRE * ground_of(surface[at]) - z - low[q + 2]
        counts = ti.cast(ground_of(surface[at]) > NOT_SURVEYED, ti.i32) & ti.cast(ti.abs(d) < reach, ti.i32)
        total += ti.select(counts > 0, d, 0.0)
        number += counts
    return total / ti.max(number, 1)


@ti.kernel
def score(
    coarse: WHOLES, wide: ti.i32, table: WHOLES, across: ti.i32, base: FLOATS, bits: BITS, surface: WHOLES,
    structure: FLOATS, low: FLOATS, free: FLOATS, settings: WHOLES, poses: DOUBLES, counts: WHOLES, chunks: ti.i32,
):  # fmt: skip
    """Move and score the poses; ``settings``: points of the coarse level, of a fine one, of the height; fine levels."""
    for task in range(chunks * SPAN):
        if task % SPAN == 0:
            down = table.shape[0] // across
            high = coarse.shape[0] // wide
            few, some, lows, levels = settings[0], settings[1], settings[2], settings[3]
            for n in range(poses.shape[0] // 4 // chunks + 1):
                h = n * chunks + task // SPAN
                if h < poses.shape[0] // 4:
                    x = ti.cast(poses[4 * h], ti.f32)
                    y = ti.cast(poses[4 * h + 1], ti.f32)
                    z = ti.cast(poses[4 * h + 2], ti.f32)
                    yaw = ti.cast(poses[4 * h + 3], ti.f32)
                    if levels > 0:
                        at, turn = coarse_best(coarse, high, wide, structure, few, x, y, z, yaw)
                        x += ti.cast(at % WINDOW - REACH, ti.f32)
                        y += ti.cast(at // WINDOW - REACH, ti.f32)
                        yaw += TURN * (turn - TURNS // 2)
                        z += rise(table, down, across, base, surface, low, lows, x, y, z, yaw, 2.0)
                        z += rise(table, down, across, base, surface, low, lows, x, y, z, yaw, 0.5)
                    step, angle = ti.cast(0.5, ti.f32), ti.cast(0.5 * TURN, ti.f32)
                    for _ in range(levels):
                        # the shift first, then the heading, with the shifts around the one that was best before
                        best, bi, bj, bk = -1, 0, 0, 0
                        for k in range(3):
                            turned = yaw + angle * ((k + 1) % 3 - 1)
                            hits = ti.Vector.zero(ti.i32, 9)
                            fine_hits(table, down, across, bits, structure, some, x, y, z, turned, step, hits)
                            for i in ti.static(range(3)):
                                for j in ti.static(range(3)):
                                    value = 4 * hits[3 * i + j] - abs(i - 1) - abs(j - 1) - ti.min(k, 1)
                                    if value > best:
                                        best, bi, bj, bk = value, i - 1, j - 1, (k + 1) % 3 - 1
                        x += step * bj
                        y += step * bi
                        yaw += angle * bk
                        step *= 0.5
                        angle *= 0.5
                    if levels > 0:
                        z += rise(table, down, across, base, surface, low, lows, x, y, z, yaw, 0.5)
                    c, s = ti.cos(yaw), ti.sin(yaw)
                    inside, close, covered, inside_low, grounded, passed = 0, 0, 0, 0, 0, 0
                    for p in range(structure.shape[0] // 3):
                        u, v = structure[3 * p], structure[3 * p + 1]
                        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
                        word = surface[at]
                        known = ti.cast(ground_of(word) != NOT_SURVEYED, ti.i32)
                        level = z + structure[3 * p + 2]
                        edge = word >> 16
                        hit = bit(bits[2 * at], level)
                        top = ti.select(edge > 0, base[at >> 10] + EDGE_STEP * edge, -1e6)
                        inside += known
                        close += hit & known
                        covered += (hit | ti.cast(top > level - UNDER_EDGE, ti.i32)) & known
                    for p in range(low.shape[0] // 3):
                        u, v = low[3 * p], low[3 * p + 1]
                        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
                        height = ground_of(surface[at])
                        known = ti.cast(height != NOT_SURVEYED, ti.i32)
                        level = z + low[3 * p + 2]
                        off = level - base[at >> 10] - CENTIMETRE * height
                        on = ti.cast(ti.abs(off) < ON_GROUND, ti.i32)
                        upper = ti.cast(off > UPPER_FLOOR, ti.i32) & bit(bits[2 * at + 1], level)
                        inside_low += known
                        grounded += (on | upper) & known
                    for p in range(free.shape[0] // 3):
                        u, v = free[3 * p], free[3 * p + 1]
                        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
                        passed += bit(bits[2 * at + 1], z + free[3 * p + 2])
                    poses[4 * h] = x
                    poses[4 * h + 1] = y
                    poses[4 * h + 2] = z
                    poses[4 * h + 3] = yaw
                    counts[6 * h] = inside
                    counts[6 * h + 1] = close
                    counts[6 * h + 2] = covered
                    counts[6 * h + 3] = inside_low
                    counts[6 * h + 4] = grounded
                    counts[6 * h + 5] = passed
