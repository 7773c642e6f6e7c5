"""The graph on gtsam's iSAM2, begun anew from time to time so that its memory stays bounded.

gtsam's own fixed-lag smoother would do that too, but is known to leak and to lose keys (gtsam issues 1452, 1638 and
1935). gtsam has no types that mypy reads everywhere, hence ``Any`` in this file, and in no other.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from coview_stream.config import GraphConfig
from coview_stream.pose.chain import Chain, Gaussian, Keyframe

_RELINEARIZE = 3e-4  # metres and radians that a pose moves before its factors are weighed again
_MOST_UPDATES = 3  # more move the newest pose by less than a hundredth of its sigma


class GtsamSmoother(Chain):
    """Incremental smoothing; see :class:`coview_stream.pose.graph.Smoother`. ImportError where gtsam is missing."""

    def __init__(self, config: GraphConfig) -> None:
        super().__init__(config, config.restart)
        import gtsam

        self._gtsam: ModuleType = gtsam
        self._isam: Any = None
        self._graph: Any = None  # not handed over yet
        self._values: Any = None

    def _forget(self) -> None:
        self._isam = self._graph = self._values = None

    def _begin(self, prior: Gaussian) -> None:
        gtsam = self._gtsam
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(_RELINEARIZE)
        parameters.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(parameters)
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(prior.T), self._noise(prior)))
        self._values.insert(0, gtsam.Pose3(self._keyframes[0].T))
        # the prior has what was measured at the first
        for key, item in enumerate(self._keyframes[1:], start=1):
            self._add(key, item)
            for measured in item.corrections:
                self._add_correction(key, measured)
        self._update()

    def _moved(self) -> None:
        self._add(len(self._keyframes) - 1, self._keyframes[-1])

    def _corrected(self) -> None:
        self._add_correction(len(self._keyframes) - 1, self._keyframes[-1].corrections[-1])

    def _solve(self) -> Gaussian:
        self._update()
        key = len(self._keyframes) - 1
        T = np.asarray(self._isam.calculateEstimatePose3(key).matrix())
        return Gaussian(T, np.asarray(self._isam.marginalCovariance(key)))

    def _settle(self) -> None:
        self._update()
        values = self._isam.calculateEstimate()
        for key, item in enumerate(self._keyframes):
            item.T = np.asarray(values.atPose3(key).matrix())

    def _update(self) -> None:
        """Hand over what has gathered since the last time, and linearise again what that moves."""
        self._isam.update(self._graph, self._values)
        self._graph, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        for _ in range(_MOST_UPDATES):
            if not self._isam.update().getVariablesRelinearized():
                break

    def _noise(self, measured: Gaussian) -> Any:
        return self._gtsam.noiseModel.Gaussian.Covariance(measured.covariance)

    def _add(self, key: int, item: Keyframe) -> None:
        assert item.between is not None  # all but the first have one
        pose = self._gtsam.Pose3(item.between.T)
        self._values.insert(key, self._gtsam.Pose3(item.T))
        self._graph.add(self._gtsam.BetweenFactorPose3(key - 1, key, pose, self._noise(item.between)))

    def _add_correction(self, key: int, measured: Gaussian) -> None:
        model = self._gtsam.noiseModel
        kernel = model.mEstimator.Huber.Create(self.config.huber)
        robust = model.Robust.Create(kernel, self._noise(measured))
        self._graph.add(self._gtsam.PriorFactorPose3(key, self._gtsam.Pose3(measured.T), robust))
