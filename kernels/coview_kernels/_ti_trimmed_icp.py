# mypy: ignore-errors
"""Taichi source of trimmed_icp.py: one pass, sums in registers, one row of partial sums per chunk."""

from coview_kernels import runtime

ti = runtime.library()


@ti.func
def moved(T: ti.template(), source: ti.template(), i):
    x = ti.cast(source[i, 0], ti.f64)
    y = ti.cast(source[i, 1], ti.f64)
    z = ti.cast(source[i, 2], ti.f64)
    return ti.Vector(
        [
            T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
            T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
        ]
    )


@ti.func
def row(array: ti.template(), i):
    return ti.Vector([ti.cast(array[i, d], ti.f64) for d in ti.static(range(3))])


@ti.func
def is_finite(value) -> ti.i32:
    # by its bits: a host program may have told the compiler that there are no NaNs
    return ti.cast(((ti.bit_cast(value, ti.i64) >> 52) & 0x7FF) != 0x7FF, ti.i32)


@ti.kernel
def point_to_plane(
    source: ti.types.ndarray(ti.f32, 2),
    target: ti.types.ndarray(ti.f32, 2),
    normals: ti.types.ndarray(ti.f32, 2),
    weights: ti.types.ndarray(ti.f32, 1),
    T: ti.types.ndarray(ti.f64, 2),
    centre: ti.types.ndarray(ti.f64, 1),
    sums: ti.types.ndarray(ti.f64, 2),
):
    """Leave in sums: the upper triangle of H by rows (21), b (6), cost."""
    chunks = sums.shape[0]
    n = source.shape[0]
    step = (n + chunks - 1) // chunks
    middle = ti.Vector([centre[0], centre[1], centre[2]])
    ti.loop_config(block_dim=1)
    for c in range(chunks):
        acc = ti.Vector.zero(ti.f64, 28)
        for i in range(ti.min(n, c * step), ti.min(n, (c + 1) * step)):
            w = ti.cast(weights[i], ti.f64)
            if w != 0:
                y = moved(T, source, i)
                q = row(target, i)
                normal = row(normals, i)
                if is_finite(y.sum() + q.sum() + normal.sum() + w) != 0:
                    r = normal.dot(y - q)
                    turn = (y - middle).cross(normal)
                    J = ti.Vector([turn[0], turn[1], turn[2], normal[0], normal[1], normal[2]])
                    for a in ti.static(range(6)):
                        wa = w * J[a]
                        for b in ti.static(range(a, 6)):
                            acc[ti.static(6 * a - a * (a - 1) // 2 + b - a)] += wa * J[b]
                        acc[21 + a] += wa * r
                    acc[27] += w * r * r
        for k in ti.static(range(28)):
            sums[c, k] = acc[k]


@ti.kernel
def point_to_point(
    source: ti.types.ndarray(ti.f32, 2),
    target: ti.types.ndarray(ti.f32, 2),
    weights: ti.types.ndarray(ti.f32, 1),
    T: ti.types.ndarray(ti.f64, 2),
    centre: ti.types.ndarray(ti.f64, 1),
    sums: ti.types.ndarray(ti.f64, 2),
):
    """Leave in sums: w, w arm (3), w arm arm^T upper triangle (6), w arm x e (3), w e (3), cost."""
    chunks = sums.shape[0]
    n = source.shape[0]
    step = (n + chunks - 1) // chunks
    middle = ti.Vector([centre[0], centre[1], centre[2]])
    ti.loop_config(block_dim=1)
    for c in range(chunks):
        acc = ti.Vector.zero(ti.f64, 17)
        for i in range(ti.min(n, c * step), ti.min(n, (c + 1) * step)):
            w = ti.cast(weights[i], ti.f64)
            if w != 0:
                y = moved(T, source, i)
                e = y - row(target, i)
                if is_finite(e.sum() + w) != 0:
                    arm = y - middle
                    torque = arm.cross(e)
                    acc[0] += w
                    for a in ti.static(range(3)):
                        wa = w * arm[a]
                        acc[1 + a] += wa
                        for b in ti.static(range(a, 3)):
                            acc[ti.static(4 + 3 * a - a * (a - 1) // 2 + b - a)] += wa * arm[b]
                        acc[10 + a] += w * torque[a]
                        acc[13 + a] += w * e[a]
                    acc[16] += w * e.dot(e)
        for k in ti.static(range(17)):
            sums[c, k] = acc[k]
