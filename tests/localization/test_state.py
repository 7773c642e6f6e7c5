"""States of a robot: the transition table, its page, and a localizer that moves along it."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from any_risk import NEVER
from trackers import garbage

from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import TRANSITIONS, Event, State, next_state, transition_table

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tracking.md"


# ---- the table


@pytest.mark.parametrize("event", Event)
@pytest.mark.parametrize("state", State)
def test_only_listed_events_change_the_state(state, event):
    assert next_state(state, event) is TRANSITIONS.get((state, event), state)
    assert TRANSITIONS.get((state, event)) is not state  # what changes nothing is not listed


def test_every_state_is_reached_from_searching():
    reached = {State.SEARCHING}
    for _ in State:
        reached |= {after for (before, _), after in TRANSITIONS.items() if before in reached}
    assert reached == set(State)


def test_every_event_changes_some_state():
    assert {event for _, event in TRANSITIONS} == set(Event)


def test_tracking_begins_by_an_accepted_place_or_a_verified_one():
    begins = {pair for pair, after in TRANSITIONS.items() if after is State.TRACKING}
    searching = {(state, Event.PLACE_ACCEPTED) for state in State if not state.has_place}
    assert begins == searching | {(state, Event.MATCH_VERIFIED) for state in (State.DOUBTED, State.LOST)}


def test_only_an_accepted_or_verified_place_ends_lost():
    ends = [event for event in Event if next_state(State.LOST, event) is not State.LOST]
    assert ends == [Event.PLACE_ACCEPTED, Event.MATCH_VERIFIED]


def test_only_a_known_place_is_doubted_or_lost():
    for (before, _), after in TRANSITIONS.items():
        assert before.has_place or after not in (State.DOUBTED, State.LOST)
    assert [state for state in State if state.has_place] == [State.TRACKING, State.DOUBTED]


def test_doubted_is_reported_as_ambiguous():
    reported = {state: state.reported for state in State}
    assert reported.pop(State.DOUBTED) == "AMBIGUOUS"
    assert reported == {state: state.value for state in State if state is not State.DOUBTED}


def test_docs_have_the_transition_table_and_every_state():
    text = PAGE.read_text(encoding="utf-8")
    (printed,) = re.findall(r"<!-- transitions -->\n(.*?)\n<!-- end -->", text, re.DOTALL)
    assert printed == transition_table()
    for state in State:
        assert len(re.findall(rf"^\| {state} \| [^|]+ \| (?:yes|no) \|$", text, re.MULTILINE)) == 1


# ---- a localizer


class Watched(Localizer):
    """A localizer whose events and states are recorded, each state with the events since the one before."""

    def __init__(self, base_map):
        self.moves = []
        super().__init__(base_map)

    @property
    def state(self):
        return self._state

    @state.setter
    def state(self, state):
        self.moves.append((getattr(self, "_state", None), self.__dict__.pop("_event", None), state))
        self._state = state

    def _handle(self, event):
        self._event = event
        super()._handle(event)


def test_localizer_moves_only_along_the_table(world_map, world_drive):
    """Searched for and found, asked to verify, covered, seeing garbage, lost and found again."""
    localizer, states = Watched(world_map), []

    def step(k, cloud=None, stamp=None):
        cloud = world_drive.clouds[k] if cloud is None else cloud
        fix = localizer.step(cloud, world_drive.T_odom_body[k], 0.5 * k if stamp is None else stamp)
        assert fix.state is localizer.state
        assert (fix.T_map_body is not None) == (fix.state is State.TRACKING)
        states.append(fix.state)

    usual = localizer.search.config
    localizer.search.config = replace(usual, acceptance=NEVER)
    for k in range(2):
        step(k)
    localizer.search.config = usual
    for k in range(2, 5):
        step(k)
    localizer.require_verification()
    states.append(localizer.state)
    step(4, stamp=2.1)
    step(5, garbage(5, 60))
    step(6, garbage(6))
    step(7, garbage(7))  # one frame may be garbage, two lose the place
    for k in (8, 9):
        step(k)
    moved = [(before, after) for before, after in pairwise(states) if after is not before]
    assert list(dict.fromkeys(moved)) == [
        (State.AMBIGUOUS, State.TRACKING),
        (State.TRACKING, State.DOUBTED),
        (State.DOUBTED, State.TRACKING),
        (State.DOUBTED, State.LOST),
        (State.LOST, State.TRACKING),
    ]
    begun, *moves = localizer.moves
    assert begun == (None, None, State.SEARCHING)
    assert len(moves) > len(states)
    for before, event, after in moves:
        assert next_state(before, event) is after
    changes = tuple(event for before, event, after in moves if after is not before)
    assert localizer.take_events() == changes
    assert localizer.take_events() == ()
    localizer.require_verification()
    localizer.reset()
    assert localizer.moves[-1][1:] == (None, State.SEARCHING)
    assert localizer.take_events() == ()
