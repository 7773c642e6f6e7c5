"""Evidence of a tracked place: what was learned on the way is presumed, and what has changed speaks against it."""

from dataclasses import replace

import numpy as np
import pytest
from trackers import observed

from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.likelihood import KEPT, NUISANCES
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.tracking.place_evidence import Observation, PlaceEvidence

T_MAP_ODOM = pose_from(rot_z(1.3), [-4.0, 11.0, 0.6])


@pytest.fixture(scope="module")
def scans(world_drive):
    """The drive's first scans."""
    return [observed(world_drive.clouds[k], inverse(T_MAP_ODOM) @ world_drive.T_map_body[k]) for k in range(6)]


@pytest.fixture
def place(world_map):
    return PlaceEvidence(world_map)


def fits_best_with(kept):
    """An observation that is the likelier the nearer the share that is as the map has it is to one."""
    likelihoods = np.broadcast_to(-80.0 * (KEPT - kept)[:, None, None] ** 2, NUISANCES)
    return Observation(0.0, likelihoods + 8.0 * kept)


def presumed(place):
    """Probabilities (Q, D, L) of the nuisances at the next registration."""
    return place._presumed()


def ratio_of(place, observation):
    """What another place's knowledge makes of an observation, written out."""
    odds = np.exp(observation.likelihoods) * presumed(place)
    return float(np.log(odds.sum()))


def test_scan_that_fits_in_part_speaks_for_a_place_only_where_that_is_usual(world_map, world_drive, scans):
    """A new robot does not know how much of the site has changed; one that drives through it does."""
    fresh, unchanged, changed = (PlaceEvidence(world_map) for _ in range(3))
    rearranged = [gone(scan, cloud, 0.75) for scan, cloud in zip(scans, world_drive.clouds, strict=False)]
    for scan, other in zip(scans[:5], rearranged, strict=False):
        unchanged.learn(unchanged.observe(scan, T_MAP_ODOM))
        changed.learn(changed.observe(other, T_MAP_ODOM))
    now = rearranged[5]
    assert fresh.observe(now, T_MAP_ODOM).ratio > 1.0
    assert changed.observe(now, T_MAP_ODOM).ratio > fresh.observe(now, T_MAP_ODOM).ratio
    assert unchanged.observe(now, T_MAP_ODOM).ratio < -1.0
    assert unchanged.observe(scans[5], T_MAP_ODOM).ratio > fresh.observe(scans[5], T_MAP_ODOM).ratio > 5.0


def gone(scan, frame, share):
    """The scan with what stands in a sector, a share of all directions, half a dozen metres off."""
    points = scan.cloud.points.copy()
    off = points - scan.T_odom_body[:3, 3].astype(np.float32)
    turn = np.arctan2(off[:, 1], off[:, 0]) / (2 * np.pi) + 0.5
    points[(turn < share) & scan.cloud.above] += np.float32([3.1, 5.3, 0.0])
    return ObservedScan.of(replace(scan.cloud, points=points), frame, scan.T_odom_body)


def test_site_that_has_become_another_one_is_learned(world_map):
    """However long all has fitted: a robot that has been shown half for some metres presumes half."""
    place = PlaceEvidence(world_map)
    for _ in range(100):
        place.learn(fits_best_with(1.0))
    believed = []
    for _ in range(20):
        believed.append(ratio_of(place, fits_best_with(0.4)))
        place.learn(fits_best_with(0.4))
    assert believed[0] < believed[-1] - 5.0
    kept = presumed(place).sum(axis=(1, 2))
    assert KEPT[kept.argmax()] == pytest.approx(0.4, abs=0.06)


def test_change_is_never_impossible(world_map):
    """What was learned costs a change of everything no more than its probability beforehand."""
    place = PlaceEvidence(world_map)
    for _ in range(1000):
        place.learn(fits_best_with(1.0))
    gone = fits_best_with(0.05)
    assert ratio_of(PlaceEvidence(world_map), gone) - ratio_of(place, gone) < -np.log(1e-4) + 0.1
    assert presumed(place).sum() == pytest.approx(1.0)


def test_observing_changes_nothing_and_clearing_forgets(place, scans):
    before = place.observe(scans[0], T_MAP_ODOM)
    for scan in scans:
        place.observe(scan, T_MAP_ODOM)
    again = place.observe(scans[0], T_MAP_ODOM)
    assert again.ratio == before.ratio
    np.testing.assert_array_equal(again.likelihoods, before.likelihoods)
    place.learn(before)
    assert place.observe(scans[0], T_MAP_ODOM).ratio > before.ratio + 0.5
    place.clear()
    assert place.observe(scans[0], T_MAP_ODOM).ratio == before.ratio


def test_place_holds_against_the_better_of_chance_and_its_rival():
    for rival in (-20.0, 0.0):
        assert Observation(6.0, KEPT, rival).against_elsewhere == pytest.approx(6.0)
    assert Observation(6.0, KEPT, 6.0).against_elsewhere == pytest.approx(np.log(2.0), abs=0.01)
    assert Observation(6.0, KEPT, 12.0).against_elsewhere == pytest.approx(-6.0 + np.log(2.0), abs=0.01)


def test_ratios_are_those_of_observations_around_the_first(world_map, place, scans):
    T_odom_body = scans[1].T_odom_body
    ahead = T_MAP_ODOM @ T_odom_body @ pose_from(np.eye(3), [2.0, 0.0, 0.0]) @ inverse(T_odom_body)
    poses = np.stack([T_MAP_ODOM, ahead])
    result = place.ratios(scans[1], poses)
    assert result[0] == pytest.approx(place.observe(scans[1], T_MAP_ODOM).ratio)
    assert result[1] < result[0]
    np.testing.assert_array_equal(place.ratios(scans[1], poses), result)
    other = place.ratios(scans[2], poses)  # another scan is not taken for the newest
    np.testing.assert_array_equal(PlaceEvidence(world_map).ratios(scans[2], poses), other)
