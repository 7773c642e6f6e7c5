# mypy: ignore-errors
"""Taichi source of windows.py: products of 32 numbers (four cells) at a time in a local vector.

A store to an argument is never vectorised, a loop over a local vector is. Of 8, 16, 32 and 64 numbers only 32 become
whole registers: 1.3 us for a window of 33 x 33 cells, 5 us and more with the others.
"""

from coview_kernels import runtime

ti = runtime.library()
i8, i32 = ti.i8, ti.i32
LANES, DIMENSIONS = 32, 8  # as in windows.py
SERIAL = runtime.workers() == 1  # waking the pool costs 50 us even for one thread

BYTES = ti.types.ndarray(i8, 1)
WHOLES = ti.types.ndarray(i32, 1)


@runtime.kernel
def products(
    raster: BYTES, wide: i32, images: BYTES, stride: i32, spans: WHOLES, first: WHOLES, which: WHOLES, out: WHOLES
):
    """Sum the products of windows that begin at index ``first`` of the raster; rows are ``stride`` numbers long.

    ``spans``: for each row of the images, the first chunk of LANES that is not all 0, and the chunk after the last.
    """
    if ti.static(SERIAL):
        ti.loop_config(serialize=True)
    for n in range(which.shape[0]):
        total = ti.Vector.zero(i32, LANES)
        for i in range(spans.shape[0] // 2):
            a = first[n] + i * wide
            b = (which[n] * (spans.shape[0] // 2) + i) * stride
            for j in range(spans[2 * i], spans[2 * i + 1]):
                for d in range(LANES):
                    k = j * LANES + d
                    total[d] += ti.cast(raster[a + k], i32) * ti.cast(images[b + k], i32)
        for d in ti.static(range(DIMENSIONS)):
            out[n * DIMENSIONS + d] = (
                total[d] + total[DIMENSIONS + d] + total[2 * DIMENSIONS + d] + total[3 * DIMENSIONS + d]
            )
