"""A drive as a graph sees it: true poses, odometry that drifts, and a map that is seen now and then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from se3 import exp_se3

from coview_stream.geometry.transforms import boxplus, exp_so3, inverse, pose_from

START = pose_from(exp_so3([0.1, -0.2, 2.2]), [120.0, -40.0, 7.0])
START_COVARIANCE = np.diag([0.01, 0.01, 0.03, 0.3, 0.3, 0.2]) ** 2
ODOMETRY = np.diag([0.001, 0.001, 0.002, 0.02, 0.02, 0.02]) ** 2
REGISTRATION = np.diag([0.002, 0.002, 0.004, 0.05, 0.05, 0.05]) ** 2


@dataclass(frozen=True)
class Drive:
    """``truth`` and ``seen`` have one pose more than there are ``steps``; what is not seen is None."""

    truth: list
    steps: list
    seen: list


def drive(
    keyframes, seed=0, every=3, outliers=0.0, bias=None, odometry=ODOMETRY, registration=REGISTRATION, stray=5.0
) -> Drive:
    """Steps of half a metre on a winding way; ``bias`` (6,) is added to every step of odometry."""
    rng = np.random.default_rng(seed)
    truth, steps, seen = [START], [], [None]
    for k in range(1, keyframes):
        step = exp_se3(np.array([0.004 * np.sin(k / 9), 0.002, 0.05 * np.sin(k / 20), 0.5, 0.0, 0.01]))
        truth.append(truth[-1] @ step)
        noise = rng.standard_normal(6) * np.sqrt(np.diag(odometry)) + (0.0 if bias is None else bias)
        steps.append(inverse(truth[-2]) @ boxplus(truth[-1], noise))
        gap = rng.standard_normal(6) * np.sqrt(np.diag(registration))
        gap[3:] += stray * rng.standard_normal(3) * (rng.random() < outliers)
        seen.append(boxplus(truth[-1], gap) if k % every == 0 else None)
    return Drive(truth, steps, seen)


def run(graph, drive, odometry=ODOMETRY, registration=REGISTRATION, start=START_COVARIANCE):
    """All estimates, from the first keyframe on."""
    graph.start(drive.truth[0], start)
    estimates = [graph.estimate]
    for step, seen in zip(drive.steps, drive.seen[1:], strict=True):
        graph.move(step, odometry)
        if seen is not None:
            graph.correct(seen, registration)
        estimates.append(graph.estimate)
    return estimates


def shift_errors(estimates, truth):
    """Distance (K,) of every estimate from the truth, metres."""
    return np.array([np.linalg.norm(e.T_map_body[:3, 3] - T[:3, 3]) for e, T in zip(estimates, truth, strict=True)])


def relative(A, B):
    """Largest difference of two covariances in units of the second's sigmas."""
    sigma = np.sqrt(np.diag(B))
    return float(np.abs((A - B) / np.outer(sigma, sigma)).max())
