"""The peers as rows of the suite: ten places in each of two worlds, a line per peer and figure.

A trial ends after 30 s, so that a slow peer answers the first queries only; both sides' shares are of those. The whole
table, with all answers, is that of ``python -m bench.peers``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.harness.rows import Row, bounded, failed, informs
from bench.peers.contest import contest
from bench.peers.roster import OUR_TRACKING, OURS, PEERS
from bench.peers.trial import Trial
from bench.speed.engine import folder as worlds_folder

_PLACES, _QUICK = 10, 3
_LIMIT_S = 30.0


def rows(quick: bool = False, folder: Path | None = None) -> Iterator[Row]:
    """Compare ours with every peer: share of right poses, time of a query, false accepts."""
    trials = list(contest(folder or worlds_folder(), _QUICK if quick else _PLACES, _LIMIT_S))
    by_name = {peer.name: [t for t in trials if t.peer == peer.name] for peer in PEERS}
    for peer in PEERS:
        reference = by_name[OUR_TRACKING if peer.tracking else OURS]
        yield from judged(by_name[peer.name], reference, ours=peer.name.startswith(OURS))


def judged(theirs: Sequence[Trial], reference: Sequence[Trial], ours: bool) -> Iterator[Row]:
    """Rows of one peer beside ``reference``, our answers to the same queries; ``ours``: it is one of ours itself."""
    name = f"peers/{theirs[0].peer}"
    answered = [trial for trial in theirs if trial.answers]
    if not answered:
        why = "; ".join(dict.fromkeys(trial.trouble or "no answer" for trial in theirs))
        yield failed(name, why) if ours else informs(f"{name}: {why}", math.nan, "")
        return
    if ours:
        yield bounded(f"{name}, false accepts", sum(t.false_accepts() for t in theirs), "", 0)
        yield informs(f"{name}, right", _share(theirs), "%")
        yield informs(f"{name}, time of a query", _milliseconds(theirs), "ms")
        return
    same = [_cut(mine, trial) for trial in answered for mine in reference if mine.scene == trial.scene]
    share, their_share = _share(same), _share(answered)
    ratio = share / their_share if their_share else None
    yield Row(f"{name}, right", share, their_share, "%", ratio, "as often", share >= their_share)
    time, their_time = _milliseconds(same), _milliseconds(answered)
    yield Row(f"{name}, time of a query", time, their_time, "ms", their_time / time, "", None)
    yield informs(f"{name}, its false accepts", sum(t.false_accepts() for t in answered), "")


def _cut(mine: Trial, theirs: Trial) -> Trial:
    """Return our trial as far as theirs came."""
    return replace(mine, answers=mine.answers[: len(theirs.answers)])


def _share(trials: Sequence[Trial]) -> float:
    """Return how many of the answered queries have a right answer that it vouches for, %."""
    return 100.0 * sum(t.succeeded() for t in trials) / max(1, sum(len(t.answers) for t in trials))


def _milliseconds(trials: Sequence[Trial]) -> float:
    """Return the median time of all queries."""
    return 1e3 * float(np.median([a["seconds"] for t in trials for a in t.answers] or [math.nan]))
