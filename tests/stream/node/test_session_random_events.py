"""Events in random order: nothing raises, every cloud is counted once, no pose without a fix."""

from dataclasses import replace

import pytest
from fake_robot import KEYS, Robot, cloud, ends, search_request, search_result, tracking, unknown
from hypothesis import given, settings
from hypothesis import strategies as st

from coview_stream.config.node import NodeConfig
from coview_stream.localization.state import Event, State, next_state
from coview_stream.messages.types import Sample

FOUND = (Event.PLACE_ACCEPTED, Event.MATCH_VERIFIED)
stamps = st.one_of(
    st.just("next"), st.just("next"), st.just("next"), st.floats(-2.0, 2.0), st.floats(-9e8, 9e8), st.just("same")
)
events = [
    st.tuples(st.just("cloud"), stamps),
    st.tuples(st.just("odometry"), stamps),
    st.tuples(st.just("odometry"), stamps),
    st.tuples(st.just("pause"), st.floats(0.01, 1.5)),
    st.tuples(st.just("garbage"), st.binary(max_size=20)),
    st.tuples(st.just("odometry garbage"), st.binary(max_size=20)),
    st.tuples(st.just("take"), st.none()),
    st.tuples(st.just("done"), st.one_of(st.just(FOUND), st.lists(st.sampled_from(list(Event)), max_size=3))),
    st.tuples(st.just("failed"), st.booleans()),
    st.tuples(st.just("take search"), st.none()),
    st.tuples(st.just("searched"), st.booleans()),
    st.tuples(st.just("ask again"), st.none()),
    st.tuples(st.just("engine died"), st.none()),
    st.tuples(st.just("reset"), st.none()),
]


class Chaos:
    """One random life of a session, with the rules that hold at every moment."""

    def __init__(self):
        self.robot = Robot(NodeConfig(restart_after=0.2))
        self.session = self.robot.session
        self.now, self.clock, self.last = 1000.0, 0.0, 0.0
        self.jobs, self.searches = [], []
        self.published = None  # clock restarts, stamp
        self.engine = None, State.SEARCHING  # its epoch and state

    def stamp(self, kind):
        if kind == "next":
            self.clock += 0.05
            self.last = self.clock
        elif kind != "same":
            self.last = self.clock + kind
        return self.last

    def happen(self, event, value):
        session = self.session
        self.now += 0.02
        if event == "cloud":
            session.on_cloud(cloud(self.stamp(value)), self.now)
        elif event == "odometry":
            self.robot.moved(self.stamp(value), now=self.now, x=0.1)
        elif event == "pause":
            self.now += value
            session.tick(self.now)
        elif event == "garbage":
            session.on_cloud(Sample(KEYS.cloud, value), self.now)
        elif event == "odometry garbage":
            session.on_odometry(Sample(KEYS.odometry, value, "application/json"), self.now)
        elif event == "take":
            if (job := session.take_job("track")) is not None:
                self.jobs.append(job)
        elif event == "take search":
            if (search := session.take_job("search")) is not None:
                self.searches.append(search)
        elif event == "searched" and self.searches:
            if value:
                session.handle_result(self.searches.pop(0), search_result(), self.now)
            else:
                session.handle_failure(self.searches.pop(0), "boom")
        elif event == "done" and self.jobs:
            self.answer(self.jobs.pop(0), value)
        elif event == "failed" and self.jobs:
            session.handle_failure(self.jobs.pop(0), "boom", rejected=value)
        elif event == "ask again":
            session.restart_search("asked to search again")
        elif event == "engine died":
            session.engine_restarted()
        elif event == "reset":
            session.reset()
            self.published = None  # its odometry is forgotten too

    def answer(self, job, events):
        """Answer a frame as an engine does: it moves along the table, and doubts the place when asked to."""
        epoch, state = self.engine
        if epoch != job.epoch:
            state = State.SEARCHING
        if job.require_verification:
            events = [Event.VERIFICATION_REQUIRED, *events]
        changes = []
        for event in events:
            possible = event is not Event.MATCH_VERIFIED or state.has_place  # it registers around a place only
            if possible and next_state(state, event) is not state:
                state = next_state(state, event)
                changes.append(event)
        self.engine = job.epoch, state
        result = tracking(job) if state is State.TRACKING else unknown(job, state, ask=search_request())
        self.session.handle_result(job, replace(result, events=tuple(changes)), self.now)

    def hold(self):
        counters = self.session.counters
        assert min(counters.to_json().values()) >= 0
        assert 0 <= counters.received - ends(counters) <= 10
        state, why = self.session.state()
        assert why
        assert state is not State.TRACKING or self.engine[1] is State.TRACKING
        sent = self.session.pose()
        if sent is None:
            return
        assert state is State.TRACKING
        assert counters.fixes > 0
        assert self.session.robot_state.age(self.session.inputs.odometry) is not None
        newest = self.session.inputs.odometry.newest
        assert sent.stamp_ns == newest.stamp_ns
        restarts = counters.clock_restarts
        if self.published is not None and self.published[0] == restarts:
            assert sent.stamp_ns >= self.published[1]
        self.published = restarts, sent.stamp_ns

    def come_to_rest(self):
        """Let all that is under way end: then every cloud has been counted once."""
        for _ in range(20):
            self.now += 10.0
            self.session.tick(self.now)
            self.happen("take", None)
            while self.jobs:
                self.happen("done", ())
        counters = self.session.counters
        assert counters.received == ends(counters)


frame = st.permutations(["odometry", "cloud", "odometry", "take", "done"]).map(
    lambda names: [(n, FOUND if n == "done" else None if n == "take" else "next") for n in names]
)
usual = st.lists(frame, max_size=3).map(lambda frames: [event for events in frames for event in events])


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(st.one_of(usual, usual, st.lists(st.one_of(*events), max_size=4)), max_size=12))
def test_random_events_of_a_mostly_working_robot_keep_invariants(chapters):
    """Random events alone seldom come as far as a pose."""
    chaos = Chaos()
    for event, value in (event for chapter in chapters for event in chapter):
        chaos.happen(event, value)
        chaos.hold()
    chaos.come_to_rest()
