"""Pose graph while tracking: a chain of keyframes, and the covariance of the newest.

The unknowns are the poses X_k = ``T_map_body`` of successive keyframes. With e(A, B) = log(A^-1 B), the difference of
two poses in the tangent of the body, the estimate is the most probable chain given

* a prior on the first: e(T_prior, X_0) ~ N(0, P)
* odometry: e(Z_k, X_{k-1}^-1 X_k) ~ N(0, Q_k)
* registrations: e(Y_k, X_k) ~ N(0, R_k), under Huber's kernel on the whitened residual

Gauss-Newton on X_k exp(xi_k) finds it. The linear problem of each step is a chain with block tridiagonal normal
equations: a Kalman filter and the backward recursion of Rauch, Tung and Striebel solve it exactly (Bell, "The iterated
Kalman smoother as a Gauss-Newton method", SIAM J. Optimization 1994; Barfoot, State Estimation for Robotics, chapter
3). With the residual e, its derivative D (:func:`~coview_stream.geometry.transforms.log_se3`), and w the kernel's
weight, min(1, 3.5 / |R^-1/2 e|), of iteratively reweighted least squares:

    odometry       m' = F m - D^-1 e,  P' = F P F^T + D^-1 Q D^-T          F = Ad(X_k^-1 X_{k-1})
    registration   m = m' - G (D^-1 e + m'),  P = G C                      C = D^-1 R D^-T / w,  G = P' (P' + C)^-1
    backwards      xi_{k-1} = m_{k-1} + P_{k-1} F^T P'^-1 (xi_k - m')

A new measurement moves only the newest poses: those that move noticeably are linearised again, and the filter runs
again from the first of them, as in iSAM2 (Kaess et al., IJRR 2012). Only the newest pose is used; smoothing the earlier
ones reweighs their registrations.

Memory is bounded: the keyframes older than the window are replaced by the *filtered* belief of the window's first, from
the measurements up to it. For a chain this is exact up to linearisation, as past and future meet in one pose; its
smoothed belief would count the later measurements twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import (
    Pose,
    adjoint,
    along_body,
    along_map,
    boxminus,
    inverse,
    log_se3,
    moved,
    orthonormal,
    relative,
)
from coview_stream.geometry.validation import check_covariance, check_rigid

HUBER = 3.5
"""Sigmas beyond which a registration's pull grows no more: the norm of six residuals at once, 2.4 on average and above
this in one case of twenty; the usual 1.345 is meant for one residual. With an optimistic covariance, a redescending
kernel would lock out the map for good."""

_RELINEARIZE = 3e-4  # metres and radians that a pose moves before its factors are linearised again
_MAX_UPDATES = 3  # more would move the newest pose by less than a hundredth of its sigma


class Estimate(NamedTuple):
    """A pose and its covariance."""

    T_map_body: Pose  # (4, 4) float64
    covariance: Floats  # (6, 6) over (rx, ry, rz, x, y, z): rotation about the body, then a shift, along the map's axes

    def innovation(self, T_map_body: Pose, covariance: Floats) -> float:
        """Squared Mahalanobis distance to a measured pose (4, 4), with the covariance of that measurement alone.

        With correct covariances it is chi-square with 6 degrees of freedom: 12.6 is exceeded by one in twenty, 22.5 by
        one in a thousand.
        """
        gap: Floats = boxminus(T_map_body, self.T_map_body)
        return float(gap @ np.linalg.solve(self.covariance + covariance, gap))


class _Gaussian(NamedTuple):
    """A pose and its covariance (6, 6) along the axes of its own body, unlike an :class:`Estimate`'s."""

    T: Pose
    covariance: Floats


class _Step(NamedTuple):
    """Belief about a step xi from the linearisation point of a keyframe."""

    mean: Floats  # (6,)
    covariance: Floats  # (6, 6)


@dataclass
class _Keyframe:
    """One pose of the chain; its filtered estimate is that of the last run."""

    T: Pose  # (4, 4) T_map_body, the linearisation point
    between: _Gaussian  # this body in the frame of the previous one, or of the map for the first
    corrections: list[_Gaussian] = field(default_factory=list)  # measured poses in the map
    F: Floats = field(init=False)  # (6, 6)
    predicted: _Step = field(init=False)
    filtered: _Step = field(init=False)


class PoseGraph:
    """Poses of a chain of keyframes, and the covariance of the newest.

    All poses and covariances are as in :class:`Estimate`. Not thread-safe.

    A pose that is not rigid or a covariance that is not positive definite raises InputError and changes nothing; a
    method that needs a keyframe raises RuntimeError before the first ``start``.
    """

    def __init__(self, window: int = 40) -> None:
        """Smooth the newest ``window`` keyframes; older ones are condensed into the belief of the window's first."""
        self._window = window
        self._keyframes: list[_Keyframe] = []
        self._newest_belief: _Gaussian | None = None
        self._stale = 0  # first keyframe that has changed since the last run of the filter

    def __len__(self) -> int:
        """Keyframes kept: at most ``window``, however long the robot drives; zero before ``start``."""
        return len(self._keyframes)

    def start(self, T_map_body: Pose, covariance: Floats) -> None:
        """Start a new chain with a prior on the first pose, dropping the old one."""
        T = check_rigid(T_map_body, "T_map_body")
        prior = _Gaussian(T, along_body(check_covariance(covariance, "covariance"), T))
        self._keyframes, self._newest_belief, self._stale = [_Keyframe(T, prior)], prior, 0

    def move(self, T_between: Pose, covariance: Floats) -> None:
        """Add a keyframe by odometry from the newest.

        ``T_between`` (4, 4) is the new body in the newest keyframe's frame, ``inverse(T_odom_last) @ T_odom_new``, and
        ``covariance`` that of the new pose if the last one were known.
        """
        step = check_rigid(T_between, "T_between")
        spread = check_covariance(covariance, "covariance")
        before = self._belief()
        T = orthonormal(before.T @ step)
        between = _Gaussian(step, along_body(spread, T))
        self._keyframes.append(_Keyframe(T, between))
        # odometry alone does not change earlier poses, so there is nothing to solve
        F = adjoint(inverse(step))
        self._newest_belief = _Gaussian(T, F @ before.covariance @ F.T + between.covariance)
        if len(self) > self._window:
            self._filter()
            del self._keyframes[0]
            first = self._keyframes[0]
            first.between = _Gaussian(moved(first.T, first.filtered.mean), first.filtered.covariance)
            first.corrections, self._stale = [], len(self)

    def correct(self, T_map_body: Pose, covariance: Floats) -> None:
        """Add a registration of the newest keyframe, under Huber's kernel.

        Its prior must be removed, or it counts twice
        (:func:`coview_stream.localization.registration.register.remove_prior`).
        """
        T = check_rigid(T_map_body, "T_map_body")
        spread = check_covariance(covariance, "covariance")
        self._newest.corrections.append(_Gaussian(T, along_body(spread, T)))
        self._newest_belief, self._stale = None, min(self._stale, len(self) - 1)

    @property
    def estimate(self) -> Estimate:
        """Pose and covariance of the newest keyframe: the prediction after ``move``, corrected after ``correct``."""
        belief = self._belief()
        return Estimate(belief.T.copy(), along_map(belief.covariance, belief.T))

    @property
    def _newest(self) -> _Keyframe:
        if not self._keyframes:
            raise RuntimeError("the graph is empty; call start first")
        return self._keyframes[-1]

    def _belief(self) -> _Gaussian:
        """Return the newest keyframe's pose and covariance; the first call after a correction solves."""
        newest = self._newest
        if self._newest_belief is None:
            self._filter()
            for _ in range(_MAX_UPDATES):
                if not self._relinearize():
                    break
                self._filter()
            self._newest_belief = _Gaussian(moved(newest.T, newest.filtered.mean), newest.filtered.covariance)
        return self._newest_belief

    def _relinearize(self) -> bool:
        """Move the newest keyframes to their smoothed poses, back to the first that hardly moves; True if any moved."""
        xi, steps, item = self._newest.filtered.mean, list[Floats](), self._newest
        while np.abs(xi).max() > _RELINEARIZE:
            steps.append(xi)
            if len(steps) == len(self):
                break
            smoothed = item.F.T @ np.linalg.solve(item.predicted.covariance, xi - item.predicted.mean)
            item = self._keyframes[-1 - len(steps)]
            xi = item.filtered.mean + item.filtered.covariance @ smoothed
        if steps:
            self._stale = len(self) - len(steps)
            items = self._keyframes[self._stale :]
            for item, T in zip(items, moved(np.array([item.T for item in items]), np.array(steps[::-1])), strict=True):
                item.T = T
        return bool(steps)

    def _filter(self) -> None:
        """Linearise the stale keyframes, and filter from the first of them."""
        items = self._keyframes[self._stale :]
        if not items:
            return
        before = self._keyframes[self._stale - 1] if self._stale else None
        T = np.array([np.eye(4) if before is None else before.T, *(item.T for item in items)])
        steps, owners = relative(T[:-1], T[1:]), [k for k, item in enumerate(items) for _ in item.corrections]
        measured = [*(item.between for item in items), *(each for item in items for each in item.corrections)]
        gaps, D = log_se3(relative(np.array([each.T for each in measured]), np.concatenate([steps, T[1:][owners]])))
        spread = np.array([each.covariance for each in measured])
        sigmas = np.sqrt((gaps * np.linalg.solve(spread, gaps[..., None])[..., 0]).sum(axis=-1))
        sigmas[: len(items)] = 0.0  # no kernel on odometry
        J = np.linalg.inv(D)
        means = -(J @ gaps[..., None])[..., 0]
        covariances = J @ spread @ np.swapaxes(J, -1, -2) * np.maximum(1.0, sigmas / HUBER)[:, None, None]
        F, correction = adjoint(relative(steps, np.eye(4))), len(items)
        mean, P = (np.zeros(6), np.zeros((6, 6))) if before is None else before.filtered
        for k, item in enumerate(items):
            mean, P = F[k] @ mean + means[k], F[k] @ P @ F[k].T + covariances[k]
            item.F, item.predicted = F[k], _Step(mean, P)
            for _ in item.corrections:
                C = covariances[correction]
                G = np.linalg.solve(P + C, P).T
                mean, P = mean + G @ (means[correction] - mean), G @ C
                P, correction = 0.5 * (P + P.T), correction + 1
            item.filtered = _Step(mean, P)
        self._stale = len(self)
