"""Queue of one robot's frames and search requests to the engines, without a session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_robot import POINTS, ns, pose, search_request, search_result, tracking, unknown

from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.state import State
from coview_stream.messages.types import CloudMessage
from coview_stream.stream.node.counters import Counters, ErrorLog
from coview_stream.stream.node.engine_queue import EngineQueue, SearchDemand, SearchJob
from coview_stream.stream.node.inputs import PairedFrame
from coview_stream.stream.node.last_place import PlaceHints

EPOCH = 4  # after resets: the first of this queue
NOW = 1000.0


class Queue(EngineQueue):
    """A queue with counters of its own."""

    def __init__(self):
        self.counters, self.errors, self.hints = Counters(), ErrorLog(), PlaceHints()
        super().__init__("r1", EPOCH, self.counters, self.errors)

    @property
    def counted(self):
        """Counters that are not zero."""
        return {name: count for name, count in self.counters.to_json().items() if count}

    def put(self, seconds, now=NOW):
        """Queue a frame that came 0.1 s before ``now``; its odometry had driven as many metres as its stamp says."""
        frame = PairedFrame(CloudMessage(ns(seconds), POINTS), now - 0.1, pose(seconds), None, seconds, 0.5)
        self.put_frame(frame, now)

    def take(self, seconds=0.0, now=NOW):
        """Queue a frame and hand it out."""
        self.put(seconds, now)
        return self.take_next()

    def take_next(self):
        """Hand out the frame that waits."""
        return self.take_frame(False, self.hints)

    def ask(self, seconds=0.0, now=NOW, restart=1):
        """Queue a search request."""
        self.put_search_request(replace(search_request(seconds), epoch=(self.epoch, restart)), now)

    def search(self, seconds=0.0, now=NOW, restart=1):
        """Queue a search request and hand it out."""
        self.ask(seconds, now, restart)
        return self.take_search_request()


@pytest.fixture
def queue():
    return Queue()


# ---- frames


def test_frame_goes_to_the_engine_as_it_was_put(queue):
    assert queue.take_next() is None
    queue.put(0.2)
    queue.hints.offer(hint := pose(3.0), None)
    job = queue.take_frame(True, queue.hints)
    assert (job.robot, job.epoch, job.stamp_ns, job.defer) == ("r1", EPOCH, ns(0.2), False)
    assert (job.require_verification, job.search_result) == (True, None)
    assert job.hint is hint
    np.testing.assert_array_equal(job.T_odom_body, pose(0.2))
    frame = queue.frame_done(job, tracking(job), NOW)
    assert (frame.job, frame.paired.travelled, frame.paired.turned) == (job, 0.2, 0.5)
    assert queue.counted == {"processed": 1}


def test_newest_frame_replaces_the_one_that_waits(queue):
    for k in range(3):
        queue.put(0.1 * k, NOW + 0.1 * k)
    job = queue.take_next()
    assert job.stamp_ns == ns(0.2)
    assert job.defer  # the engine is behind
    assert queue.take_next() is None
    assert queue.counted == {"dropped": 2}
    queue.frame_done(job, tracking(job), NOW + 0.5)
    assert queue.longest_wait == pytest.approx(0.5)  # since the first of them


def test_only_one_frame_is_under_way(queue):
    job = queue.take(0.0)
    assert queue.take(0.1) is None
    queue.frame_done(job, tracking(job), NOW)
    after = queue.take_next()
    assert (after.stamp_ns, after.defer) == (ns(0.1), False)


def test_latency_runs_from_the_coming_of_the_cloud(queue):
    assert queue.processed_at is None
    job = queue.take(0.0)
    queue.frame_done(job, tracking(job), NOW + 0.03)
    assert queue.latency.to_json()["p50"] == pytest.approx(130.0)
    assert queue.engine_latency.to_json()["p50"] == pytest.approx(10.0)
    assert queue.processed_at == NOW + 0.03


def test_fix_of_an_old_epoch_is_only_counted(queue):
    job = queue.take(0.0)
    queue.put(0.1)
    queue.begin_epoch(EPOCH + 1)
    assert queue.take_next() is None  # the one that waited was dropped
    assert queue.frame_done(job, unknown(job, ask=search_request()), NOW) is None
    assert queue.take_search_request() is None
    assert queue.counted == {"processed": 1, "dropped": 1}
    assert queue.take(0.2).epoch == EPOCH + 1


def test_failures_of_an_old_epoch_are_only_counted(queue):
    frame, search = queue.take(0.0), queue.search()
    queue.begin_epoch(EPOCH + 1)
    after = queue.take(0.1)
    other = queue.search()
    assert not queue.frame_failed(frame, "boom", rejected=False)
    queue.search_failed(search, "boom")
    assert queue.take(0.2) is None  # what is under way is another one
    assert queue.search() is None
    assert (after.epoch, other.epoch) == (EPOCH + 1, EPOCH + 1)
    assert queue.counted == {"engine_errors": 1, "search_errors": 1}


def test_jobs_from_before_a_reset_are_ignored(queue):
    old = replace(queue.take(0.0), epoch=EPOCH - 1)
    search = SearchJob("r1", replace(search_request(), epoch=(EPOCH - 1, 1)))
    assert queue.frame_done(old, tracking(old), NOW) is None
    assert not queue.frame_failed(old, "boom", rejected=True)
    queue.search_done(search, search_result(), NOW)
    queue.search_failed(search, "boom")
    assert queue.counted == {}
    assert list(queue.errors.texts) == []
    assert queue.processed_at is None


@pytest.mark.parametrize(("rejected", "counter"), [(True, "rejected"), (False, "engine_errors")])
def test_frame_that_failed_is_counted_and_named_once(queue, rejected, counter):
    for k in range(2):
        assert queue.frame_failed(queue.take(0.1 * k), f"Traceback\nboom {k}", rejected)
    assert queue.counted == {counter: 2}
    (error,) = queue.errors.texts
    assert error.endswith("the first: boom 0")


# ---- searches


def test_newest_search_request_replaces_the_one_that_waits(queue):
    job = queue.search(0.0)
    assert job.request.stamp == 0.0
    for k in (1, 2):
        assert queue.search(0.1 * k) is None  # one is under way
    queue.search_done(job, search_result(), NOW)
    assert queue.take_search_request().request.stamp == 0.2
    assert queue.counted == {"searches_skipped": 1, "searches": 1}


def test_request_of_a_fix_is_queued(queue):
    job = queue.take(0.0)
    queue.frame_done(job, unknown(job, ask=search_request(0.7)), NOW)
    assert queue.take_search_request().request.stamp == 0.7


def test_search_result_goes_with_the_next_frame_once(queue):
    result = search_result()
    queue.search_done(queue.search(), result, NOW)
    job = queue.take(0.0)
    assert job.search_result is result
    queue.frame_done(job, unknown(job), NOW)
    assert queue.take(0.1).search_result is None


def test_search_result_of_a_rejected_frame_goes_with_the_next_one_too(queue):
    result = search_result()
    queue.search_done(queue.search(), result, NOW)
    assert queue.frame_failed(queue.take(0.0), "too few points", rejected=True)
    assert queue.take(0.1).search_result is result


def test_newer_search_result_replaces_that_of_a_rejected_frame(queue):
    newer = search_result(0.1)
    queue.search_done(queue.search(), search_result(0.0), NOW)
    job = queue.take(0.0)
    queue.search_done(queue.search(0.1), newer, NOW)
    queue.frame_failed(job, "too few points", rejected=True)
    assert queue.take(0.1).search_result is newer


@pytest.mark.parametrize("accepted", [None, "a place"])
def test_only_an_accepted_search_result_is_kept_over_a_later_one(queue, accepted):
    first, second = search_result(0.0, accepted=accepted), search_result(1.0)
    for result in (first, second):
        queue.search_done(queue.search(), result, NOW)
    assert queue.take(0.0).search_result is (first if accepted else second)


def test_failed_search_keeps_an_accepted_result(queue):
    accepted = search_result(accepted="a place")
    queue.search_done(queue.search(), accepted, NOW)
    queue.search_failed(queue.search(0.1), "boom")
    assert queue.take(0.0).search_result is accepted
    assert queue.counted == {"searches": 1, "search_errors": 1}


def test_search_result_of_an_old_epoch_is_only_counted(queue):
    job = queue.search()
    waiting = search_result()
    queue.search_done(job, waiting, NOW)
    queue.begin_epoch(EPOCH + 1)
    queue.search_done(job, search_result(accepted="a place"), NOW)
    assert queue.take(0.0).search_result is None
    assert queue.counted == {"searches": 2}


# ---- demand for searches


def test_demand_lasts_from_the_first_keyframe_that_waits_to_its_search(queue):
    assert queue.search_demand is None
    queue.ask(0.1, NOW + 1.0)
    queue.ask(0.2, NOW + 2.0)  # the newest waits in place of the first, and as long as that
    assert queue.search_demand == SearchDemand(NOW + 1.0)
    job = queue.take_search_request()
    queue.ask(0.3, NOW + 3.0)
    assert queue.search_demand is None  # one search at a time
    queue.search_done(job, search_result(), NOW + 3.5)
    assert queue.search_demand == SearchDemand(NOW + 3.0, searches=1, support=1)
    assert queue.longest_search_wait == pytest.approx(2.5)


def test_support_is_of_searches_in_a_row(queue):
    for state, support in ((State.AMBIGUOUS, 1), (State.AMBIGUOUS, 2), (State.SEARCHING, 0), (State.AMBIGUOUS, 1)):
        queue.search_done(queue.search(), SearchResult(None, KeyframeEvidence(0.0, state, "")), NOW)
        queue.ask()
        assert queue.search_demand.support == support


def test_searches_are_counted_from_the_loss(queue):
    for restart, searches in ((1, 1), (1, 2), (2, 1)):
        queue.search_done(queue.search(restart=restart), search_result(), NOW)
        queue.ask(restart=restart)
        assert queue.search_demand.searches == searches
    old = queue.take_search_request()
    queue.ask(restart=3)
    queue.search_done(old, search_result(), NOW)  # says nothing of what is searched for now
    assert queue.search_demand == SearchDemand(NOW, 0, 0)


def test_failed_search_makes_room_for_the_next(queue):
    job = queue.search()
    queue.ask(0.1, NOW + 1.0)
    queue.search_failed(job, "boom")
    assert queue.search_demand == SearchDemand(NOW + 1.0)
    assert queue.longest_search_wait == 0.0


def test_keyframes_from_before_the_place_was_found_are_not_searched_for(queue):
    job = queue.search()
    queue.ask(0.1)
    queue.search_done(job, search_result(accepted="a place"), NOW)
    assert queue.search_demand is None
    assert queue.take_search_request() is None
    queue.ask(0.2)
    frame = queue.take(0.3)
    queue.frame_done(frame, tracking(frame), NOW)
    assert queue.search_demand is None


def test_new_odometry_wants_nothing_until_its_first_keyframe(queue):
    queue.ask()
    queue.begin_epoch(EPOCH + 1)
    assert queue.search_demand is None
    queue.ask(0.1, NOW + 4.0)
    assert queue.search_demand == SearchDemand(NOW + 4.0)
