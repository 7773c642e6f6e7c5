"""A match that is not where odometry leads: what moves the place at once, and what the scans have to settle."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.tracking.map_matching import MapMatch, MapMatcher
from coview_stream.localization.tracking.monitor import MatchVerdict, RejectionReason
from coview_stream.localization.tracking.pose_graph import Estimate


def judged(shift, degrees, sigma, innovation, disputed=False):
    """Whether the place moves, and how often the scans were asked, for a match off the belief at the origin."""
    asked = []
    covariance = np.diag(np.square([*np.radians([0.2, 0.2, 1.0]), sigma, sigma, sigma]))
    belief = Estimate(np.eye(4), covariance)
    fits = MatchVerdict(RejectionReason.VERIFIED, "")
    there = MapMatch(fits, pose_from(rot_z(np.radians(degrees)), shift), 1e-4 * np.eye(6), innovation)
    near = MapMatch(fits, np.eye(4), 1e-4 * np.eye(6), 1.0)
    matcher = SimpleNamespace(
        config=LocalizerConfig(), dispute=SimpleNamespace(settle=lambda *_: asked.append(1))
    )  # fmt: skip
    scan = SimpleNamespace(T_odom_body=np.eye(4))
    led = near if innovation <= LocalizerConfig().acceptance.max_innovation and not disputed else belief
    found = MapMatcher.against_odometry(matcher, there, scan, [near, there], led.T_map_body, belief, 10.0)
    return found.moves_place, len(asked)


@pytest.mark.parametrize("disputed", [False, True])
@pytest.mark.parametrize("shift", [[2.0, 0.0, 0.0], [0.8, -0.8, 0.0]])
def test_a_place_metres_away_is_for_the_scans_to_settle_however_wide_the_belief(shift, disputed):
    for sigma in (0.2, 0.5, 2.0):
        assert judged(shift, 0.0, sigma, 20.0, disputed) == (False, 1)


def test_a_heading_alone_moves_at_once():
    assert judged([0.05, 0.0, 0.0], 8.0, 0.1, 60.0) == (True, 0)
    assert judged([2.0, 0.0, 0.0], 8.0, 0.1, 60.0) == (False, 1)


def test_heights_do_not_slip():
    assert judged([0.0, 0.0, 0.4], 0.0, 0.02, 400.0) == (False, 1)
    assert judged([0.4, 0.0, 0.0], 0.0, 0.02, 400.0) == (True, 0)  # near enough not to matter
