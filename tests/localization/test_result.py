"""Evidence as plain data and back."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.state import State
from coview_stream.localization.tracking.monitor import RejectionReason


@pytest.mark.parametrize("cause", [None, *RejectionReason])
def test_evidence_json_round_trip(world_fixes, cause):
    known = world_fixes[-1].evidence
    rounded = replace(
        known,
        score=round(known.score, 4),
        evidence=replace(known.evidence, **{k: round(v, 4) for k, v in vars(known.evidence).items()}),
        cause=cause,
        innovation=None if cause is None else 12.25,
    )
    assert KeyframeEvidence.from_json(json.loads(json.dumps(rounded.to_json()))) == rounded
    blind = KeyframeEvidence(1.5, State.TRACKING, "only 3 points to register", cause=cause)
    assert KeyframeEvidence.from_json(json.loads(json.dumps(blind.to_json()))) == blind


def test_evidence_of_an_earlier_version_can_be_read(world_fixes):
    """Results were written before there were causes, and without the shares where nothing had been registered."""
    data = world_fixes[0].evidence.to_json()
    del data["cause"], data["innovation"]
    assert KeyframeEvidence.from_json(data).cause is None
    blind = KeyframeEvidence(1.5, State.TRACKING, "only 3 points to register", cause=RejectionReason.BLIND)
    short = {key: value for key, value in blind.to_json().items() if value is not None}
    assert "near" not in short
    assert KeyframeEvidence.from_json(short | {"station": None, "shift": None}) == blind


def test_evidence_json_always_has_the_same_keys(world_fixes):
    known = world_fixes[-1].evidence.to_json()
    blind = KeyframeEvidence(1.5, State.SEARCHING, "too few points").to_json()
    assert list(blind) == list(known)
    shares = ("near", "covered", "ground", "free_space", "inside")
    assert [blind[name] for name in shares] == [None] * 5
    assert all(0.0 <= known[name] <= 1.0 for name in shares)


@pytest.mark.parametrize("number", [math.inf, -math.inf, math.nan])
def test_what_is_no_finite_number_is_written_as_null(number):
    """JSON has no other word for it."""
    names = ("innovation", "confidence", "by_chance")
    evidence = KeyframeEvidence(1.5, State.SEARCHING, "odd", **dict.fromkeys(names, number))
    data = json.loads(json.dumps(evidence.to_json(), allow_nan=False))
    assert [data[name] for name in names] == [None] * 3


def test_evidence_keeps_small_numbers():
    found = KeyframeEvidence(1.5, State.TRACKING, "found", confidence=1.0 - 1e-12, by_chance=8.8377e-34)
    data = found.to_json()
    assert data["confidence"] == 1.0 - 1e-12
    assert data["by_chance"] == 8.84e-34


def test_doubted_evidence_is_written_as_ambiguous_with_its_cause():
    """Files know four states."""
    doubted = KeyframeEvidence(1.5, State.DOUBTED, "covered", cause=RejectionReason.BLIND)
    data = doubted.to_json()
    assert (data["state"], data["cause"]) == ("AMBIGUOUS", "blind")
    assert KeyframeEvidence.from_json(data) == replace(doubted, state=State.AMBIGUOUS)
