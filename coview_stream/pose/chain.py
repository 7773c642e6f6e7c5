"""A chain of keyframes, as every smoother keeps it: what was measured, and what was believed when.

A smoother may forget its past at any keyframe if it puts that keyframe's *filtering* belief in its place: what was
known when the keyframe was the newest, from everything before and at it. For a chain this is exact up to linearisation:
the past meets the future in that one pose. The smoothed belief would be wrong there, as it holds already the later
measurements that stay in the graph, which would then count twice.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from coview_stream.config import GraphConfig
from coview_stream.geometry import Pose, inverse, orthonormal
from coview_stream.pose.tangent import (
    Matrix6,
    adjoint,
    along_body,
    along_map,
    checked_covariance,
    checked_pose,
    difference,
)


class Estimate(NamedTuple):
    """Where the newest body is, and how sure that is."""

    T_map_body: Pose
    """(4, 4) float64."""
    covariance: Matrix6
    """(6, 6) over (rx, ry, rz, x, y, z): a turn about the body, then a shift, along the map's axes."""


class Gaussian(NamedTuple):
    """A pose and its covariance (6, 6) in the tangent of its own body."""

    T: Pose
    covariance: Matrix6


@dataclass
class Keyframe:
    """One pose of the chain.

    Attributes:
        T: (4, 4) ``T_map_body``, where it is linearised or first was.
        between: this body in the frame of the one before; None for the first.
        corrections: measured poses in the map.
        filtered: what was believed when it was the newest; None while it is.
    """

    T: Pose
    between: Gaussian | None = None
    corrections: list[Gaussian] = field(default_factory=list)
    filtered: Gaussian | None = None


class Chain(ABC):
    """The part of a smoother that does not depend on who solves; see :class:`coview_stream.pose.graph.Smoother`."""

    def __init__(self, config: GraphConfig, most: int) -> None:
        """Keep at most ``most`` keyframes, and ``config.window`` of them when there are more."""
        self.config = config
        self._most = most
        self._keyframes: list[Keyframe] = []
        self._known: Gaussian | None = None

    def __len__(self) -> int:
        """Keyframes held; at most the configuration's bound, zero before the first start."""
        return len(self._keyframes)

    def clear(self) -> None:
        """Forget everything."""
        self._keyframes, self._known = [], None
        self._forget()

    def start(self, T_map_body: Pose, covariance: Matrix6) -> None:
        """See :meth:`coview_stream.pose.graph.Smoother.start`."""
        T = checked_pose("T_map_body", T_map_body)
        prior = Gaussian(T, along_body(checked_covariance("covariance", covariance), T))
        self.clear()
        self._keyframes.append(Keyframe(T))
        self._begin(prior)

    def move(self, T_between: Pose, covariance: Matrix6) -> None:
        """See :meth:`coview_stream.pose.graph.Smoother.move`."""
        step = checked_pose("T_between", T_between)
        spread = checked_covariance("covariance", covariance)
        before = self._belief()
        T = orthonormal(before.T @ step)
        moved = Gaussian(step, along_body(spread, T))
        self._keyframes[-1].filtered = before
        self._keyframes.append(Keyframe(T, moved))
        # odometry alone teaches nothing about the past, so there is nothing to solve
        Ad = adjoint(inverse(step))
        self._known = Gaussian(T, Ad @ before.covariance @ Ad.T + moved.covariance)
        self._moved()
        if len(self._keyframes) > self._most:
            self._settle()
            del self._keyframes[: -self.config.window]
            first = self._keyframes[0]
            assert first.filtered is not None  # a window holds two or more
            self._begin(first.filtered)

    def correct(self, T_map_body: Pose, covariance: Matrix6) -> None:
        """See :meth:`coview_stream.pose.graph.Smoother.correct`."""
        T = checked_pose("T_map_body", T_map_body)
        spread = checked_covariance("covariance", covariance)
        self._newest().corrections.append(Gaussian(T, along_body(spread, T)))
        self._known = None
        self._corrected()

    @property
    def estimate(self) -> Estimate:
        """See :attr:`coview_stream.pose.graph.Smoother.estimate`."""
        known = self._belief()
        return Estimate(known.T.copy(), along_map(known.covariance, known.T))

    def innovation(self, T_map_body: Pose, covariance: Matrix6) -> float:
        """See :meth:`coview_stream.pose.graph.Smoother.innovation`."""
        T = checked_pose("T_map_body", T_map_body)
        spread = checked_covariance("covariance", covariance)
        expected = self.estimate
        gap: npt.NDArray[np.float64] = difference(T, expected.T_map_body)
        return float(gap @ np.linalg.solve(expected.covariance + spread, gap))

    def _newest(self) -> Keyframe:
        if not self._keyframes:
            raise RuntimeError("the graph is empty; call start first")
        return self._keyframes[-1]

    def _belief(self) -> Gaussian:
        """Return what is believed of the newest keyframe, solved for when asked the first time."""
        self._newest()
        if self._known is None:
            self._known = self._solve()
        return self._known

    @abstractmethod
    def _forget(self) -> None:
        """Drop whatever has been built."""

    @abstractmethod
    def _begin(self, prior: Gaussian) -> None:
        """Build anew from the keyframes held; ``prior`` is all that is known of the first, its corrections included."""

    @abstractmethod
    def _moved(self) -> None:
        """Take in the newest keyframe and the motion that leads to it."""

    @abstractmethod
    def _corrected(self) -> None:
        """Take in the newest keyframe's newest correction."""

    @abstractmethod
    def _solve(self) -> Gaussian:
        """Return what is believed of the newest keyframe."""

    @abstractmethod
    def _settle(self) -> None:
        """Write what is believed of all poses into the keyframes, for ``_begin`` to go on from."""
