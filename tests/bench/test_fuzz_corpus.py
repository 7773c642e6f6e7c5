"""Every input of the corpus gives a value or an error of ours, within the limits of time and memory."""

from pathlib import Path

import pytest

from bench.fuzz.child import TARGETS
from bench.fuzz.fuzz import CORPUS, replayed


def test_every_target_has_a_corpus() -> None:
    assert sorted(path.name for path in CORPUS.iterdir()) == sorted(TARGETS)


@pytest.mark.slow
def test_corpus_is_replayed_within_limits_and_seeds_are_accepted(tmp_path: Path) -> None:
    for name, outcome in replayed(list(TARGETS), tmp_path).items():
        assert not outcome["places"], outcome
        assert outcome["executions"] == len(list((CORPUS / name).iterdir())), outcome
        seeds = len(list((CORPUS / name).glob("seed-*")))
        # a query's parameters are no reply
        assert outcome["values"] >= seeds - (name == "rpc"), outcome
