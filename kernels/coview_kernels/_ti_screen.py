# mypy: ignore-errors
"""Taichi source of screen.py: 16-bit lanes in local vectors, which LLVM keeps in registers.

A store to an argument is never vectorised (it might alias the others); a local vector is known to be private.
The inner loops therefore compile to vpmulhw and vpaddw on 16 lanes: measured 5 times the rate of a reduction.
"""

from functools import lru_cache

from coview_kernels import runtime

ti = runtime.library()
i8, i16, i32 = ti.i8, ti.i16, ti.i32


@ti.func
def high(a, b):
    # the upper half of a 16 x 16 bit product, one instruction (vpmulhw)
    return ti.cast((ti.cast(a, i32) * ti.cast(b, i32)) >> 16, i16)


@lru_cache
def _screen(rows: int, blocks: int, lanes: int):
    """Kernel for stations of (rows, blocks); shifts 0 .. lanes - 1, their negatives, and half a turn from both."""
    size = rows * blocks
    half = blocks // 2
    step = 4 if rows % 4 == 0 else 2

    @ti.kernel
    def best(
        stations: ti.types.ndarray(i8, 1),
        query: ti.types.ndarray(i16, 1),
        turn: ti.types.ndarray(i16, 1),
        length: i32,
        out: ti.types.ndarray(i32, 1),
    ):
        for m in range(out.shape[0]):
            x = ti.Vector.zero(i16, blocks)
            y = ti.Vector.zero(i16, blocks)
            for k in range(rows // step):
                for b in range(blocks):
                    sx = ti.cast(0, i16)
                    sy = ti.cast(0, i16)
                    for u in ti.static(range(step)):
                        at = (k * step + u) * blocks + b
                        v = ti.cast(ti.cast(stations[m * size + at], i16) << ti.cast(8, i16), i16)
                        sx += high(v, query[at])
                        sy += high(v, query[size + at])
                    x[b] += sx
                    y[b] += sy
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
            top = ti.cast(-32768, i16)
            # a length that the compiler does not know: it unrolls a known one into scalars
            for n in range(length):
                p = even_sine[n] + odd_sine[n]
                q = even_sine[n] - odd_sine[n]
                near = even[n] + odd[n] + ti.max(p, -p)
                far = even[n] - odd[n] + ti.max(q, -q)
                top = ti.max(top, ti.max(near, far))
            out[m] = ti.cast(top, i32)

    return best


def __getattr__(name):
    """Return the kernel ``screen_<rows>_<blocks>_<lanes>``: a kernel's local vectors have fixed lengths."""
    kind, _, sizes = name.partition("_")
    if kind != "screen":
        raise AttributeError(name)
    return _screen(*map(int, sizes.split("_")))
