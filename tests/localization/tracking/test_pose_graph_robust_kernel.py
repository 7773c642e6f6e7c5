"""Why the kernel is Huber's and the covariance inflated: a kernel that lets go, on the raw Hessian, locks the map out.

The inverse Hessian of a registration is some six times too small in sigma. A kernel that lets go of what does not fit
(Geman-McClure, DCS) takes honest registrations for outliers then, odometry goes on alone, and the further it drifts the
less any registration fits. It takes both, the kernel and the raw Hessian; Huber with the raw one is the control that
tells them apart. Largest errors here, in metres, raw and inflated: Geman-McClure 6.27 and 0.23, DCS 6.27 and 0.51,
Huber 0.39 and 0.26. So Huber is the kernel that bears a covariance which is too small. Only Huber's is in the
package; the others are put in its place here.
"""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from graph_drives import START_COVARIANCE, drive, run, shift_errors

from coview_stream.config import GraphConfig
from coview_stream.localization.tracking.pose_graph import PoseGraph

OPTIMISM = 6.0  # of the inverse Hessian, in sigma
HONEST = np.diag([0.002, 0.002, 0.004, 0.06, 0.06, 0.06]) ** 2
RAW = HONEST / OPTIMISM**2
BIAS = np.array([0.0, 0.0, 0.0006, 0.012, -0.008, 0.004])  # per step: odometry drifts by metres
STEPS = np.diag([0.001, 0.001, 0.002, 0.02, 0.02, 0.02]) ** 2
CONFIG = GraphConfig(window=10, restart=20)


def graph_with(kernel):
    """A graph with another kernel than the product's, which lets go beyond three sigmas."""
    graph = PoseGraph(CONFIG)
    graph._kernel = getattr(gtsam.noiseModel.mEstimator, kernel).Create(3.0)
    return graph


@pytest.fixture(scope="module")
def way():
    """100 metres, a registration every metre, one in ten metres off."""
    return drive(200, seed=11, every=2, outliers=0.1, bias=BIAS, odometry=1e-2 * STEPS, registration=HONEST)


def worst(graph, way, registration):
    estimates = run(graph, way, STEPS, registration, START_COVARIANCE)
    return shift_errors(estimates, way.truth)[20:].max()


@pytest.mark.parametrize("kernel", ["GemanMcClure", "DCS"])
def test_redescending_kernel_with_raw_hessian_rejects_all_registrations(way, kernel):
    assert worst(graph_with(kernel), way, RAW) > 2.0


def test_huber_with_raw_hessian_is_worse_but_keeps_registrations(way):
    """The control: the covariances are as wrong as above, so that what locks out is the kernel on top of it."""
    assert worst(PoseGraph(CONFIG), way, RAW) < 0.6


def test_huber_with_inflated_covariance_follows_the_map(way):
    assert worst(PoseGraph(CONFIG), way, HONEST) < 0.35


def test_odometry_alone_is_metres_off(way):
    """Else there would be nothing to lock out of."""
    alone = type(way)(way.truth, way.steps, [None] * len(way.truth))
    assert worst(PoseGraph(CONFIG), alone, RAW) > 2.0
