# mypy: ignore-errors
"""Taichi source of rays.py: each ray goes down the tree, the nearer child first, and up again by the nodes' numbers."""

from coview_kernels import runtime
from coview_kernels.reference.rays import EDGE, LEAST, SLACK, THIN

ti = runtime.library()

FLOATS = ti.types.ndarray(ti.f32, 1)
WHOLES = ti.types.ndarray(ti.i32, 1)

NOWHERE = 1e30  # metres


@ti.func
def three(numbers: ti.template(), at):
    """Return the three numbers from ``at`` on."""
    return ti.Vector([ti.cast(numbers[at + d], ti.f64) for d in ti.static(range(3))])


@ti.func
def met(corners: ti.template(), at, o, d) -> ti.f64:
    """Return the distance to the triangle whose corners stand at ``at``, or :data:`NOWHERE`."""
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


@runtime.kernel
def cast(boxes: FLOATS, axes: WHOLES, corners: FLOATS, rays: FLOATS, distance: FLOATS, found: WHOLES):
    """Write the distance to the first triangle of each ray, and its place among the corners (-1: none)."""
    for n in range(distance.shape[0]):
        leaves = axes.shape[0]
        size = corners.shape[0] // 9 // leaves
        o, d = three(rays, 6 * n), three(rays, 6 * n + 3)
        whole = ti.Vector.zero(ti.f64, 3)
        for k in ti.static(range(3)):
            whole[k] = 1.0 / ti.select(ti.abs(d[k]) > LEAST, d[k], LEAST)
        best, place, at = ti.cast(NOWHERE, ti.f64), -1, 1
        while at > 0:
            one, other = (three(boxes, 6 * at) - o) * whole, (three(boxes, 6 * at + 3) - o) * whole
            near = ti.max(ti.min(one, other).max(), 0.0)
            far = ti.min(ti.max(one, other).min(), best)
            inside = near <= far + SLACK * (1.0 + ti.abs(far))
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
