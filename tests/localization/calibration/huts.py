"""Sites of huts on open ground, 60 x 60 m."""

import numpy as np

GROUND = np.stack(np.meshgrid(*[np.arange(-30, 30, 0.5)] * 2), axis=-1).reshape(-1, 2)
"""Where ground points lie, metres."""


def with_huts(ground, huts, roofs=True):
    """Points (N, 3), normals (N, 3) and which stand above the ground.

    ``ground`` (N,) are the heights of GROUND; ``huts`` rows of x, y, foot and height; ``roofs`` puts flat tops on them.
    """
    parts = [(np.column_stack([GROUND, ground]), (0, 0, 1))]
    side = np.arange(-1.5, 1.6, 0.25)
    for x, y, foot, height in huts:
        along, up = (v.ravel() for v in np.meshgrid(side, np.arange(0.6, height, 0.25)))
        parts.append((np.column_stack([x + 0 * along, y + along, foot + up]), (1, 0, 0)))
        if roofs:
            u, v = (w.ravel() for w in np.meshgrid(side, side))
            parts.append((np.column_stack([x + u, y + v, np.full(u.size, foot + height)]), (0, 0, 1)))
    points = np.concatenate([part for part, _ in parts]).astype(np.float32)
    normals = np.concatenate([np.tile(np.float32(n), (len(part), 1)) for part, n in parts])
    return points, normals, np.arange(len(points)) >= len(GROUND)
