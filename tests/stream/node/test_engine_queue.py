"""Queue of one robot's work for the engines, and the order of robots at an engine: nobody waits without end."""

from dataclasses import replace

import pytest
from fake_robot import POINTS, ns, pose, search_request, search_result, tracking

from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.state import State
from coview_stream.messages.types import CloudMessage
from coview_stream.stream.node.counters import Counters, ErrorLog
from coview_stream.stream.node.engine_queue import EngineQueue, PlaceHints, RoundRobin, SearchDemand, search_order
from coview_stream.stream.node.inputs import PairedFrame

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


@pytest.mark.parametrize(("restart", "earlier"), [(2, ("a keyframe",)), (3, ())])
def test_request_that_replaces_a_waiting_one_goes_on_with_its_keyframes(queue, restart, earlier):
    waits = replace(search_request(0.0), epoch=(queue.epoch, 2), earlier=("a keyframe",))
    queue.put_search_request(waits, NOW)
    queue.ask(0.1, restart=restart)
    assert queue.take_search_request().request.earlier == earlier


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
    queue.search_done(old, search_result(), NOW)  # says nothing about the search of now
    assert queue.search_demand == SearchDemand(NOW, 0, 0)


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


KEYFRAMES = 1.33  # seconds between those of a robot: 2 m at 1.5 m/s


def waiting(seconds, searches=0, support=0):
    return SearchDemand(NOW - seconds, searches, support)


@pytest.mark.parametrize(
    ("demands", "order"),
    [
        ([None, waiting(0.1), None], [1]),
        ([waiting(0.1), waiting(0.3), waiting(0.2)], [1, 2, 0]),  # among equals the longest wait
        ([waiting(1.0, 100), waiting(0.5, 2), waiting(0.1, 50, 3)], [2, 1, 0]),  # proposed, newly lost, long lost
        ([waiting(0.5, 3, 1), waiting(0.1, 4, 2)], [1, 0]),  # proposed most often in a row
        ([waiting(0.1, 40, 40), waiting(0.05, 4, 1)], [1, 0]),  # proposed without end gives no precedence
        ([waiting(0.1, 40, 40), waiting(0.2, 40)], [1, 0]),
        ([waiting(1.6, 500), waiting(1.4, 4, 3)], [0, 1]),  # has waited too long
        ([waiting(1.6, 4, 3), waiting(1.7, 500)], [1, 0]),
    ],
)
def test_order_of_searches(demands, order):
    assert search_order(demands, NOW) == order


class Robots:
    """Lost robots before one search engine; those that are on the map are found after five searches.

    Attributes:
        found: seconds from its first keyframe after which a robot was found.
        waits: the longest wait of each for a search, its answer included.
    """

    def __init__(self, on_map, off_map, cost, off_map_support=0, on_map_from=0.0, seconds=60.0):
        robots = range(on_map + off_map)
        begin = [on_map_from * (k < on_map) + 0.013 * k for k in robots]
        due = list(begin)
        since, searches = [None] * len(begin), [0] * len(begin)
        self.found, self.waits = {}, [0.0] * len(begin)
        now = 0.0
        while now < seconds:
            for k in robots:
                while due[k] <= now:
                    since[k] = due[k] if since[k] is None and k not in self.found else since[k]
                    due[k] += KEYFRAMES
            support = [max(0, n - 1) if k < on_map else off_map_support * n for k, n in enumerate(searches)]
            demands = [None if since[k] is None else SearchDemand(since[k], searches[k], support[k]) for k in robots]
            order = search_order(demands, now)
            if not order:
                now = min(due)
                continue
            now += cost
            k = order[0]
            self.waits[k] = max(self.waits[k], now - since[k])
            since[k], searches[k] = None, searches[k] + 1
            if k < on_map and searches[k] == 5:
                self.found[k] = now - begin[k]
                since[k] = None
        for k in robots:
            if since[k] is not None:
                self.waits[k] = max(self.waits[k], now - since[k])


@pytest.mark.parametrize("on_map_from", [0.0, 40.0, 40.7])
@pytest.mark.parametrize("off_map_support", [0, 1])
def test_eight_of_sixteen_are_found_and_nobody_starves(on_map_from, off_map_support):
    """At a tenth of a second a search: sixteen robots take more than the engine has."""
    (alone,) = Robots(1, 0, 0.1).found.values()
    robots = Robots(8, 8, 0.1, off_map_support, on_map_from)
    assert len(robots.found) == 8
    assert max(robots.found.values()) < alone + 5.0
    assert max(robots.waits) < 3.0


def test_engine_that_cannot_keep_up_lets_all_wait_equally_long():
    robots = Robots(0, 16, 0.4)
    assert max(robots.waits) < 17 * 0.4
    assert min(robots.waits) > 14 * 0.4


def test_engine_that_can_keep_up_searches_for_every_keyframe():
    assert max(Robots(8, 8, 0.05).waits) < 16 * 0.05 + 0.05


def test_idle_robot_keeps_its_turn():
    turns, served = RoundRobin(4), []
    for ready in 2 * [(1, 3)] + 4 * [(0, 1, 2, 3)]:
        served.append(next(k for k in turns.order() if k in ready))
        turns.serve(served[-1])
    assert served == [1, 3, 0, 2, 1, 3]
