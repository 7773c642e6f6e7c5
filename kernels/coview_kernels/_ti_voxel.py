# mypy: ignore-errors
"""Taichi source of voxel.py: move and classify in parallel, then one serial pass through a hash table."""

from coview_kernels import runtime

ti = runtime.library()

FAR = 1 << 20  # voxel coordinates in [-2^20, 2^20) pack into 63 bits; others are left to NumPy


@ti.kernel
def transform_unique(
    points: ti.types.ndarray(ti.f32, 2),
    T: ti.types.ndarray(ti.f64, 2),
    inverse: ti.f64,
    r2_min: ti.f64,
    r2_max: ti.f64,
    moved: ti.types.ndarray(ti.f32, 2),
    key: ti.types.ndarray(ti.i64, 1),
    table: ti.types.ndarray(ti.i64, 1),
    shift: ti.i32,
    totals: ti.types.ndarray(ti.i32, 1),
):
    """Leave the kept rows at the front of ``moved``; totals: kept, not finite, voxels out of reach.

    ``key`` is the packed voxel plus 1, 0 for rows out of range, -1 for rows that are not finite, -2 out of
    reach.
    """
    for i in range(points.shape[0]):
        x = ti.cast(points[i, 0], ti.f64)
        y = ti.cast(points[i, 1], ti.f64)
        z = ti.cast(points[i, 2], ti.f64)
        a = ti.cast(T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3], ti.f32)
        b = ti.cast(T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3], ti.f32)
        c = ti.cast(T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3], ti.f32)
        moved[i, 0] = a
        moved[i, 1] = b
        moved[i, 2] = c
        # NaN and inf reach every image, even through a zero (0 * inf is NaN); float32 summands cannot
        # overflow
        images = ti.bit_cast(ti.cast(a, ti.f64) + ti.cast(b, ti.f64) + ti.cast(c, ti.f64), ti.i64)
        r2 = x * x + y * y + z * z
        k = ti.cast(0, ti.i64)
        if ((images >> 52) & 0x7FF) == 0x7FF:
            k = ti.cast(-1, ti.i64)
        elif r2 >= r2_min and r2 < r2_max:
            k = ti.cast(1, ti.i64)
            if inverse > 0:
                fa = ti.floor(ti.cast(a, ti.f64) * inverse)
                fb = ti.floor(ti.cast(b, ti.f64) * inverse)
                fc = ti.floor(ti.cast(c, ti.f64) * inverse)
                if ti.max(ti.abs(fa), ti.abs(fb), ti.abs(fc)) < FAR:
                    ia = ti.cast(fa, ti.i64) + FAR
                    ib = ti.cast(fb, ti.i64) + FAR
                    ic = ti.cast(fc, ti.i64) + FAR
                    k = ((ia << 42) | (ib << 21) | ic) + 1
                else:
                    k = ti.cast(-2, ti.i64)
        key[i] = k

    ti.loop_config(serialize=True)
    for _ in range(1):
        mask = table.shape[0] - 1
        kept = 0
        infinite = 0
        far = 0
        for i in range(points.shape[0]):
            k = key[i]
            new = False
            if k == -1:
                infinite += 1
            elif k == -2:
                far += 1
            elif k > 0:
                new = True
                if inverse > 0:
                    slot = ti.cast(((k * ti.i64(-7046029254386353131)) >> shift) & mask, ti.i32)
                    while table[slot] != 0 and table[slot] != k:
                        slot = (slot + 1) & mask
                    new = table[slot] == 0
                    table[slot] = k
            if new:
                for d in ti.static(range(3)):
                    moved[kept, d] = moved[i, d]
                kept += 1
        totals[0] = kept
        totals[1] = infinite
        totals[2] = far
