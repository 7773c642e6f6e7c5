# mypy: ignore-errors
"""Taichi source of covisibility.py: a grid per iteration, sectors one after the other."""

from coview_kernels import runtime

ti = runtime.library()


@ti.func
def rises(h, a, best_h, best_a) -> ti.i32:
    """Whether slope h / a exceeds that of the horizon, by products that are exact; see reference/."""
    return ti.cast(best_a == 0, ti.i32) | ti.cast(h * best_a > a * best_h, ti.i32)


@ti.kernel
def coview(
    highest: ti.types.ndarray(ti.f32, 3),
    total: ti.types.ndarray(ti.f32, 3),
    count: ti.types.ndarray(ti.i32, 3),
    vertical: ti.i32,
    hide: ti.i32,
    scale: ti.i32,
    eye: ti.f64,
    value: ti.types.ndarray(ti.f32, 3),
):
    """Write the context. vertical: 0 off, 1 greatest, 2 mean height; hide 0: every occupied bin is visible.

    Slopes are (h - eye) / (scale * i + 1) with i from 0: scale 1 is mode paper, 2 is mode eye, doubled.
    """
    rings = highest.shape[1]
    sectors = highest.shape[2]
    for m in range(highest.shape[0]):
        points = ti.cast(0, ti.i64)
        for i in range(rings):
            for j in range(sectors):
                points += ti.max(count[m, i, j], 0)
        for j in range(sectors):
            best_h = ti.cast(0.0, ti.f64)
            best_a = 0
            for i in range(rings):
                n = count[m, i, j]
                out = ti.cast(0.0, ti.f32)
                if n > 0:
                    top = highest[m, i, j]
                    h = ti.cast(top, ti.f64) - eye
                    a = scale * i + 1
                    if hide == 0 or rises(h, a, best_h, best_a) != 0:
                        best_h = h
                        best_a = a
                        out = top
                    elif vertical != 0 and ti.cast(n, ti.i64) * (rings * sectors) >= points:
                        out = top
                        if vertical == 2:
                            out = ti.cast(ti.cast(total[m, i, j], ti.f64) / n, ti.f32)
                value[m, i, j] = out
