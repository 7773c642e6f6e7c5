# mypy: ignore-errors
"""Taichi source of rays.py: each ray descends the tree, nearer child first, and ascends by the nodes' numbers."""

from coview_kernels import runtime
from coview_kernels.reference.rays import EDGE, LEAST, THIN

ti = runtime.library()

FLOATS = ti.types.ndarray(ti.f32, 1)
WHOLES = ti.types.ndarray(ti.i32, 1)

NOWHERE = 1e30  # metres
SLACK = 1e-6  # metres, and share of a distance: more than float32 rounding moves a side of a box


@ti.func
def three(numbers: ti.template(), at):
    """Return three numbers from index ``at`` on."""
    return ti.Vector([ti.cast(numbers[at + d], ti.f64) for d in ti.static(range(3))])


@ti.func
def met(corners: ti.template(), at, o, d) -> ti.f64:
    """Return the distance to the triangle with corners at index ``at``, or :data:`NOWHERE`."""
    corner = three(corners, at)
    one, other = three(corners, at + 3) - corner, three(corners, at + 6) - corner
    side = d.cross(other)
    size = one.dot(side)
    distance = ti.cast(NOWHERE, ti.f64)
    if ti.abs(size) > THIN:
        gap = o - corner
        turned = gap.cross(one)
        u, v, t = gap.dot(side) / size, d.dot(turned) / size, other.dot(turned) / size
        if u >= -EDGE and v >= -EDGE and u + v - 1.0 <= EDGE and t >= 0.0:
            distance = t
    return distance


@ti.func
def enters(boxes: ti.template(), at, o, whole, best):
    """Return whether a ray enters the box with sides at index ``at`` nearer than ``best``; all in float32.

    ``whole`` is one over the ray's direction. Minima and maxima are written out: the library's NaN checks cost half.
    """
    near, far = ti.cast(0.0, ti.f32), best
    for k in ti.static(range(3)):
        one, other = (boxes[at + k] - o[k]) * whole[k], (boxes[at + 3 + k] - o[k]) * whole[k]
        first, last = ti.select(one < other, one, other), ti.select(one < other, other, one)
        near, far = ti.select(first > near, first, near), ti.select(last < far, last, far)
    return near <= far + ti.cast(SLACK, ti.f32) * (1 + far)


@runtime.kernel
def cast(boxes: FLOATS, axes: WHOLES, corners: FLOATS, rays: FLOATS, distance: FLOATS, found: WHOLES):
    """Write the distance to the first triangle on each ray, and its place among the corners (-1: none)."""
    for n in range(distance.shape[0]):
        leaves = axes.shape[0]
        size = corners.shape[0] // 9 // leaves
        o, d = three(rays, 6 * n), three(rays, 6 * n + 3)
        start, whole = ti.cast(o, ti.f32), ti.Vector.zero(ti.f32, 3)
        for k in ti.static(range(3)):
            whole[k] = ti.cast(1.0 / ti.select(ti.abs(d[k]) > LEAST, d[k], LEAST), ti.f32)
        best, place, at = ti.cast(NOWHERE, ti.f64), -1, 1
        while at > 0:
            inside = enters(boxes, 6 * at, start, whole, ti.cast(best, ti.f32))
            if inside and at < leaves:
                at = 2 * at + ti.cast(rays[6 * n + 3 + axes[at]] < 0, ti.i32)
            else:
                if inside:
                    for k in range(size):
                        triangle = (at - leaves) * size + k
                        t = met(corners, 9 * triangle, o, d)
                        if t < best:
                            best, place = t, triangle
                # up while this is the second child of its parent, then to the sibling
                while at > 1 and (at & 1) != ti.cast(rays[6 * n + 3 + axes[at >> 1]] < 0, ti.i32):
                    at >>= 1
                at = ti.select(at > 1, at ^ 1, 0)
        distance[n] = ti.select(place < 0, ti.cast(ti.math.inf, ti.f32), ti.cast(best, ti.f32))
        found[n] = place
