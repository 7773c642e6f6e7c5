"""Global search on the small world: what it accepts, what it withholds, and what it keeps between keyframes."""

from dataclasses import replace

import numpy as np
import pytest
from any_risk import NEVER
from made_up_places import name_instead
from se3 import exp_se3

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import AcceptanceConfig, DescriptorConfig, LocalizerConfig, RegistrationConfig
from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, rot_z, tilt_of, to_local
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.evidence.observation import Evidence
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration.clouds import LocalMaps, voxelized
from coview_stream.localization.search import global_search
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.keyframes import KeyframeBuffer
from coview_stream.localization.search.request import FIRST_EPOCH, EarlierKeyframe, Epoch, RequestSpec, SearchRequest
from coview_stream.localization.state import State

T_MAP_ODOM = pose_from(rot_z(1.9), [7.0, -3.0, 0.4])  # of the runs through the small world
TILT = np.radians(4.0)
TWIN = 192.0  # metres, whole tiles of the likelihood field, farther than a scan reaches


def searching(base_map, acceptance=None, **settings):
    config = LocalizerConfig(acceptance=acceptance or AcceptanceConfig(), **settings)
    return GlobalSearch(base_map, config, LocalMaps(base_map, 50.0))


@pytest.fixture
def search(world_map):
    return searching(world_map)


@pytest.fixture
def never_sure(world_map):
    """A search that accepts no place."""
    return searching(world_map, NEVER)


def run_of(world_drive, frames, T_map_odom=T_MAP_ODOM, epoch=FIRST_EPOCH):
    """A request for each keyframe of the run, odometry near its origin."""
    buffer = KeyframeBuffer(LocalizerConfig().keyframe)
    spec = RequestSpec(DescriptorConfig(radius=30.0))  # the small world's
    for k in range(frames):
        T = inverse(T_map_odom) @ world_drive.T_map_body[k]
        cloud = world_drive.clouds[k]
        keyframe = buffer.add(RawScan(voxelized(cloud, T, buffer.config), T), 0.5 * k)
        yield SearchRequest.of(buffer, keyframe, cloud, spec, epoch=epoch)


def off(T_map_odom):
    return np.linalg.norm((T_map_odom - T_MAP_ODOM)[:3, 3])


@pytest.mark.parametrize("share", ["near", "covered", "ground", "free_space"])
def test_every_evidence_share_but_the_surveyed_one_lowers_the_score(share):
    perfect = Evidence(1.0, 1.0, 1.0, 1.0, 1.0)
    assert perfect.score == replace(perfect, inside=0.1).score == 1.0
    assert replace(perfect, **{share: 0.25}).score == pytest.approx(0.5)
    assert replace(perfect, **{share: 0.0}).score == 0.0


def test_risk_alone_decides_what_is_accepted(never_sure, search, world_drive):
    request = next(run_of(world_drive, 1))
    refused, result = never_sure.update(request), search.update(request)
    assert refused.accepted is None
    assert refused.evidence.state is State.AMBIGUOUS
    assert refused.evidence.confidence > 0.999
    assert result.evidence.state is State.TRACKING
    assert off(result.accepted.T_map_odom) < 0.1
    assert result.evidence.confidence > 1.0 - search.config.acceptance.risk
    assert result.evidence.by_chance < search.config.acceptance.risk


def test_part_that_was_moved_counts_in_stated_errors_above_the_risk_as_well(never_sure, world_drive):
    cloud = world_drive.clouds[0].copy()
    sector = ((np.arctan2(cloud[:, 1], cloud[:, 0]) + np.pi) / (2.0 * np.pi) * 12.0).astype(int)
    cloud[(sector % 3 == 0) & (cloud[:, 2] > -1.0), 0] -= 4.0
    evidence = never_sure.update(next(run_of(replace(world_drive, clouds=[cloud]), 1))).evidence
    assert evidence.reason.startswith("a part of the scan may fit 4 m beside the rest")
    assert 0.4 < evidence.confidence < 0.9  # either part may be the moved one


def test_evidence_of_the_right_place_adds_up_over_keyframes(never_sure, world_drive):
    """Against chance; the effective number of observations may vary a little from scan to scan."""
    results = [never_sure.update(request) for request in run_of(world_drive, 5)]
    assert all(result.evidence.state is State.AMBIGUOUS for result in results)
    assert results[-1].evidence.by_chance < results[0].evidence.by_chance


def leaning(world_drive, degrees=4.0):
    """The drive with a sensor that leans in roll."""
    R = exp_so3(np.radians([degrees, 0.0, 0.0])).astype(np.float32)
    return replace(world_drive, clouds=[cloud @ R for cloud in world_drive.clouds])


def lean_of(result):
    """Degrees by which the sensor leans at the leader."""
    return np.degrees(tilt_of(result.T_map_cloud))


@pytest.mark.parametrize("keyframes", [1, 2], ids=["at its first keyframe", "at a later keyframe"])
def test_sensor_that_leans_is_found_by_its_prior(never_sure, world_drive, keyframes):
    drawn = Calibration(sigma_tilt=np.radians(0.2))  # such a lean is improbable then
    *before, newest = run_of(leaning(world_drive), keyframes)
    results = []
    for epoch, prior in zip((FIRST_EPOCH, Epoch(1)), (newest.calibration, drawn), strict=True):
        for request in before:
            never_sure.update(replace(request, calibration=drawn, epoch=epoch))
        results.append(never_sure.update(replace(newest, calibration=prior, epoch=epoch)))
    leans, improbable = results
    assert lean_of(leans) == pytest.approx(4.0, abs=0.5)
    assert off(leans.leader) < 0.3
    assert leans.evidence.evidence.ground > 0.8
    assert leans.considered.none < 0.1 * improbable.considered.none


def test_lean_is_measured_by_the_newest_frame_alone(never_sure, world_drive):
    """Frames along the way stand where odometry has them: together they show a part of the lean."""
    results = [never_sure.update(request) for request in run_of(leaning(world_drive), 6)]
    assert [lean_of(result) for result in results[2:]] == pytest.approx([4.0] * 4, abs=0.6)


@pytest.fixture(scope="module")
def twin_map(map_points):
    """Two places that the likelihood field cannot tell apart."""
    both = np.concatenate([map_points, map_points + np.array([TWIN, 0, 0])])
    return BaseMap.build(both.astype(np.float32), radius=30.0)


@pytest.mark.slow
def test_identical_places_never_fix(twin_map, world_drive):
    assert Localizer(twin_map).step(world_drive.clouds[2], world_drive.T_odom_body[2], 0.0).T_map_body is None
    search = searching(twin_map)
    for request in run_of(world_drive, 10):
        result = search.update(request)
        assert result.accepted is None
        assert result.evidence.state is State.AMBIGUOUS
        assert "two places fit" in result.evidence.reason
        assert result.evidence.rival > 0.8 * result.evidence.score
        assert 0.3 < result.evidence.confidence < 0.9
        # neither is a chance place: each explains all
        assert result.evidence.by_chance < search.config.acceptance.risk


def in_the_twin(base_map):
    """Choose the places near the second of two copies."""
    return lambda places: [place for place in places if place.T_map_odom[0, 3] + base_map.origin[0] > 0.5 * TWIN]


def test_twin_that_no_vote_names_is_found_on_the_map(twin_map, world_drive):
    """The votes of a scan may miss a place, at the border or where the site is flat."""
    search = searching(twin_map)
    name_instead(search, in_the_twin(twin_map))
    for request in run_of(world_drive, 3):
        result = search.update(request)
        assert result.accepted is None
        assert result.evidence.reason.startswith("two places fit")


def test_better_place_that_the_map_names_leads_at_the_next_keyframe(map_points, world_drive):
    copy = map_points[(map_points[:, 1] < 8.0) | (map_points[:, 2] < 1.0)] + np.array([TWIN, 0, 0])  # a part is gone
    base_map = BaseMap.build(np.concatenate([map_points, copy]).astype(np.float32), radius=30.0)
    search = searching(base_map)
    name_instead(search, in_the_twin(base_map))
    first, second = (search.update(request) for request in run_of(world_drive, 2))
    assert first.accepted is None
    assert off(to_local(second.leader, -np.asarray(base_map.origin))) < 0.3


def test_scan_of_another_world_is_never_accepted(search, elsewhere):
    for request in run_of(elsewhere, len(elsewhere.clouds)):
        result = search.update(request)
        assert result.accepted is None
        assert result.evidence.state is State.SEARCHING
        assert result.evidence.by_chance > 0.1


def test_place_whose_registration_leads_elsewhere_is_not_accepted(search, world_drive, monkeypatch):
    real = global_search.register_place

    def wandering(place, *others):
        found = real(place, *others)
        moved = pose_from(np.eye(3), [2.5, 0.0, 0.0]) @ found.T_map_odom
        return replace(found, T_map_odom=moved)

    monkeypatch.setattr(global_search, "register_place", wandering)
    result = search.update(next(run_of(world_drive, 1)))
    assert result.accepted is None
    assert "does not register" in result.evidence.reason
    assert result.evidence.score > 0.8  # as the field has it


def test_good_place_is_observed_again_without_votes(never_sure, world_drive):
    frames = run_of(world_drive, 3)
    first = never_sure.update(next(frames))
    assert first.evidence.score > 0.8
    name_instead(never_sure)
    again = never_sure.update(next(frames))
    assert again.evidence.score > 0.8
    assert again.evidence.station == first.evidence.station
    never_sure.clear()
    nothing = never_sure.update(next(frames))
    assert (nothing.evidence.score, nothing.evidence.state, nothing.rivals) == (0.0, State.SEARCHING, 0)


def test_every_start_of_a_search_is_another_chance_until_a_place_is_accepted(search, never_sure, world_drive):
    def none(of, restart):
        return of.update(next(run_of(world_drive, 1, epoch=Epoch(0, restart)))).considered.none

    never = [none(never_sure, restart) for restart in (1, 2, 3)]
    np.testing.assert_allclose(np.divide(never, never[0]), [1.0, 4.0, 9.0], rtol=1e-6)
    assert none(search, 1) == pytest.approx(none(search, 2)) == pytest.approx(never[0])


def test_search_whose_clouds_are_levelled_anew_goes_on_with_its_earlier_keyframes(world_map, world_drive):
    """It is no other start, and places are compared by what all keyframes show."""
    *before, newest = run_of(world_drive, 4)
    anew = replace(newest, epoch=Epoch(0, 1))
    earlier = tuple(EarlierKeyframe(each.T_odom_body, each.submap, each.cloud) for each in before)
    none = []
    for last in (newest, replace(anew, earlier=earlier), anew):
        search = searching(world_map, NEVER)
        for request in before:
            search.update(request)
        none.append(search.update(last).considered.none)
    whole, goes_on, forgets = np.log(none)
    assert goes_on == pytest.approx(whole, abs=0.3 * abs(whole))
    assert forgets > goes_on  # a second start is dearer: four times the odds


def test_request_of_another_epoch_or_an_acceptance_starts_anew(search, never_sure, world_drive):
    never_sure.update(next(run_of(world_drive, 1)))
    name_instead(never_sure)
    assert never_sure.update(next(run_of(world_drive, 1, epoch=Epoch(1, 0)))).rivals == 0
    assert len(never_sure.coview.consensus) == 1
    frames = run_of(world_drive, 2)
    assert search.update(next(frames)).accepted is not None
    assert len(search.coview.consensus) == 0
    name_instead(search)
    assert search.update(next(frames)).rivals == 0


def test_wrong_place_is_observed_again_and_never_accepted(search, world_drive):
    frames = run_of(world_drive, 5)
    wrong = Hypothesis(T_MAP_ODOM @ pose_from(rot_z(2.0), [9.0, -14.0, 0.0]), 0, 0, 0.0)
    name_instead(search, lambda _: [wrong])
    assert search.update(next(frames)).accepted is None
    name_instead(search)
    for frame in frames:
        again = search.update(frame)
        assert again.rivals >= 1
        assert again.accepted is None


def with_leaning_odometry(world_map, world_drive, gravity_sigma, max_tilt):
    """First search keyframe; the odometry leans against gravity by TILT, the hypothesis is right but upright."""
    search = searching(
        world_map,
        AcceptanceConfig(max_tilt=max_tilt, risk=0.49),
        registration=RegistrationConfig(gravity_sigma=gravity_sigma),
    )
    robot = pose_from(np.eye(3), world_drive.T_map_body[0][:3, 3])
    leaning = robot @ exp_se3(np.array([TILT, 0.0, 0.0, 0.0, 0.0, 0.0]))
    upright = Hypothesis(robot, 0, 0, 0.0)
    rng = np.random.default_rng(5)  # wrong places, which chance is measured at
    shifts = np.column_stack([rng.uniform(-8.0, 8.0, (60, 2)), np.zeros(60)])
    others = [
        Hypothesis(pose_from(rot_z(yaw), robot[:3, 3] + shift), 1, 0, 0.0)
        for shift, yaw in zip(shifts, rng.uniform(0.5, 5.8, 60), strict=True)
    ]
    name_instead(search, lambda _: [upright, *others])
    return search.update(next(run_of(world_drive, 1, leaning)))


def test_gravity_prior_keeps_candidates_upright(world_map, world_drive):
    def found(sigma_degrees):
        result = with_leaning_odometry(world_map, world_drive, np.radians(sigma_degrees), 1.0)
        return tilt_of(result.accepted.T_map_odom)

    assert found(30.0) == pytest.approx(TILT, rel=0.1)
    assert found(0.01) < 0.3 * TILT


@pytest.mark.parametrize("limit", [2.0, 0.5])
def test_place_tilted_beyond_limit_is_dropped(world_map, world_drive, limit):
    result = with_leaning_odometry(world_map, world_drive, np.radians(30.0), limit * TILT)
    assert (result.accepted is not None) == (limit > 1)
    assert ("does not register" in result.evidence.reason) == (limit < 1)
