# mypy: ignore-errors
"""Taichi source of intake.py: the pass of _ti_sieve.py with polar bins.

A kernel of its own, since most callers want no bins, and a kernel takes time to load.
"""

from coview_kernels import runtime

ti = runtime.library()
polar, sieve = runtime.kernels("polar"), runtime.kernels("sieve")
f32, i32, i64 = ti.f32, ti.i32, ti.i64

Floats, Doubles, Integers, Longs = sieve.Floats, sieve.Doubles, sieve.Integers, sieve.Longs
BLOCK = sieve.BLOCK
place, look_up, add = sieve.place, sieve.look_up, polar.add


@ti.kernel
def intake(
    points: Floats,
    rows: i32,
    generation: i64,
    bits: i32,
    merge: i64,
    move: Doubles,
    table: Longs,
    moved: Floats,
    totals: Integers,
    rings: i32,
    sectors: i32,
    params: Doubles,
    edges: Doubles,
    highest: Floats,
    total: Doubles,
    count: Integers,
):
    """``sieve`` and ``bins`` at once; a block of points is binned when as many are kept."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        a, b, c = ti.Vector.zero(f32, BLOCK), ti.Vector.zero(f32, BLOCK), ti.Vector.zero(f32, BLOCK)
        plane, rest = ti.Vector.zero(i32, BLOCK), ti.Vector.zero(i32, BLOCK)
        infinite, far, cubes, out, at = 0, 0, 0, 0, 0
        last, seen = i64(0), i64(0)
        binned = 0
        for block in range((rows + BLOCK - 1) // BLOCK):
            start = block * BLOCK
            n = ti.min(BLOCK, rows - start)
            odd, off = place(start, n, points, move, a, b, c, plane, rest)
            infinite += odd
            far += off
            if cubes + BLOCK <= 1 << (bits - 1):
                out, more, at, last, seen = look_up(
                    n, generation, bits, merge, out, at, last, seen, a, b, c, plane, rest, table, moved
                )
                cubes += more
            least = ti.select(start + n == rows, 1, BLOCK)
            while out - binned >= least:
                n = ti.min(BLOCK, out - binned)
                add(binned, n, 0, moved, rings, sectors, params, edges, highest, total, count)
                binned += n
        totals[0], totals[1], totals[2] = out, infinite, far
        totals[3] = ti.cast(cubes + BLOCK > 1 << (bits - 1), i32)
