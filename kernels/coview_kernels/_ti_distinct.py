# mypy: ignore-errors
"""Taichi source of distinct.py."""

from coview_kernels import runtime

ti = runtime.library()
f32, i32 = ti.f32, ti.i32

FLOATS = ti.types.ndarray(f32, 1)
WHOLES = ti.types.ndarray(i32, 1)


@runtime.kernel
def distinct(
    poses: FLOATS, kept: FLOATS, chosen: WHOLES, found: WHOLES, size: i32, count: i32, square: f32, cosine: f32
):
    """Write the indices of the chosen poses, and their number to ``found``; ``kept`` is working memory (5, count)."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        n = 0
        for k in range(size):
            x, y, z, c, s = poses[k * 5], poses[k * 5 + 1], poses[k * 5 + 2], poses[k * 5 + 3], poses[k * 5 + 4]
            same = 0
            if n < count:
                for j in range(n):
                    dx = kept[j] - x
                    dy = kept[count + j] - y
                    dz = kept[2 * count + j] - z
                    near = dx * dx + dy * dy + dz * dz < square
                    turned = kept[3 * count + j] * c + kept[4 * count + j] * s > cosine
                    same += ti.cast(near and turned, i32)
                if same == 0:
                    kept[n] = x
                    kept[count + n] = y
                    kept[2 * count + n] = z
                    kept[3 * count + n] = c
                    kept[4 * count + n] = s
                    chosen[n] = k
                    n += 1
        found[0] = n
