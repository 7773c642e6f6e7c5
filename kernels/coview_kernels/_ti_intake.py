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
    blocks: i32,
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
        out, infinite, far, cubes = totals[0], totals[1], totals[2], totals[3]
        last, seen, at = i64(0), i64(0), 1 << bits
        binned = out
        for block in range(blocks):
            odd, off = place(block * BLOCK, points, move, a, b, c, plane, rest)
            infinite += odd
            far += off
            if cubes + BLOCK <= 1 << (bits - 1):
                out, more, at, last, seen = look_up(
                    generation, bits, merge, out, at, last, seen, a, b, c, plane, rest, table, moved
                )
                cubes += more
            least = ti.select(block == blocks - 1, 1, BLOCK)
            while out - binned >= least:
                n = ti.min(BLOCK, out - binned)
                add(binned, n, 0, moved, rings, sectors, params, edges, highest, total, count)
                binned += n
        table[2 * at + 1] = seen
        totals[0], totals[1], totals[2], totals[3] = out, infinite, far, cubes
