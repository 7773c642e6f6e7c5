"""The graph: poses of a chain of keyframes, from odometry between them and registrations to the map.

Unknown are the poses ``T_map_body`` of successive keyframes. With e(A, B) = log(A^-1 B), the difference of two poses in
the tangent of the body, it holds the most probable ones given

* a prior on the first: e(T_prior, X_0) ~ N(0, P)
* odometry: e(Z_k, X_{k-1}^-1 X_k) ~ N(0, Q_k)
* registrations: e(Y_k, X_k) ~ N(0, R_k), under Huber's kernel on the whitened residual

Only the newest pose is asked for, where filtering and smoothing are the same; smoothing the ones before is what lets a
registration be weighed again in the light of later ones.
"""

from __future__ import annotations

from typing import Protocol

from coview_stream.config import GraphConfig
from coview_stream.errors import DependencyError
from coview_stream.geometry import Pose
from coview_stream.pose.chain import Estimate
from coview_stream.pose.graph_numpy import NumpySmoother
from coview_stream.pose.tangent import Matrix6

__all__ = ["Estimate", "Smoother", "make_smoother"]


class Smoother(Protocol):
    """Poses of a chain of keyframes, and how sure the newest is.

    All covariances are (6, 6) over (rx, ry, rz, x, y, z), radians and metres, *along the map's axes*: the body turns
    about its own origin, then it is shifted. Poses are (4, 4) float64. Not safe for use by two threads at once.

    Every method that takes a pose or a covariance raises InputError, and changes nothing, where the pose is not rigid
    or the covariance not positive definite; every one that needs a keyframe RuntimeError before the first ``start``.
    """

    def __len__(self) -> int:
        """Keyframes held: bounded, however long the robot drives; zero before ``start`` and after ``clear``."""

    def clear(self) -> None:
        """Forget everything."""

    def start(self, T_map_body: Pose, covariance: Matrix6) -> None:
        """Begin a new chain: all that is known is that the body is here.

        After a (re-)localization, too: nothing of an older chain is carried over.

        Args:
            T_map_body: (4, 4) of the first keyframe.
            covariance: of the prior.
        """

    def move(self, T_between: Pose, covariance: Matrix6) -> None:
        """Add a keyframe: odometry has moved on.

        Args:
            T_between: (4, 4) the new body in the frame of the newest keyframe's, ``inverse(T_odom_last) @ T_odom_new``.
            covariance: of the new pose if the last one were known, along the map's axes as the estimate has them now
                (see :func:`coview_stream.pose.drift.Drift.covariance`).
        """

    def correct(self, T_map_body: Pose, covariance: Matrix6) -> None:
        """Tell where a registration found the newest keyframe, under Huber's kernel.

        Args:
            T_map_body: (4, 4) as the map alone has it: a pose in whose search the prediction took part counts it
                twice (see :func:`coview_stream.pose.covariance.without_prior`).
            covariance: of that measurement alone (see :func:`coview_stream.pose.covariance.registration_covariance`).
        """

    @property
    def estimate(self) -> Estimate:
        """Pose and covariance of the newest keyframe: the prediction after ``move``, corrected after ``correct``."""

    def innovation(self, T_map_body: Pose, covariance: Matrix6) -> float:
        """Squared Mahalanobis distance of a measurement from the present estimate; ask before ``correct``.

        If both covariances are right it is chi-square with 6 degrees of freedom: 12.6 is exceeded by one in twenty,
        22.5 by one in a thousand.

        Args:
            T_map_body: (4, 4) measured pose of the newest keyframe.
            covariance: of that measurement alone.
        """


def make_smoother(config: GraphConfig | None = None) -> Smoother:
    """Return an empty smoother, gtsam's where it can be imported unless the configuration says otherwise.

    Raises:
        DependencyError: the configuration asks for gtsam, which cannot be imported.
    """
    config = config or GraphConfig()
    if config.backend != "numpy":
        from coview_stream.pose.graph_gtsam import GtsamSmoother

        try:
            return GtsamSmoother(config)
        except ImportError as error:
            if config.backend == "gtsam":
                raise DependencyError(
                    f"gtsam cannot be imported ({error}); pip install gtsam, or set GraphConfig.backend to numpy"
                ) from error
    return NumpySmoother(config)
