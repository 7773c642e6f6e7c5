"""The graph without gtsam: Gauss-Newton over the newest keyframes, whose normal equations are block tridiagonal.

A pose is measured by itself or against the one before, so the Hessian has 6x6 blocks on its diagonal and beside it. Its
banded Cholesky factor takes time linear in the window, and the factor's last block is all that is left of the others
once they are eliminated front to back: the newest pose's marginal information.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from coview_stream.config import GraphConfig
from coview_stream.geometry import Pose, inverse
from coview_stream.pose.chain import Chain, Gaussian
from coview_stream.pose.tangent import adjoint, log_se3, log_slope
from coview_stream.rotation import exp_so3

Array = npt.NDArray[np.float64]
Kernel = Callable[[Array], Array]
"""Weights in [0, 1] of whitened residual norms, both (C,)."""

_BAND = 11  # diagonals above the main one
_MOST_STEPS = 30
_STOP_SHIFT = 3e-4  # metres; a registration knows centimetres
_STOP_TURN = 3e-5  # radians
_SAME_A, _SAME_B = np.triu_indices(6)
_NEXT_A, _NEXT_B = (index.ravel() for index in np.indices((6, 6)))


def huber(limit: float) -> Kernel:
    """Weights that keep a residual's pull from growing beyond ``limit`` standard deviations."""

    def weights(norms: Array) -> Array:
        return np.asarray(limit / np.maximum(norms, limit))

    return weights


class NumpySmoother(Chain):
    """Iteratively re-weighted Gauss-Newton over the window; same interface and answers as gtsam's."""

    def __init__(self, config: GraphConfig, kernel: Kernel | None = None) -> None:
        """Smooth with another robust ``kernel`` than Huber's, if you know why: see the configuration."""
        super().__init__(config, config.window + max(1, config.window // 4))
        self._kernel = kernel or huber(config.huber)
        self._forget()

    def _forget(self) -> None:
        self._prior: Gaussian | None = None
        self._unary: list[_Factor] = []
        self._between: list[_Factor] = []

    def _begin(self, prior: Gaussian) -> None:
        self._prior = prior
        kept = self._keyframes[1:]
        self._between = [_Factor.of(k, item.between) for k, item in enumerate(kept) if item.between]
        self._unary = [_Factor.of(k, c) for k, item in enumerate(kept, start=1) for c in item.corrections]

    def _moved(self) -> None:
        newest = self._keyframes[-1]
        assert newest.between is not None
        self._between.append(_Factor.of(len(self._keyframes) - 2, newest.between))

    def _corrected(self) -> None:
        self._unary.append(_Factor.of(len(self._keyframes) - 1, self._keyframes[-1].corrections[-1]))

    def _solve(self) -> Gaussian:
        from scipy.linalg import cho_solve_banded, cholesky_banded

        assert self._prior is not None
        X = np.stack([item.T for item in self._keyframes])
        system = _System(self._prior, self._unary, self._between, self._kernel)
        for _ in range(_MOST_STEPS):
            band, gradient = system.at(X)
            factor = cholesky_banded(band, check_finite=False)
            step = -cho_solve_banded((factor, False), gradient, check_finite=False).reshape(-1, 6)
            X[:, :3, 3] += (X[:, :3, :3] @ step[:, 3:, None])[..., 0]
            X[:, :3, :3] = X[:, :3, :3] @ exp_so3(step[:, :3])
            if np.abs(step[:, :3]).max() < _STOP_TURN and np.abs(step[:, 3:]).max() < _STOP_SHIFT:
                break
        for item, T in zip(self._keyframes, X, strict=True):
            item.T = T
        half = np.linalg.inv(_last_block(factor))
        return Gaussian(X[-1].copy(), half @ half.T)

    def _settle(self) -> None:
        """Every solution is written there anyway."""


class _Factor:
    """A measured pose of keyframe ``index``, or of the one after it relative to it."""

    __slots__ = ("T_inverse", "index", "root")

    def __init__(self, index: int, T_inverse: Pose, root: Array) -> None:
        self.index = index
        self.T_inverse = T_inverse
        self.root = root  # (6, 6), its transpose times itself is the information

    @classmethod
    def of(cls, index: int, measured: Gaussian) -> _Factor:
        """Factor of a measured pose."""
        root = np.linalg.inv(np.linalg.cholesky(measured.covariance))
        return cls(index, inverse(measured.T), np.asarray(root, dtype=np.float64))


class _System:
    """Residuals log(Z^-1 X), whitened, and their normal equations at given poses."""

    def __init__(self, prior: Gaussian, unary: list[_Factor], between: list[_Factor], kernel: Kernel) -> None:
        self.kernel = kernel
        first = _Factor.of(0, prior)
        self.at_index, self.T_inverse, self.root = _stacked([first, *unary])
        _, self.step_inverse, self.step_root = _stacked(between)

    def at(self, X: Array) -> tuple[Array, Array]:
        """Hessian in upper banded form (12, 6 N) and gradient (6 N,) at poses (N, 4, 4)."""
        same, following = np.zeros((len(X), 6, 6)), np.zeros((len(X) - 1, 6, 6))
        gradient = np.zeros((len(X), 6))
        residual, J = _whitened(self.T_inverse @ X[self.at_index], self.root)
        weight = np.ones(len(residual))  # the prior stands for many measurements, weighed already
        weight[1:] = self.kernel(np.linalg.norm(residual[1:], axis=1))
        weighted = weight[:, None, None] * J
        J_t = J.transpose(0, 2, 1)
        np.add.at(same, self.at_index, J_t @ weighted)
        np.add.at(gradient, self.at_index, (weighted.transpose(0, 2, 1) @ residual[..., None])[..., 0])
        if len(following):
            relative = _inverses(X[:-1]) @ X[1:]
            residual, J_next = _whitened(self.step_inverse @ relative, self.step_root)
            J_prior = -J_next @ adjoint(_inverses(relative))
            same[:-1] += J_prior.transpose(0, 2, 1) @ J_prior
            same[1:] += J_next.transpose(0, 2, 1) @ J_next
            following = J_prior.transpose(0, 2, 1) @ J_next
            gradient[:-1] += (J_prior.transpose(0, 2, 1) @ residual[..., None])[..., 0]
            gradient[1:] += (J_next.transpose(0, 2, 1) @ residual[..., None])[..., 0]
        return _banded(same, following), gradient.ravel()


def _stacked(factors: list[_Factor]) -> tuple[npt.NDArray[np.int64], Array, Array]:
    index = np.array([f.index for f in factors], dtype=np.int64)
    inverse = np.array([f.T_inverse for f in factors]).reshape(-1, 4, 4)
    return index, inverse, np.array([f.root for f in factors]).reshape(-1, 6, 6)


def _whitened(error: Array, root: Array) -> tuple[Array, Array]:
    """Residuals (F, 6) and Jacobians (F, 6, 6) in the right tangent, of pose errors (F, 4, 4)."""
    xi = log_se3(error)
    return np.asarray((root @ xi[..., None])[..., 0]), np.asarray(root @ log_slope(xi))


def _inverses(T: Array) -> Array:
    answer = np.zeros_like(T)
    R_t = T[:, :3, :3].transpose(0, 2, 1)
    answer[:, :3, :3] = R_t
    answer[:, :3, 3] = -(R_t @ T[:, :3, 3, None])[..., 0]
    answer[:, 3, 3] = 1.0
    return answer


def _banded(same: Array, following: Array) -> Array:
    """Upper banded form of a block tridiagonal matrix: entry (r, c) stands in row 11 + r - c, column c."""
    band = np.zeros((_BAND + 1, len(same), 6))
    band[_BAND + _SAME_A - _SAME_B, :, _SAME_B] = same[:, _SAME_A, _SAME_B].T
    band[_BAND - 6 + _NEXT_A - _NEXT_B, 1:, _NEXT_B] = following[:, _NEXT_A, _NEXT_B].T
    return band.reshape(_BAND + 1, -1)


def _last_block(factor: Array) -> Array:
    """Upper triangle (6, 6) at the end of a banded Cholesky factor."""
    U = np.zeros((6, 6))
    U[_SAME_A, _SAME_B] = factor[_BAND + _SAME_A - _SAME_B, factor.shape[1] - 6 + _SAME_B]
    return U
