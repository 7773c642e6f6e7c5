"""States of a robot, the events that change them, and their transitions (docs/tracking.md prints the table)."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """State of localization: how much is known of the robot's place."""

    SEARCHING = "SEARCHING"
    """No place explains the scans well enough, or there are too few points."""
    AMBIGUOUS = "AMBIGUOUS"
    """One place fits, but so does another, or the evidence does not suffice yet."""
    TRACKING = "TRACKING"
    """The pose is known, with odds of a wrong place below the risk."""
    DOUBTED = "DOUBTED"
    """A place is known, but has to be verified before there is a pose again."""
    LOST = "LOST"
    """A place was known, but its evidence has gone: the whole map is searched; or odometry or frames are missing."""

    @property
    def reported(self) -> str:
        """Name in messages and files, which have four states: DOUBTED is reported as AMBIGUOUS, with its cause."""
        return State.AMBIGUOUS.value if self is State.DOUBTED else self.value

    @property
    def has_place(self) -> bool:
        """Whether a place is known, with a pose (TRACKING) or without (DOUBTED)."""
        return self in (State.TRACKING, State.DOUBTED)


class Event(StrEnum):
    """Event that may change the state; its value is a clause for people."""

    NO_PLACE = "the search finds no place that fits"
    PLACE_PROPOSED = "the search finds a place that is not alone or not certain"
    PLACE_ACCEPTED = "the search accepts a place"
    MATCH_VERIFIED = "a registration speaks for the place"
    MATCH_REJECTED = "a registration makes the place or its pose doubtful"
    VERIFICATION_REQUIRED = "the robot may have been moved unseen"
    PLACE_GIVEN_UP = "too much has spoken against the place, or for too long"
    SCANS_CONTRADICT = "scans do not fit together where odometry puts them"


_S, _E = State, Event

TRANSITIONS: dict[tuple[State, Event], State] = {
    (_S.SEARCHING, _E.PLACE_PROPOSED): _S.AMBIGUOUS,
    (_S.SEARCHING, _E.PLACE_ACCEPTED): _S.TRACKING,
    (_S.AMBIGUOUS, _E.NO_PLACE): _S.SEARCHING,
    (_S.AMBIGUOUS, _E.PLACE_ACCEPTED): _S.TRACKING,
    (_S.AMBIGUOUS, _E.SCANS_CONTRADICT): _S.SEARCHING,
    (_S.TRACKING, _E.MATCH_REJECTED): _S.DOUBTED,
    (_S.TRACKING, _E.VERIFICATION_REQUIRED): _S.DOUBTED,
    (_S.TRACKING, _E.PLACE_GIVEN_UP): _S.LOST,
    (_S.DOUBTED, _E.MATCH_VERIFIED): _S.TRACKING,
    (_S.DOUBTED, _E.PLACE_GIVEN_UP): _S.LOST,
    (_S.LOST, _E.PLACE_ACCEPTED): _S.TRACKING,
}
"""State that follows on an event; an event without an entry changes nothing.

LOST stays LOST while the map is searched: only an accepted place ends it. A node loses a place for further reasons:
:class:`coview_stream.stream.node.robot_state.RobotState`.
"""


def next_state(state: State, event: Event) -> State:
    """Return the state that an event leads to."""
    return TRANSITIONS.get((state, event), state)
