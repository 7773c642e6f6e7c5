# mypy: ignore-errors
"""Taichi source of matching.py: from a query to its nearest stations in one launch of three tasks.

prepare: a query's integers and its table of rotations (twin: :mod:`coview_kernels.matching_bounds`); correlate: the
greatest correlation with every station, in integers, on all threads; score: every station that may be among the k
best, once more in float64. Only the second is worth waking threads for.

It keeps 16-bit lanes in local vectors, which LLVM keeps in registers. A store to an argument is never
vectorised (it might alias the others); a local vector is known to be private. The inner loops therefore compile to
vpmulhw and vpaddw on 16 lanes: measured 5 times the rate of a reduction.
"""

from functools import lru_cache

from coview_kernels import runtime

ti = runtime.library()
f32, f64, i16, i32, u16 = ti.f32, ti.f64, ti.i16, ti.i32, ti.u16
_ROUNDING = 2e-9  # as in matching.py


@ti.func
def high(a, b):
    # the upper half of a 16 x 16 bit product, one instruction (vpmulhw)
    return ti.cast((ti.cast(a, i32) * ti.cast(b, i32)) >> 16, i16)


@ti.func
def half_float(bits):
    # float16 by its bits; the product is exact, for small ones without a leading 1 too
    h = ti.cast(bits, i32)
    v = ti.bit_cast(((h & 0x8000) << 16) | ((h & 0x7FFF) << 13), f32)
    return ti.cast(v * ti.cast(2.0**112, f32), f64)


@ti.func
def insert(top: ti.template(), k, value):
    # into k numbers that fall
    j = k
    while j > 0 and top[j - 1] < value:
        j -= 1
        if j + 1 < k:
            top[j + 1] = top[j]
    if j < k:
        top[j] = value


@lru_cache
def _match(rings: int, sectors: int, blocks: int, lanes: int, shifts: int, serial: bool):
    """Kernel for stations of (rings, sectors); shift n, -n, and half a turn on from both come together."""
    rows, half, bins = 2 * rings, blocks // 2, rings * sectors
    size, wide = rows * blocks, -(-max(lanes, sectors) // 16) * 16
    step = 2 - rings % 2

    @ti.func
    def products(stations: ti.template(), query: ti.template(), m, x: ti.template(), y: ti.template()):
        for g in range(rings // step):
            for b in range(blocks):
                sx = ti.cast(0, i16)
                sy = ti.cast(0, i16)
                for u in ti.static(range(step)):
                    at = ((g * step + u) * 2) * blocks + b
                    w = stations[(m * rings + g * step + u) * blocks + b]
                    v = ti.cast(w << ti.cast(8, i16), i16)
                    sx += high(v, query[at]) + high(w, query[at + blocks])
                    sy += high(v, query[size + at]) + high(w, query[size + at + blocks])
                x[b] += sx
                y[b] += sy

    @ti.kernel
    def match(
        raw: ti.types.ndarray(f32, 1),
        fourier: ti.types.ndarray(f64, 1),
        step_size: ti.types.ndarray(f64, 1),
        block_norm: ti.types.ndarray(f64, 1),
        max_query_norm: ti.types.ndarray(f64, 1),
        rotations: ti.types.ndarray(f64, 1),
        max_norm: f64,
        numbers: ti.types.ndarray(f64, 1),
        twice: ti.types.ndarray(f64, 1),
        scale: ti.types.ndarray(f64, 1),
        query: ti.types.ndarray(i16, 1),
        turn: ti.types.ndarray(i16, 1),
        found: ti.types.ndarray(f64, 1),
        stations: ti.types.ndarray(i16, 1),
        residual: ti.types.ndarray(f32, 1),
        best: ti.types.ndarray(i32, 1),
        length: i32,
        descriptors: ti.types.ndarray(u16, 1),
        top: ti.types.ndarray(f64, 1),
        listed: ti.types.ndarray(i32, 1),
        upper: ti.types.ndarray(f64, 1),
        scores: ti.types.ndarray(f64, 1),
        shifts_out: ti.types.ndarray(i32, 1),
        fresh: i32,
        k: i32,
    ):
        ti.loop_config(serialize=True)
        for _ in range(fresh):
            inverse = ti.Vector.zero(f64, sectors)
            for r in range(rings):
                for s in range(sectors):
                    v = ti.cast(raw[r * sectors + s], f64)
                    inverse[s] += v * v
            for s in range(sectors):
                inverse[s] = ti.select(inverse[s] > 0.0, 1.0 / ti.sqrt(inverse[s]), 0.0)
            square = ti.cast(0.0, f64)
            first = ti.Vector.zero(f64, blocks)
            second = ti.Vector.zero(f64, blocks)
            for r in range(rings):
                sums = ti.Vector.zero(f64, 2 * blocks)
                for s in range(sectors):
                    u = ti.cast(raw[r * sectors + s], f64) * inverse[s]
                    twice[r * 2 * sectors + s] = u / sectors
                    twice[r * 2 * sectors + sectors + s] = u / sectors
                    if u != 0.0:
                        for b in range(2 * blocks):
                            sums[b] += u * fourier[s * 2 * blocks + b]
                for b in range(2 * blocks):
                    numbers[r * 2 * blocks + b] = sums[b]
                    square += sums[b] * sums[b]
                for b in range(blocks):
                    g, h = step_size[r * 2 * blocks + b], step_size[r * 2 * blocks + blocks + b]
                    p, q = sums[b] * g, sums[blocks + b] * h
                    s, t = sums[blocks + b] * g, sums[b] * h
                    first[b] += p * p + ti.select(b == 0, 0.0, q * q)
                    second[b] += ti.select(b == 0, q * q, s * s + t * t)
            for b in range(blocks):
                second[b] = max_query_norm[b] / ti.max(ti.sqrt(ti.max(first[b], second[b])), 1e-30)
                first[b] = 0.0
            for r in range(rings):
                for b in range(blocks):
                    at, under = r * 2 * blocks + b, (r * 2 + 1) * blocks + b
                    p, q = (second[b] * numbers[at] * step_size[at], second[b] * numbers[under] * step_size[under])
                    s, t = (second[b] * numbers[under] * step_size[at], -second[b] * numbers[at] * step_size[under])
                    t = ti.select(b == 0, q, t)
                    q = ti.select(b == 0, 0.0, q)
                    s = ti.select(b == 0, 0.0, s)
                    wp, wq, ws, wt = (ti.floor(p + 0.5), ti.floor(q + 0.5), ti.floor(s + 0.5), ti.floor(t + 0.5))
                    query[at], query[under] = ti.cast(wp, i16), ti.cast(wq, i16)
                    query[size + at], query[size + under] = ti.cast(ws, i16), ti.cast(wt, i16)
                    dp, dq, ds, dt = wp - p, wq - q, ws - s, wt - t
                    first[b] += dp * dp + dq * dq + ds * ds + dt * dt
            rounding = ti.cast(0.0, f64)
            error = ti.cast(0.0, f64)
            most = ti.cast(0.0, f64)
            for b in range(blocks):
                rounding += ti.sqrt(2.0 * first[b]) * block_norm[b] / second[b]
                # rotations are zero where a block stands for no frequency
                scale[b] = ti.select(rotations[b * wide] != 0.0, 256.0 / second[b], 0.0)
                error += ti.sqrt(ti.cast(2.0, f64)) * scale[b]
                most = ti.max(most, scale[b])
            error = rows / 2.0 * (error + scale[0])
            span = ti.sqrt(square)
            unit = ti.max(2.01 * most, (max_norm * (span + rounding) + error) / 31000.0)
            for n in range(lanes):
                live = ti.select(n < shifts, 65536.0 / unit, 0.0)
                nyquist = rotations[2 * blocks * wide + n] * scale[0] * live
                turn[4 * lanes + n] = ti.cast(ti.floor(nyquist + 0.5), i16)
                turn[5 * lanes + n] = ti.cast(0, i16)
                for part in range(4):
                    total = ti.select(part == 0, nyquist, 0.0)
                    for j in range(half):
                        at = part * half + j
                        value = rotations[at * wide + n] * scale[at % blocks] * live
                        total += value
                        turn[(6 + at) * lanes + n] = ti.cast(ti.floor(value + 0.5), i16)
                    total = ti.floor(total * (rows / 2.0 / 65536.0) + half / 2.0 + 0.5)
                    turn[part * lanes + n] = ti.cast(ti.select(part == 0 and n >= shifts, -30000.0, total), i16)
            found[0] = span
            found[1] = unit
            found[2] = rounding + error + (0.75 * (2 * blocks + 1) + 4.0) * unit + 3e-5

        if ti.static(serial):
            ti.loop_config(serialize=True)
        for m in range(best.shape[0]):
            x = ti.Vector.zero(i16, blocks)
            y = ti.Vector.zero(i16, blocks)
            products(stations, query, m, x, y)
            # sums over the even blocks, and over the odd ones, which change their sign half a turn on
            even = ti.Vector.zero(i16, lanes)
            odd = ti.Vector.zero(i16, lanes)
            even_sine = ti.Vector.zero(i16, lanes)
            odd_sine = ti.Vector.zero(i16, lanes)
            first = y[0]
            for n in range(lanes):
                even[n] = turn[n] + high(first, turn[4 * lanes + n])
                odd[n] = turn[lanes + n]
                even_sine[n] = turn[2 * lanes + n]
                odd_sine[n] = turn[3 * lanes + n]
            for g in range(half // 4):
                xs = ti.Vector.zero(i16, 8)
                ys = ti.Vector.zero(i16, 8)
                for u in ti.static(range(4)):
                    xs[u] = x[g * 4 + u]
                    ys[u] = y[g * 4 + u]
                    xs[4 + u] = x[half + g * 4 + u]
                    ys[4 + u] = y[half + g * 4 + u]
                for n in range(lanes):
                    # adds nothing, but keeps a number that all lanes share from being spread as 32 bits and narrowed
                    zero = turn[5 * lanes + n]
                    a = ti.cast(0, i16)
                    b = ti.cast(0, i16)
                    c = ti.cast(0, i16)
                    d = ti.cast(0, i16)
                    for u in ti.static(range(4)):
                        at = (6 + g * 4 + u) * lanes + n
                        a += high(xs[u] + zero, turn[at])
                        b += high(ys[u] + zero, turn[at + blocks * lanes])
                        c += high(xs[4 + u] + zero, turn[at + half * lanes])
                        d += high(ys[4 + u] + zero, turn[at + (blocks + half) * lanes])
                    even[n] += a
                    even_sine[n] += b
                    odd[n] += c
                    odd_sine[n] += d
            most = ti.cast(-32768, i16)
            # a length that the compiler does not know: it unrolls a known one into scalars
            for n in range(length):
                p = even_sine[n] + odd_sine[n]
                q = even_sine[n] - odd_sine[n]
                near = even[n] + odd[n] + ti.max(p, -p)
                far = even[n] - odd[n] + ti.max(q, -q)
                most = ti.max(most, ti.max(near, far))
            best[m] = ti.cast(most, i32)

        ti.loop_config(serialize=True)
        for _ in range(ti.min(k, 1)):
            span, unit, rest = found[0], found[1], found[2]
            for i in range(k):
                top[i] = -3.0
            min_bound = ti.cast(-3.0, f64)
            worth = -100000  # in whole units: spares most stations the look at what they miss
            for m in range(best.shape[0]):
                if best[m] > worth:
                    bound = best[m] * unit - (ti.cast(residual[m], f64) * span + rest)
                    if bound > min_bound:
                        insert(top, k, bound)
                        min_bound = top[k - 1]
                        worth = ti.max(worth, ti.cast((min_bound + rest) / unit, i32) - 1)
            min_bound -= _ROUNDING
            worth = ti.max(-100000, ti.cast((min_bound - rest - (max_norm - 1.0) * span) / unit, i32) - 2)
            count = 0
            for m in range(best.shape[0]):
                if best[m] < worth:
                    continue
                bound = best[m] * unit + (ti.cast(residual[m], f64) * span + rest)
                if bound >= min_bound:
                    if count < listed.shape[0]:
                        listed[count] = m
                        upper[count] = bound
                        scores[count] = -3.0
                    count += 1
            found[3] = count
            for i in range(k):
                top[i] = -3.0
            while 0 < count <= listed.shape[0]:
                i = 0
                for j in range(count):
                    i = j if upper[j] > upper[i] else i
                min_bound = ti.max(min_bound, top[k - 1] - _ROUNDING)
                if upper[i] < min_bound:
                    break
                upper[i] = -9.0
                m = listed[i]
                # the integers once more, for every shift: float64 is for those that may be the best
                x = ti.Vector.zero(i16, blocks)
                y = ti.Vector.zero(i16, blocks)
                products(stations, query, m, x, y)
                guess = ti.Vector.zero(f64, wide)
                for b in range(blocks):
                    p = (x[b] + rings) * scale[b]
                    q = (y[b] + rings) * scale[b]
                    row = (2 * blocks if b == 0 else blocks + b) * wide
                    for n in range(wide):
                        guess[n] += p * rotations[b * wide + n] + q * rotations[row + n]
                error = ti.cast(residual[m], f64) * span + rest
                floor = min_bound - error
                for n in range(sectors):
                    floor = ti.max(floor, guess[n] - 2.0 * error)
                inverse = ti.Vector.zero(f64, sectors)
                for r in range(rings):
                    for s in range(sectors):
                        v = half_float(descriptors[m * bins + r * sectors + s])
                        inverse[s] += v * v
                for s in range(sectors):
                    inverse[s] = ti.select(inverse[s] > 0.0, 1.0 / ti.sqrt(inverse[s]), 0.0)
                for n in range(sectors):
                    if guess[n] >= floor:
                        sums = ti.Vector.zero(f64, sectors)
                        for r in range(rings):
                            for s in range(sectors):
                                v = half_float(descriptors[m * bins + r * sectors + s])
                                sums[s] += v * twice[r * 2 * sectors + n + s]
                        score = ti.cast(0.0, f64)
                        for s in range(sectors):
                            score += sums[s] * inverse[s]
                        score = ti.round(score * 1e9) * 1e-9
                        if score > scores[i]:
                            scores[i] = score
                            shifts_out[i] = n
                insert(top, k, scores[i])

    return match


def __getattr__(name):
    """Return ``match_<rings>_<sectors>_<blocks>_<lanes>_<shifts>_<serial>``: local vectors have fixed lengths."""
    kind, _, sizes = name.partition("_")
    if kind != "match":
        raise AttributeError(name)
    return _match(*map(int, sizes.split("_")))
