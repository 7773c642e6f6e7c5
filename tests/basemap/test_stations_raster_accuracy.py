"""What a map stores beside the exact bins of its points: a cell counts at its centre, 0.35 m from its corners."""

from __future__ import annotations

import numpy as np
import pytest

from bench.speed.map_build import baseline, ours, site


@pytest.fixture(scope="module")
def both():
    cloud, stations = site(400_000, 1_000)
    chosen = np.arange(0, 1_000, 50)
    _, described = ours(cloud, stations)
    _, _, exact = baseline(cloud, stations, chosen)
    return {name: (described[name][chosen].astype(np.float32), exact[name]) for name in exact}


@pytest.mark.parametrize(("channel", "share", "distance"), [("scan_context", 0.05, 0.06), ("coview", 0.07, 0.1)])
def test_raster_descriptor_bins_are_close_to_exact_bins(both, channel, share, distance):
    found, exact = both[channel]
    assert (np.abs(found - exact) > 0.5).mean() < share
    found, exact = found.reshape(len(found), -1), exact.reshape(len(exact), -1)
    cosine = (found * exact).sum(axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(exact, axis=1)
    assert (1 - cosine).mean() < distance


def test_every_station_matches_itself_best(both):
    """The map's descriptors pick their own station out of the exact ones, and the other way round."""
    found, exact = (a.reshape(len(a), -1) for a in both["scan_context"])
    score = found @ exact.T / np.linalg.norm(found, axis=1)[:, None] / np.linalg.norm(exact, axis=1)
    np.testing.assert_array_equal(score.argmax(axis=0), np.arange(len(found)))
    np.testing.assert_array_equal(score.argmax(axis=1), np.arange(len(found)))
