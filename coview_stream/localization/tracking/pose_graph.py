"""Pose graphs on gtsam: while tracking a chain of keyframes, on iSAM2; offline any graph, solved at once.

The unknowns of the chain are the poses ``T_map_body`` of successive keyframes. With e(A, B) = log(A^-1 B), the
difference of two poses in the tangent of the body, the estimate is the most probable one given

* a prior on the first: e(T_prior, X_0) ~ N(0, P)
* odometry: e(Z_k, X_{k-1}^-1 X_k) ~ N(0, Q_k)
* registrations: e(Y_k, X_k) ~ N(0, R_k), under Huber's kernel on the whitened residual

Only the newest pose is used; smoothing the earlier ones reweighs their registrations.

The memory is bounded: at ``restart`` keyframes the graph restarts with the newest ``window`` of them, and the first
one's *filtering* belief, from the measurements up to it, replaces the past. For a chain this is exact up to
linearisation, as past and future meet in one pose; its smoothed belief would count the later measurements twice.
(gtsam's fixed-lag smoother leaks and loses keys: gtsam issues 1452, 1638 and 1935.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from coview_stream.config import GraphConfig
from coview_stream.errors import require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import (
    Pose,
    Poses,
    adjoint,
    along_body,
    along_map,
    boxminus,
    inverse,
    orthonormal,
)
from coview_stream.geometry.validation import check_covariance, check_rigid

_RELINEARIZE = 3e-4  # metres and radians that a pose moves before its factors are linearised again
_MAX_UPDATES = 3  # more move the newest pose by less than a hundredth of its sigma


class Estimate(NamedTuple):
    """A pose and its covariance."""

    T_map_body: Pose
    """(4, 4) float64."""
    covariance: Floats
    """(6, 6) over (rx, ry, rz, x, y, z): a turn about the body, then a shift, along the map's axes."""

    def innovation(self, T_map_body: Pose, covariance: Floats) -> float:
        """Squared Mahalanobis distance of a measured pose (4, 4), with the covariance of that measurement alone.

        If both covariances are right it is chi-square with 6 degrees of freedom: 12.6 is exceeded by one in twenty,
        22.5 by one in a thousand.
        """
        gap: Floats = boxminus(T_map_body, self.T_map_body)
        return float(gap @ np.linalg.solve(self.covariance + covariance, gap))


class _Gaussian(NamedTuple):
    """A pose and its covariance (6, 6), unlike an :class:`Estimate`'s along the axes of its own body, as gtsam's."""

    T: Pose
    covariance: Floats


@dataclass
class _Keyframe:
    """One pose of the chain."""

    T: Pose  # (4, 4) T_map_body, initial or linearised
    between: _Gaussian | None = None  # this body in the frame of the previous one; None for the first
    corrections: list[_Gaussian] = field(default_factory=list)  # measured poses in the map
    filtered: _Gaussian | None = None  # belief when it was the newest; None for the newest


class PoseGraph:
    """Poses of a chain of keyframes, and the covariance of the newest.

    All poses and covariances are as in :class:`Estimate`. Not safe for use by two threads at once.

    A pose that is not rigid or a covariance that is not positive definite raises InputError and changes nothing; a
    method that needs a keyframe raises RuntimeError before the first ``start``.
    """

    def __init__(self, config: GraphConfig | None = None) -> None:
        """Make an empty graph; gtsam is imported here and no earlier.

        Raises:
            DependencyError: gtsam is not installed, or cannot be loaded.
        """
        self.config = config or GraphConfig()
        # gtsam has no types that mypy reads everywhere, hence Any
        self._gtsam: Any = require_library("gtsam", "gtsam>=4.3", "tracking")
        self._kernel: Any = self._gtsam.noiseModel.mEstimator.Huber.Create(self.config.huber)
        self._keyframes: list[_Keyframe] = []
        self._newest_belief: _Gaussian | None = None
        self._isam: Any = None
        self._factors: Any = None  # not handed over to iSAM2 yet, nor are the values
        self._values: Any = None

    def __len__(self) -> int:
        """Keyframes held: at most ``restart``, however long the robot drives; zero before ``start``."""
        return len(self._keyframes)

    def start(self, T_map_body: Pose, covariance: Floats) -> None:
        """Begin a new chain with a prior on the first pose; the old chain is dropped."""
        T = check_rigid(T_map_body, "T_map_body")
        prior = _Gaussian(T, along_body(check_covariance(covariance, "covariance"), T))
        self._keyframes, self._newest_belief = [_Keyframe(T)], None
        self._build(prior)

    def move(self, T_between: Pose, covariance: Floats) -> None:
        """Add a keyframe by odometry from the newest.

        Args:
            T_between: (4, 4) new body in the newest keyframe's frame, ``inverse(T_odom_last) @ T_odom_new``.
            covariance: of the new pose if the last one were known.
        """
        step = check_rigid(T_between, "T_between")
        spread = check_covariance(covariance, "covariance")
        before = self._belief()
        T = orthonormal(before.T @ step)
        moved = _Gaussian(step, along_body(spread, T))
        self._keyframes[-1].filtered = before
        self._keyframes.append(_Keyframe(T, moved))
        # odometry alone does not change earlier poses, so there is nothing to solve
        Ad = adjoint(inverse(step))
        self._newest_belief = _Gaussian(T, Ad @ before.covariance @ Ad.T + moved.covariance)
        self._add_motion(len(self) - 1)
        if len(self) > self.config.restart:  # with the newest keyframes, from the filtering belief of the first
            self._update()
            values = self._isam.calculateEstimate()
            for key, item in enumerate(self._keyframes):
                item.T = np.asarray(values.atPose3(key).matrix())
            del self._keyframes[: -self.config.window]
            first = self._keyframes[0].filtered
            assert first is not None  # a window holds two or more
            self._build(first)

    def correct(self, T_map_body: Pose, covariance: Floats) -> None:
        """Add a registration of the newest keyframe, under Huber's kernel.

        Its prior must be removed, as it would count twice
        (:func:`coview_stream.localization.registration.register.remove_prior`).
        """
        T = check_rigid(T_map_body, "T_map_body")
        spread = check_covariance(covariance, "covariance")
        measured = _Gaussian(T, along_body(spread, T))
        self._newest.corrections.append(measured)
        self._newest_belief = None
        self._add_correction(len(self) - 1, measured)

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
        """Return the newest keyframe's pose and covariance; solves at the first call."""
        if self._newest_belief is None:
            _ = self._newest
            self._update()
            key = len(self) - 1
            T = np.asarray(self._isam.calculateEstimatePose3(key).matrix())
            self._newest_belief = _Gaussian(T, np.asarray(self._isam.marginalCovariance(key)))
        return self._newest_belief

    def _build(self, prior: _Gaussian) -> None:
        """Build iSAM2 from the keyframes; ``prior`` includes the corrections of the first one."""
        gtsam = self._gtsam
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(_RELINEARIZE)
        parameters.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(parameters)
        self._factors, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(prior.T), self._noise(prior)))
        self._values.insert(0, gtsam.Pose3(self._keyframes[0].T))
        for key, item in enumerate(self._keyframes[1:], start=1):
            self._add_motion(key)
            for measured in item.corrections:
                self._add_correction(key, measured)
        self._update()

    def _update(self) -> None:
        """Give iSAM2 the new factors and values, and relinearise the poses that they move."""
        self._isam.update(self._factors, self._values)
        self._factors, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        for _ in range(_MAX_UPDATES):
            if not self._isam.update().getVariablesRelinearized():
                break

    def _noise(self, measured: _Gaussian) -> Any:
        return self._gtsam.noiseModel.Gaussian.Covariance(measured.covariance)

    def _add_motion(self, key: int) -> None:
        item = self._keyframes[key]
        assert item.between is not None  # all but the first have one
        pose = self._gtsam.Pose3(item.between.T)
        self._values.insert(key, self._gtsam.Pose3(item.T))
        self._factors.add(self._gtsam.BetweenFactorPose3(key - 1, key, pose, self._noise(item.between)))

    def _add_correction(self, key: int, measured: _Gaussian) -> None:
        robust = self._gtsam.noiseModel.Robust.Create(self._kernel, self._noise(measured))
        self._factors.add(self._gtsam.PriorFactorPose3(key, self._gtsam.Pose3(measured.T), robust))


@dataclass(frozen=True, eq=False)
class Constraint:
    """Measured pose of one node of a graph, on the map or relative to another node."""

    source: int  # index of the measured node
    target: int  # index of the node that it is measured from; -1: the map
    T: Pose  # (4, 4) pose of the source's body, relative to the target's body or to the map's origin
    covariance: Floats  # (6, 6) of it over (rx, ry, rz, x, y, z), along the axes of the source's body


class BatchGraph:
    """Graph of any constraints, solved at once: the most probable poses, and the covariance of each."""

    def __init__(self, poses: Poses, feature: str) -> None:
        """Begin at poses (N, 4, 4) of the nodes.

        Raises:
            DependencyError: gtsam is missing, which ``feature`` needs.
        """
        self._gtsam: Any = require_library("gtsam", "gtsam>=4.3", feature)
        self._factors, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        for k, T in enumerate(poses):
            self._values.insert(k, self._gtsam.Pose3(T))

    def add(self, constraints: Sequence[Constraint], kernel: tuple[str, float] | None = None) -> None:
        """Add constraints, under a kernel of gtsam's (``"Huber"``, ``"Cauchy"``) with its width in sigmas."""
        gtsam = self._gtsam
        robust = None if kernel is None else getattr(gtsam.noiseModel.mEstimator, kernel[0]).Create(kernel[1])
        for c in constraints:
            noise = gtsam.noiseModel.Gaussian.Covariance(c.covariance)
            noise = noise if robust is None else gtsam.noiseModel.Robust.Create(robust, noise)
            T = gtsam.Pose3(c.T)
            if c.target < 0:
                self._factors.add(gtsam.PriorFactorPose3(c.source, T, noise))
            else:
                self._factors.add(gtsam.BetweenFactorPose3(c.target, c.source, T, noise))

    def solve(self) -> Poses:
        """Return the most probable poses (N, 4, 4)."""
        self._values = self._gtsam.LevenbergMarquardtOptimizer(self._factors, self._values).optimize()
        return np.array([self._values.atPose3(k).matrix() for k in range(self._values.size())]).reshape(-1, 4, 4)

    def covariances(self) -> Floats:
        """Return the covariance (N, 6, 6) of each pose over (rx, ry, rz, x, y, z), along the axes of its body."""
        marginals = self._gtsam.Marginals(self._factors, self._values)
        return np.array([marginals.marginalCovariance(k) for k in range(self._values.size())]).reshape(-1, 6, 6)
