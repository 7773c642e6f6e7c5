# mypy: ignore-errors
"""Taichi source of intake.py: chunks of a frame side by side, each with a hash table of its own."""

from coview_kernels import launch, runtime

ti = runtime.library()
polar = runtime.kernels("polar")

Floats = ti.types.ndarray(ti.f32, 1)
Doubles = ti.types.ndarray(ti.f64, 1)
Integers = ti.types.ndarray(ti.i32, 1)
Longs = ti.types.ndarray(ti.i64, 1)
SPAN = launch.SPAN
add_point, clear_bins, merge_bins = polar.add_point, polar.clear_bins, polar.merge_bins

FAR = 1 << 15  # voxel coordinates around the sensor's in (-2^15, 2^15) pack into 48 bits
GOLDEN = -7046029254386353131


@ti.func
def slot_of(k: ti.i64, bits: ti.i32) -> ti.i32:
    """Slot of a key: eight voxels that make a cube share a cache line, and neighbours in a scan share cubes."""
    cube = (k >> 1) & ti.i64(0x7FFF7FFF7FFF)
    within = ti.cast((k & 1) | ((k >> 15) & 2) | ((k >> 30) & 4), ti.i32)
    return (ti.cast((cube * ti.i64(GOLDEN)) >> (64 - bits), ti.i32) & ((1 << bits) - 1)) ^ within


@ti.func
def find(k: ti.i64, first: ti.i32, bits: ti.i32, generation: ti.i64, table: ti.template()) -> ti.i32:
    """Where the key is in the table that begins at ``first``, or the free place where it belongs.

    A place is free unless it was filled in this ``generation``: nothing is ever cleared.
    """
    slot = slot_of(k, bits)
    held = table[first + slot]
    while (held != k) & ((held >> 48) == generation):
        slot = (slot + 1) & ((1 << bits) - 1)
        held = table[first + slot]
    return first + slot


@ti.kernel
def intake(
    points: Floats,
    rows: ti.i32,
    chunks: ti.i32,
    generation: ti.i64,
    bits: ti.i32,
    move: Doubles,
    table: Longs,
    keys: Longs,
    moved: Floats,
    totals: Integers,
    rings: ti.i32,
    sectors: ti.i32,
    params: Doubles,
    edges: Doubles,
    guesses: Integers,
    cells: polar.Shorts,
    bins: Doubles,
    highest: Floats,
    total: Floats,
    count: Integers,
):
    """Leave the kept rows at the front of ``moved``, and their polar bins if ``rings`` is positive.

    ``move``: 12 numbers of T, then 1 / voxel or 0, the squares of r_min and r_max, the sensor's voxel.
    ``totals``: by chunk kept of its own, kept in all, not finite, out of reach, too many for the table; after
    the chunks the number of kept rows.
    """
    size = rings * sectors
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (rows + chunks - 1) // chunks
            begin = ti.min(rows, c * step)
            out = begin
            most = begin + (1 << (bits - 1))
            infinite = 0
            far = 0
            full = 0
            last = ti.cast(0, ti.i64)
            for i in range(begin, ti.min(rows, begin + step)):
                x = ti.cast(points[3 * i], ti.f64)
                y = ti.cast(points[3 * i + 1], ti.f64)
                z = ti.cast(points[3 * i + 2], ti.f64)
                a = ti.cast(move[0] * x + move[1] * y + move[2] * z + move[3], ti.f32)
                b = ti.cast(move[4] * x + move[5] * y + move[6] * z + move[7], ti.f32)
                d = ti.cast(move[8] * x + move[9] * y + move[10] * z + move[11], ti.f32)
                # NaN and inf reach every image, even through a zero (0 * inf is NaN); float32 summands cannot
                # overflow
                images = ti.bit_cast(ti.cast(a, ti.f64) + ti.cast(b, ti.f64) + ti.cast(d, ti.f64), ti.i64)
                r2 = x * x + y * y + z * z
                if ((images >> 52) & 0x7FF) == 0x7FF:
                    infinite += 1
                elif r2 >= move[13] and r2 < move[14]:
                    inverse = move[12]
                    fa = ti.floor(ti.cast(a, ti.f64) * inverse) - move[15]
                    fb = ti.floor(ti.cast(b, ti.f64) * inverse) - move[16]
                    fd = ti.floor(ti.cast(d, ti.f64) * inverse) - move[17]
                    if inverse == 0:
                        moved[3 * out] = a
                        moved[3 * out + 1] = b
                        moved[3 * out + 2] = d
                        out += 1
                    elif ti.max(ti.abs(fa), ti.abs(fb), ti.abs(fd)) >= FAR:
                        far += 1
                    elif out >= most:
                        full += 1
                    else:
                        ia = ti.cast(ti.cast(fa, ti.i32) + FAR, ti.i64)
                        ib = ti.cast(ti.cast(fb, ti.i32) + FAR, ti.i64)
                        ic = ti.cast(ti.cast(fd, ti.i32) + FAR, ti.i64)
                        k = (generation << 48) | (ia << 32) | (ib << 16) | ic
                        if k != last:  # the next beam often hits the same voxel
                            last = k
                            at = find(k, c << bits, bits, generation, table)
                            new = ti.cast(table[at] != k, ti.i32)
                            table[at] = k
                            # written in any case and kept if new: a branch would be guessed wrong too often
                            moved[3 * out] = a
                            moved[3 * out + 1] = b
                            moved[3 * out + 2] = d
                            keys[out] = k
                            out += new
            totals[5 * c] = out - begin
            totals[5 * c + 2] = infinite
            totals[5 * c + 3] = far
            totals[5 * c + 4] = full

    # among the kept rows of a chunk are voxels that an earlier chunk has seen first
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            step = (rows + chunks - 1) // chunks
            begin = ti.min(rows, c * step)
            out = begin
            first = 3 * c * (size + 1)
            clear_bins(first, size + 1, bins)
            for j in range(begin, begin + totals[5 * c]):
                seen = 0
                if move[12] != 0:
                    k = keys[j]
                    for e in range(c):
                        seen |= ti.cast(table[find(k, e << bits, bits, generation, table)] == k, ti.i32)
                if seen == 0:
                    a = moved[3 * j]
                    b = moved[3 * j + 1]
                    d = moved[3 * j + 2]
                    moved[3 * out] = a
                    moved[3 * out + 1] = b
                    moved[3 * out + 2] = d
                    out += 1
                    if rings > 0:
                        x = ti.cast(a, ti.f64)
                        y = ti.cast(b, ti.f64)
                        z = ti.cast(d, ti.f64)
                        add_point(x, y, z, first, rings, sectors, params, edges, guesses, cells, bins)
            totals[5 * c + 1] = out - begin

    ti.loop_config(serialize=True)
    for _ in range(1):
        step = (rows + chunks - 1) // chunks
        out = totals[1]
        for c in range(1, chunks):
            begin = ti.min(rows, c * step)
            for j in range(3 * totals[5 * c + 1]):
                moved[3 * out + j] = moved[3 * begin + j]
            out += totals[5 * c + 1]
        totals[5 * chunks] = out
        merge_bins(chunks, size, bins, highest, total, count)
