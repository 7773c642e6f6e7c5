"""Normal equations of eq. 13 in plain NumPy."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, F64


def normal_equations(
    source: F32, target: F32, normals: F32 | None, weights: F32, T: F64, centre: F64
) -> tuple[F64, F64, float]:
    """See :func:`coview_kernels.normal_equations`."""
    usable = (weights != 0) & np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    usable &= np.isfinite(weights)
    if normals is not None:
        usable &= np.isfinite(normals).all(axis=1)
    w = weights[usable].astype(np.float64)
    moved = source[usable].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    error = moved - target[usable].astype(np.float64)
    arm = moved - centre

    if normals is not None:
        n = normals[usable].astype(np.float64)
        r = np.einsum("ij,ij->i", n, error)
        (ax, ay, az), (nx, ny, nz) = arm.T, n.T
        J = np.stack([ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx, nx, ny, nz], axis=1)
        wJ = w[:, None] * J
        return _symmetric(J.T @ wJ), wJ.T @ r, float(w @ (r * r))

    J3 = np.zeros((len(w), 3, 6))  # d(rx x arm)/drx and so on, one row per coordinate
    J3[:, 0, 1], J3[:, 0, 2] = arm[:, 2], -arm[:, 1]
    J3[:, 1, 0], J3[:, 1, 2] = -arm[:, 2], arm[:, 0]
    J3[:, 2, 0], J3[:, 2, 1] = arm[:, 1], -arm[:, 0]
    J3[:, :, 3:] = np.eye(3)
    J = J3.reshape(-1, 6)
    wJ = np.repeat(w, 3)[:, None] * J
    return _symmetric(J.T @ wJ), wJ.T @ error.ravel(), float(w @ (error * error).sum(axis=1))


def _symmetric(H: F64) -> F64:
    """Return the mean of H and its transpose: BLAS rounds the two halves differently."""
    mean: F64 = 0.5 * (H + H.T)
    return mean
