# mypy: ignore-errors
"""Taichi source of field.py: each thread takes one hypothesis after another through all levels.

The coarse level counts the hits of a point at all 49 shifts at once. They are neighbouring bits of the raster, seven
from each of seven rows, and are added to 49 numbers whose digits lie side by side in words.

Points are (3, N), one coordinate after another, so that LLVM looks up several at a time.
"""

from coview_kernels import runtime
from coview_kernels.launch import SPAN
from coview_kernels.reference.field import (
    EDGE_STEP,
    NEAR_STEP,
    NEAR_TURN,
    NOT_SURVEYED,
    ON_GROUND,
    REACH,
    RISE_STEPS,
    TURN,
    TURNS,
    UNDER_EDGE,
    UPPER_FLOOR,
)

ti = runtime.library()

FLOATS = ti.types.ndarray(ti.f32, 1)
POINTS = ti.types.ndarray(ti.f32, 2)
DOUBLES = ti.types.ndarray(ti.f64, 1)
WHOLES = ti.types.ndarray(ti.i32, 1)
PLANES = ti.types.ndarray(ti.u16, 1)
BITS = ti.types.ndarray(ti.i64, 1)

WINDOW = 2 * REACH + 1  # coarse shifts along each axis
# bits are indexed from the array's beginning, or on large maps from word 2^31: ``first`` is 0 or -2^31, and indices
# are added to it in 32 bits with wrap-around
DIGITS = 7  # of a number of hits: 127 points at most
CENTIMETRE = 0.01


@ti.func
def clamped(x, tiles) -> ti.i32:
    """Return the row or column of a coordinate, clamped to the first or last."""
    return ti.min(ti.max(ti.cast(ti.floor(2.0 * x), ti.i32), 0), 32 * tiles - 1)


@ti.func
def place(table: ti.template(), across, i, j) -> ti.i32:
    """Return the index in the layers of the cell in row i and column j, in the empty tile if it is not stored."""
    return (table[(i >> 5) * across + (j >> 5)] << 10) + ((i & 31) << 5) + (j & 31)


@ti.func
def cell_at(table: ti.template(), down, across, x, y) -> ti.i32:
    """Return the index in the layers of the cell that holds (x, y)."""
    return place(table, across, clamped(y, down), clamped(x, across))


@ti.func
def ground_of(packed) -> ti.i32:
    """Return the ground height, the signed lower half of a word of the surface."""
    return (packed << 16) >> 16


@ti.func
def level_of(z) -> ti.i32:
    """Return the number of a height in half metres."""
    return ti.cast(ti.floor(2.0 * z), ti.i32)


@ti.func
def both_bits(bits: ti.template(), first, at, level) -> ti.i64:
    """Return the word of a cell, shifted so that bits 0 and 32 are those of a level; ``first``: see above."""
    # a tile has 1024 cells, and as many words of the lower half of its 64 levels, then as many of the upper half
    return bits[at + (at & -1024) + ((level << 5) & 1024) + first] >> ti.cast(level & 31, ti.i64)


@ti.func
def near_bit(word) -> ti.i32:
    """Return whether there is structure near, of a word of :func:`both_bits`."""
    return ti.cast(word & 1, ti.i32)


@ti.func
def on_bit(word) -> ti.i32:
    """Return whether there is structure, of a word of :func:`both_bits`."""
    return ti.cast((word >> 32) & 1, ti.i32)


@ti.func
def coarse_best(planes: ti.template(), high, blocks, structure: ti.template(), x, y, z, yaw):
    """Return the shift and the turn, in steps, at which most points are near structure; small ones win ties."""
    best, at, turn = -1, 0, 0
    for a in range(TURNS):
        angle = yaw + TURN * (a - TURNS // 2)
        c, s = ti.cos(angle), ti.sin(angle)
        # digits of 49 numbers counted at once: bit 7 i + j of the d-th word is digit d of shift (i, j)
        digits = ti.Vector.zero(ti.i64, DIGITS)
        for p in range(structure.shape[1]):
            u, v = structure[0, p], structure[1, p]
            row = ti.cast(ti.floor(y + s * u + c * v), ti.i32) - REACH
            column = ti.cast(ti.floor(x + c * u - s * v), ti.i32) - REACH
            if row >= 0 and row < high - 2 * REACH and column >= 0 and column < 8 * blocks - 8:
                level = ti.cast(ti.floor(z + structure[2, p]), ti.i32) & 31
                first = (level * blocks + (column >> 3)) * high + row
                carry = ti.cast(0, ti.i64)
                for i in ti.static(range(WINDOW)):
                    word = ti.cast(planes[first + i], ti.i64) >> (column & 7)
                    carry |= (word & (2**WINDOW - 1)) << (WINDOW * i)
                for d in ti.static(range(DIGITS)):
                    both = digits[d] & carry
                    digits[d] ^= carry
                    carry = both
        for k in range(WINDOW * WINDOW):
            hits = 0
            for d in ti.static(range(DIGITS)):
                hits += ti.cast((digits[d] >> k) & 1, ti.i32) << d
            # the nearest wins a tie: each step costs a sixteenth of a point
            off = ti.abs(k // WINDOW - REACH) + ti.abs(k % WINDOW - REACH) + ti.abs(a - TURNS // 2)
            value = 16 * hits - off
            if value > best:
                best, at, turn = value, k, a
    return at, turn


@ti.func
def _nine_cells(down, across, structure: ti.template(), p, x, y, z, yaw, step):
    """Return a point's level, and its three rows and columns at a pose and at shifts of ``step`` metres."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    u, v = structure[0, p], structure[1, p]
    level = level_of(z + structure[2, p])
    rows = ti.Vector.zero(ti.i32, 3)
    columns = ti.Vector.zero(ti.i32, 3)
    for k in ti.static(range(3)):
        rows[k] = clamped(y + s * u + c * v + step * (k - 1), down)
        columns[k] = clamped(x + c * u - s * v + step * (k - 1), across)
    return level, rows, columns


@ti.func
def fine_hits(
    table: ti.template(), down, across, bits: ti.template(), first, structure: ti.template(), x, y, z, yaw, step,
    hits: ti.template(),
):  # fmt: skip
    """Count points on structure and points near it, at a pose and at its eight neighbours ``step`` metres away."""
    for p in range(structure.shape[1]):
        level, rows, columns = _nine_cells(down, across, structure, p, x, y, z, yaw, step)
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                word = both_bits(bits, first, place(table, across, rows[i], columns[j]), level)
                hits[3 * i + j] += near_bit(word) + on_bit(word)


@ti.func
def closer_hits(
    table: ti.template(), down, across, bits: ti.template(), first, structure: ti.template(), x, y, z, yaw, step,
    hits: ti.template(),
):  # fmt: skip
    """Count like :func:`fine_hits` for steps of at most half a cell, when the nine poses share four cells."""
    for p in range(structure.shape[1]):
        level, rows, columns = _nine_cells(down, across, structure, p, x, y, z, yaw, step)
        # in the first and the last row and column
        cells = ti.Vector.zero(ti.i32, 4)
        for k in ti.static(range(4)):
            at = place(table, across, rows[2 * (k // 2)], columns[2 * (k % 2)])
            word = both_bits(bits, first, at, level)
            cells[k] = near_bit(word) + on_bit(word)
        low = rows[1] == rows[0]
        left = columns[1] == columns[0]
        upper, lower = ti.select(left, cells[0], cells[1]), ti.select(left, cells[2], cells[3])
        hits[0] += cells[0]
        hits[1] += upper
        hits[2] += cells[1]
        hits[3] += ti.select(low, cells[0], cells[2])
        hits[4] += ti.select(low, upper, lower)
        hits[5] += ti.select(low, cells[1], cells[3])
        hits[6] += cells[2]
        hits[7] += lower
        hits[8] += cells[3]


@ti.func
def hits_at(
    table: ti.template(), down, across, bits: ti.template(), first, structure: ti.template(), x, y, z, yaw
) -> ti.i32:  # fmt: skip
    """Count points on structure and points near it at a pose."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    hits = 0
    for p in range(structure.shape[1]):
        u, v = structure[0, p], structure[1, p]
        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
        word = both_bits(bits, first, at, level_of(z + structure[2, p]))
        hits += near_bit(word) + on_bit(word)
    return hits


@ti.func
def rise(
    table: ti.template(), down, across, base: ti.template(), surface: ti.template(), low: ti.template(),
    x, y, z, yaw, reach,
) -> ti.f32:  # fmt: skip
    """Return the metres that the scan has to rise to the map's ground, from points within ``reach`` of it."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    total, number = 0, 0  # in whole steps: LLVM adds floats one after another
    for p in range(low.shape[1]):
        u, v = low[0, p], low[1, p]
        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
        d = base[at >> 10] + CENTIMETRE * ground_of(surface[at]) - z - low[2, p]
        counts = ti.cast(ground_of(surface[at]) > NOT_SURVEYED, ti.i32) & ti.cast(ti.abs(d) < reach, ti.i32)
        total += ti.cast(ti.floor(RISE_STEPS * ti.select(counts > 0, d, 0.0) + 0.5), ti.i32)
        number += counts
    return ti.cast(total, ti.f32) / ti.cast(RISE_STEPS * ti.max(number, 1), ti.f32)


@runtime.kernel
def score(
    planes: PLANES, blocks: ti.i32, high: ti.i32,
    table: WHOLES, across: ti.i32, base: FLOATS, bits: BITS, first: ti.i32, surface: WHOLES,
    structure: POINTS, low: POINTS, free: POINTS, few: POINTS, some: POINTS, lows: POINTS,
    levels: ti.i32, coarse: ti.i32,
    poses: DOUBLES, counts: WHOLES, chunks: ti.i32,
):  # fmt: skip
    """Move and score poses; coarse level, fine levels and height use the points ``few``, ``some`` and ``lows``."""
    for task in range(chunks * SPAN):
        if task % SPAN == 0:
            down = table.shape[0] // across
            for n in range(poses.shape[0] // 4 // chunks + 1):
                h = n * chunks + task // SPAN
                if h < poses.shape[0] // 4:
                    x = ti.cast(poses[4 * h], ti.f32)
                    y = ti.cast(poses[4 * h + 1], ti.f32)
                    z = ti.cast(poses[4 * h + 2], ti.f32)
                    yaw = ti.cast(poses[4 * h + 3], ti.f32)
                    step, angle = ti.cast(NEAR_STEP, ti.f32), ti.cast(NEAR_TURN, ti.f32)
                    if levels >= 0:
                        if coarse > 0:
                            at, turn = coarse_best(planes, high, blocks, few, x, y, z, yaw)
                            x += ti.cast(at % WINDOW - REACH, ti.f32)
                            y += ti.cast(at // WINDOW - REACH, ti.f32)
                            yaw += TURN * (turn - TURNS // 2)
                            step, angle = ti.cast(0.5, ti.f32), ti.cast(0.5 * TURN, ti.f32)
                        for k in range(2):  # a loop, because each call in the source is compiled separately
                            reach = ti.select(k == 0, ti.cast(2.0, ti.f32), ti.cast(0.5, ti.f32))
                            z += rise(table, down, across, base, surface, lows, x, y, z, yaw, reach)
                    for _ in range(levels):
                        # the shift first, then the heading: a third of the cost of all pairs
                        hits = ti.Vector.zero(ti.i32, 9)
                        if step > 0.25:
                            fine_hits(table, down, across, bits, first, some, x, y, z, yaw, step, hits)
                        else:
                            closer_hits(table, down, across, bits, first, some, x, y, z, yaw, step, hits)
                        best, bi, bj, bk = -1, 0, 0, 0
                        for i in ti.static(range(3)):
                            for j in ti.static(range(3)):
                                value = 4 * hits[3 * i + j] - abs(i - 1) - abs(j - 1)
                                if value > best:
                                    best, bi, bj = value, i - 1, j - 1
                        x += step * bj
                        y += step * bi
                        for k in range(2):
                            turned = yaw + angle * (2 * k - 1)
                            value = 4 * hits_at(table, down, across, bits, first, some, x, y, z, turned) - 1
                            if value > best:
                                best, bk = value, 2 * k - 1
                        yaw += angle * bk
                        step *= 0.5
                        angle *= 0.5
                    if levels >= 0:
                        z += rise(table, down, across, base, surface, lows, x, y, z, yaw, 0.5)
                    c, s = ti.cos(yaw), ti.sin(yaw)
                    inside, close, covered, inside_low, grounded, passed, on = 0, 0, 0, 0, 0, 0, 0
                    for p in range(structure.shape[1]):
                        u, v = structure[0, p], structure[1, p]
                        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
                        word = surface[at]
                        known = ti.cast(ground_of(word) != NOT_SURVEYED, ti.i32)
                        level = z + structure[2, p]
                        edge = word >> 16
                        both = both_bits(bits, first, at, level_of(level))
                        hit = near_bit(both)
                        top = ti.select(edge > 0, base[at >> 10] + EDGE_STEP * edge, -1e6)
                        inside += known
                        close += hit & known
                        on += on_bit(both) & known
                        covered += (hit | ti.cast(top > level - UNDER_EDGE, ti.i32)) & known
                    for p in range(low.shape[1]):
                        u, v = low[0, p], low[1, p]
                        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
                        height = ground_of(surface[at])
                        known = ti.cast(height != NOT_SURVEYED, ti.i32)
                        level = z + low[2, p]
                        off = level - base[at >> 10] - CENTIMETRE * height
                        flat = ti.cast(ti.abs(off) < ON_GROUND, ti.i32)
                        above = ti.cast(off > UPPER_FLOOR, ti.i32) & known  # else words of the empty tile: cached
                        upper = above & on_bit(both_bits(bits, first, ti.select(above > 0, at, 0), level_of(level)))
                        inside_low += known
                        grounded += (flat | upper) & known
                    for p in range(free.shape[1]):
                        u, v = free[0, p], free[1, p]
                        at = cell_at(table, down, across, x + c * u - s * v, y + s * u + c * v)
                        passed += on_bit(both_bits(bits, first, at, level_of(z + free[2, p])))
                    poses[4 * h] = x
                    poses[4 * h + 1] = y
                    poses[4 * h + 2] = z
                    poses[4 * h + 3] = yaw
                    counts[7 * h] = inside
                    counts[7 * h + 1] = close
                    counts[7 * h + 2] = covered
                    counts[7 * h + 3] = inside_low
                    counts[7 * h + 4] = grounded
                    counts[7 * h + 5] = passed
                    counts[7 * h + 6] = on
