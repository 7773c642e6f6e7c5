# mypy: ignore-errors
"""Taichi source of voxel_filter.py: one pass over the points, with a hash table of cubes of 4 x 4 x 4 voxels.

Points are processed in blocks. They are moved, and their voxels are numbered into local vectors, several points at a
time (a store to an argument might alias and is never vectorised). Then they are looked up one by one: a cube has 64
bits, one per voxel, so that neighbouring points of a surface rarely need the table. Blocks are always full, as loops of
unknown length take half as long again to compile, at every start.
"""

from coview_kernels import runtime

ti = runtime.library()
f32, f64, i32, i64 = ti.f32, ti.f64, ti.i32, ti.i64

Floats = ti.types.ndarray(f32, 1)
Doubles = ti.types.ndarray(f64, 1)
Integers = ti.types.ndarray(i32, 1)
Longs = ti.types.ndarray(i64, 1)

BLOCK = 64
FINITE = 3.4028235e38
FAR = 1 << 15  # voxels around the sensor's are in [-2^15, 2^15): 16 bits an axis, 14 for the cube
STAMP = 42
GOLDEN = -7046029254386353131


@ti.func
def voxel_of(p: f32, limit: f32, inverse: f64, middle: i32) -> i32:
    """Return ``floor(p * inverse)`` above ``middle``, by truncation, which is vectorised. NaN is far away."""
    p = ti.select(p < limit, p, limit)
    p = ti.select(p > -limit, p, -limit)
    v = ti.cast(p, f64) * inverse
    whole = ti.cast(v, i32)
    return whole - ti.cast(ti.cast(whole, f64) > v, i32) - middle


@ti.func
def number_voxels(
    start: i32, points: ti.template(), settings: ti.template(),
    a: ti.template(), b: ti.template(), c: ti.template(), plane: ti.template(), rest: ti.template(),
):  # fmt: skip
    """Move a block to a, b, c and number the voxels; return how many points are not finite and how many out of reach.

    ``plane`` has the cube's index along x and y, ``rest`` its index along z, the voxel in the cube (6 bits) and whether
    the point is in range.
    """
    T = ti.Vector([settings[k] for k in ti.static(range(12))])
    inverse, nearest, farthest = settings[12], settings[13], settings[14]
    limit = ti.cast(settings[15], f32)
    u, v, w = settings[19], settings[20], settings[21]
    middle = ti.Vector([ti.cast(settings[16 + k], i32) - FAR for k in ti.static(range(3))])
    infinite, far = 0, 0
    for j in range(BLOCK):
        i = 3 * (start + j)
        x, y, z = ti.cast(points[i], f64), ti.cast(points[i + 1], f64), ti.cast(points[i + 2], f64)
        p = ti.cast(T[0] * x + T[1] * y + T[2] * z + T[3], f32)
        q = ti.cast(T[4] * x + T[5] * y + T[6] * z + T[7], f32)
        r = ti.cast(T[8] * x + T[9] * y + T[10] * z + T[11], f32)
        a[j], b[j], c[j] = p, q, r
        # NaN and inf reach every image, even through a zero (0 * inf is NaN)
        finite = ti.cast(ti.abs(p) <= FINITE, i32) & ti.cast(ti.abs(q) <= FINITE, i32)
        finite &= ti.cast(ti.abs(r) <= FINITE, i32)
        r2 = (x - u) * (x - u) + (y - v) * (y - v) + (z - w) * (z - w)
        inside = finite & ti.cast(r2 >= nearest, i32) & ti.cast(r2 < farthest, i32)
        ip = voxel_of(p, limit, inverse, middle[0])
        iq = voxel_of(q, limit, inverse, middle[1])
        ir = voxel_of(r, limit, inverse, middle[2])
        beyond = inside & ti.cast(((ip | iq | ir) >> 16) != 0, i32)
        infinite += 1 - finite
        far += beyond
        plane[j] = ((ip >> 2) << 14) | (iq >> 2)
        within = ((ip & 3) << 4) | ((iq & 3) << 2) | (ir & 3)
        rest[j] = ((ir >> 2) << 7) | (within << 1) | (inside - beyond)
    return infinite, far


@ti.func
def keep_first(
    call: i64, bits: i32, merge: i64, out: i32, at: i32, last: i64, seen: i64,
    a: ti.template(), b: ti.template(), c: ti.template(), plane: ti.template(), rest: ti.template(),
    table: ti.template(), moved: ti.template(),
):  # fmt: skip
    """Append the first point of each voxel to ``moved``; return its new end, the cubes added, and the last cube.

    ``table`` has a key and 64 bits for each cube. A slot is free unless its key belongs to this ``call``; nothing is
    ever cleared. The bits of the last cube, at ``at``, are in ``seen`` until another cube follows.
    """
    cubes = 0
    for j in range(BLOCK):
        w = rest[j]
        k = (call << STAMP) | (ti.cast(plane[j], i64) << 14) | ti.cast(w >> 7, i64)
        voxel = ti.cast(w & 1, i64) << ti.cast((w >> 1) & 63, i64)
        if (k != last) & (voxel != 0):
            table[2 * at + 1] = seen
            last = k
            wrap = (1 << bits) - 1
            at = ti.cast((k * i64(GOLDEN)) >> (64 - bits), i32) & wrap
            held = table[2 * at]
            while (held != k) & ((held >> STAMP) == call):
                at = (at + 1) & wrap
                held = table[2 * at]
            fresh = ti.cast(held != k, i32)
            cubes += fresh
            table[2 * at] = k
            seen = ti.select(fresh != 0, i64(0), table[2 * at + 1])
        # always written, and kept if new: a branch would be mispredicted too often
        moved[3 * out] = a[j]
        moved[3 * out + 1] = b[j]
        moved[3 * out + 2] = c[j]
        out += ti.cast((voxel & ~seen) != 0, i32)
        seen |= voxel & merge
    return out, cubes, at, last, seen


@runtime.kernel
def voxel_filter(
    points: Floats, blocks: i32, call: i64, bits: i32, merge: i64,
    settings: Doubles, table: Longs, moved: Floats, totals: Integers,
):  # fmt: skip
    """Append the kept rows to ``moved``.

    ``merge``: -1, or 0 to keep every point. ``settings``: 12 numbers of T, then 1 / voxel or 0, the squares of r_min
    and r_max, a coordinate beyond reach, the sensor's voxel, the origin of ranges. ``totals``: kept, not finite, out of
    reach, cubes, accumulated over calls. One slot behind the table takes the bits written before the first cube.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        a, b, c = ti.Vector.zero(f32, BLOCK), ti.Vector.zero(f32, BLOCK), ti.Vector.zero(f32, BLOCK)
        plane, rest = ti.Vector.zero(i32, BLOCK), ti.Vector.zero(i32, BLOCK)
        out, infinite, far, cubes = totals[0], totals[1], totals[2], totals[3]
        last, seen, at = i64(0), i64(0), 1 << bits
        for block in range(blocks):
            odd, off = number_voxels(block * BLOCK, points, settings, a, b, c, plane, rest)
            infinite += odd
            far += off
            if cubes + BLOCK <= 1 << (bits - 1):
                out, more, at, last, seen = keep_first(
                    call, bits, merge, out, at, last, seen, a, b, c, plane, rest, table, moved
                )
                cubes += more
        table[2 * at + 1] = seen
        totals[0], totals[1], totals[2], totals[3] = out, infinite, far, cubes
