"""Why the kernel is Huber's and the covariance inflated: a kernel that lets go, on the raw Hessian, locks the map out.

The inverse Hessian of a registration is some six times too small in sigma. A kernel that lets go of what does not fit
(Geman-McClure, DCS) takes honest registrations for outliers then, odometry goes on alone, and the further it drifts the
less any registration fits. It takes both, the kernel and the raw Hessian; Huber with the raw one is the control that
tells them apart. Largest errors here, in metres, raw and inflated: Geman-McClure 6.27 and 0.24, DCS 6.27 and 0.51,
Huber 0.44 and 0.26. So Huber is the kernel that bears a covariance which is too small. Only the product's kernel is in
the package; the others are written out here.
"""

from __future__ import annotations

import numpy as np
import pytest
from chains import START_COVARIANCE, drive, run, shift_errors

from coview_stream.config import GraphConfig
from coview_stream.pose.graph import make_smoother
from coview_stream.pose.graph_numpy import NumpySmoother

OPTIMISM = 6.0  # of the inverse Hessian, in sigma
HONEST = np.diag([0.002, 0.002, 0.004, 0.06, 0.06, 0.06]) ** 2
RAW = HONEST / OPTIMISM**2
BIAS = np.array([0.0, 0.0, 0.0006, 0.012, -0.008, 0.004])  # per step: odometry drifts by metres
STEPS = np.diag([0.001, 0.001, 0.002, 0.02, 0.02, 0.02]) ** 2
CONFIG = GraphConfig(window=10, restart=20)


def geman_mcclure(norms, limit=3.0):
    return (limit**2 / (limit**2 + norms**2)) ** 2


def dynamic_covariance_scaling(norms, limit=3.0):
    return np.minimum(1.0, 2.0 * limit / (limit + norms**2)) ** 2


@pytest.fixture(scope="module")
def way():
    """100 metres, a registration every metre, one in ten metres off."""
    return drive(200, seed=11, every=2, outliers=0.1, bias=BIAS, odometry=1e-2 * STEPS, registration=HONEST)


def worst(smoother, way, registration):
    estimates = run(smoother, way, STEPS, registration, START_COVARIANCE)
    return shift_errors(estimates, way.truth)[20:].max()


@pytest.mark.parametrize("kernel", [geman_mcclure, dynamic_covariance_scaling])
def test_a_redescending_kernel_with_the_raw_hessian_locks_the_map_out(way, kernel):
    assert worst(NumpySmoother(CONFIG, kernel), way, RAW) > 2.0


def test_huber_with_the_raw_hessian_is_worse_but_not_locked_out(way):
    """The control: the covariances are as wrong as above, so that what locks out is the kernel on top of it."""
    assert worst(NumpySmoother(CONFIG), way, RAW) < 0.6


def test_huber_with_the_inflated_covariance_holds(way, backend):
    config = GraphConfig(backend=backend, window=CONFIG.window, restart=CONFIG.restart)
    assert worst(make_smoother(config), way, HONEST) < 0.35


def test_odometry_alone_is_metres_off(way):
    """Else there would be nothing to lock out of."""
    alone = type(way)(way.truth, way.steps, [None] * len(way.truth))
    assert worst(NumpySmoother(CONFIG), alone, RAW) > 2.0
