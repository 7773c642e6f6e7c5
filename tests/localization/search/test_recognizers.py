"""Place recognizers side by side: which are used, what each names, and that acceptance treats them alike."""

import numpy as np
import pytest
import small_world
from made_up_places import name_instead
from trackers import follow

from bench.accuracy.choices import TableVote
from coview_stream.config import LearnedConfig, LocalizerConfig
from coview_stream.errors import ConfigError, MapError
from coview_stream.geometry.transforms import inverse, pose_from, transform, yaw_of
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search.acceptance import BY_FEATURES
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.learned.matcher import YAWS, FeatureMatcher
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.retrieval import Retrieval
from coview_stream.localization.state import State
from coview_stream.stream.node.engine_queue import SearchJob
from coview_stream.stream.node.engines import SearchEngine


def search_of(base_map, reloc="auto", **settings):
    config = LocalizerConfig(reloc=reloc, learned=LearnedConfig(**settings))
    return GlobalSearch(base_map, config, LocalMaps(base_map, 50.0))


class Told(FeatureMatcher):
    """Learned features whose votes are told: ``distances`` of a keyframe's centre (3,) and the matcher."""

    def __init__(self, base_map, distances):
        super().__init__(base_map.learned, base_map.stations, LearnedConfig(), block=base_map.config.block)
        self.distances = distances

    def vote(self, view, near=(), area=None):
        return TableVote.of_distances(view.centre, [self.distances(self, view.centre).astype(np.float32)])


def knowing(drive):
    """Distances that know the truth of the drive."""
    first = pose_from(drive.T_odom_body[0][:3, :3], np.zeros(3))  # about the localizer's anchor
    T_map_odom = drive.T_map_body[0] @ inverse(first)

    def distances(matcher, centre):
        table = np.random.default_rng(0).normal(1.0, 0.1, (len(matcher.stations), YAWS))
        there = transform(T_map_odom, centre[None])[0, :2]
        station = np.hypot(*(matcher.stations[:, :2] - there).T).argmin()
        table[station, round(-yaw_of(T_map_odom) / (2 * np.pi / YAWS)) % YAWS] = -1.0
        return table

    return distances


def localizer_of(base_map, distances, reloc="auto"):
    """A localizer whose learned features are told."""
    index = SearchIndex(None if reloc == "learned" else Retrieval(base_map), Told(base_map, distances))
    return Localizer(base_map, LocalizerConfig(reloc=reloc), index=index)


def right(fixes, drive):
    posed = [(f, T) for f, T in zip(fixes, drive.T_map_body, strict=True) if f.T_map_body is not None]
    errors = [small_world.pose_error(f.T_map_body, T) for f, T in posed]
    return bool(posed) and all(metres < 0.3 and degrees < 1.0 for metres, degrees in errors)


def test_auto_uses_both_recognizers_on_map_with_features_and_each_can_be_used_alone(world_map, learned_map):
    both, alone = search_of(learned_map, peaks=2), search_of(learned_map, "learned")
    assert (both.spec.descriptor, both.spec.reach) == (learned_map.descriptor_config, 30.0)
    limits = [recognizer.consensus.config.peaks for recognizer in (both.learned, both.coview)]
    assert limits == [2, LocalizerConfig().consensus.peaks]  # of hypotheses
    assert (alone.coview, alone.spec.descriptor, alone.last_query) == (None, None, {})
    for coview in (search_of(world_map), search_of(learned_map, "coview")):
        assert (coview.learned, coview.spec.reach) == (None, None)


def test_learned_recognizer_refuses_map_without_features(world_map):
    with pytest.raises(MapError, match=r"build it again.*--reloc coview"):
        Localizer(world_map, LocalizerConfig(reloc="learned"))
    with pytest.raises(ConfigError, match="reloc is 'guesswork'"):
        LocalizerConfig(reloc="guesswork")


def test_learned_recognizer_alone_localizes(learned_map, world_drive):
    localizer = localizer_of(learned_map, knowing(world_drive), "learned")
    fixes = follow(localizer, world_drive)
    assert right(fixes, world_drive)
    first = next(f for f in fixes if f.state is State.TRACKING)
    assert first.evidence.reason.endswith(BY_FEATURES)
    assert first.evidence.station is not None
    assert first.evidence.shift is None  # which would be one of the co-view descriptors
    assert localizer.search.last_query == {}


@pytest.mark.slow
def test_learned_recognizer_finds_what_coview_misses(learned_map, world_drive):
    localizer = localizer_of(learned_map, knowing(world_drive))
    name_instead(localizer.search)
    assert right(follow(localizer, world_drive), world_drive)


@pytest.mark.slow
def test_coview_recognizer_finds_what_learned_misses(learned_map, world_drive, world_fixes):
    """Wrong places are named, registered and refused: wherever the robot is, features say that it is elsewhere."""
    named = []

    def distances(matcher, centre):
        xy = matcher.stations[:, :2]
        table = np.random.default_rng(0).normal(1.0, 0.1, (len(xy), YAWS))
        away = np.hypot(*(xy - xy.mean(axis=0)).T)
        wrong = np.argsort(-away, kind="stable")[:: max(1, len(away) // 20)][:5]  # at the rim and farther in
        table[wrong, np.arange(5) * 7] = -1.0
        named.append(wrong)
        return table

    fixes = follow(localizer_of(learned_map, distances), world_drive)
    assert right(fixes, world_drive)
    assert named
    states = [f.state for f in fixes]
    assert states.index(State.TRACKING) <= [f.state for f in world_fixes].index(State.TRACKING) + 2


def test_too_few_points_cast_no_vote(learned_map, world_drive):
    localizer = Localizer(learned_map, LocalizerConfig(reloc="learned"))
    fix = localizer.step(world_drive.clouds[0][:40], world_drive.T_odom_body[0], 0.0)
    assert fix.evidence.reason == "too few points to search with"
    assert len(localizer.search.learned.consensus) == 0


def test_search_request_holds_only_needed_clouds(world_map, learned_map, world_drive):
    first = world_drive.clouds[0], world_drive.T_odom_body[0], 0.0
    usual = Localizer(world_map).add_frame(*first)
    assert len(usual.surroundings) == 0
    both = Localizer(learned_map).add_frame(*first)
    np.testing.assert_array_equal(usual.scan, both.scan)
    away = np.hypot(*(both.surroundings[:, :2] - both.position[:2]).T)
    assert away.max() < 30.0
    assert len(both.surroundings) > 300
    assert len(Localizer(learned_map, LocalizerConfig(reloc="learned")).add_frame(*first).scan) == 0


def test_robots_share_the_search_index_of_the_map(learned_map, world_drive):
    engine = SearchEngine(learned_map, LocalizerConfig(reloc="learned"))
    engine.prepare()
    localizer = Localizer(learned_map, LocalizerConfig(reloc="learned"))
    request = localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0)
    for robot in ("one", "other"):
        assert engine.run(SearchJob(robot, request)).evidence.stamp == 0.0
    searches = list(engine._searches.values())
    assert searches[0].learned.learned is searches[1].learned.learned
    assert searches[0].learned.consensus is not searches[1].learned.consensus
