"""Scores of places: hundreds of hypotheses of a keyframe at once, and the evidence of the best over all keyframes.

Each hypothesis is moved to the best pose around it, up to three metres and seven degrees away, by looking up what the
map has there (:mod:`coview_stream.localization.evidence.observation`). The best places are followed: every later
keyframe observes the map from them as well, and where a place is new, the keyframes before are asked as well, so that
places are compared on the same observations. The evidence of a place is the log-likelihood ratio of the mean of its
observations (:mod:`coview_stream.localization.evidence.likelihood`), against the background of all others.
docs/results.md has how often the right place comes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_kernels import Move
from coview_stream.basemap.basemap import BaseMap
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.localization.evidence.background import Most, estimate_background, left_in_mean, scatter
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.moved_part import NO_PART, MovedPart
from coview_stream.localization.evidence.observation import ObservedScan, Share, surroundings
from coview_stream.localization.evidence.posterior import expected_by_chance, posterior
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.request import SAME_ANGLE, SAME_DISTANCE

# set by hand
_PROMISING = 96  # best hypotheses that are looked up with many points
_FOLLOWED = 64  # best places that the next keyframe observes again
_KEPT = 16  # of them, those that stay by their evidence, however the newest keyframe ranks them
_KEYFRAMES = 12  # whose observations a place has: the newest, and those before that are farthest apart
_LOOK = 8  # keyframes: each so many are another chance of an error, and a part that moved is looked for in so many
_CHANCE = 128  # places at which the earlier keyframes are asked as well, how far chance goes on to fit
_CHANCE_DISTANCE, _CHANCE_ANGLE = 6.0, np.radians(20.0)  # from the leader: nearer places share what it explains
BASIN_DISTANCE, BASIN_ANGLE = (
    SAME_DISTANCE,
    float(np.radians(15.0)),
)  # from the leader: registration leads there; set by hand
_AROUND = np.array([(r * np.cos(a), r * np.sin(a)) for r in (3.5, 7.0) for a in np.arange(8) * np.pi / 4])
"""Shifts of the leader, metres, that are hypotheses too: along a corridor it may be anywhere."""


@dataclass(frozen=True)
class ScoredPlace:
    """A hypothesis at the best pose near it.

    Attributes:
        hypothesis: there.
        score: of the newest keyframe, in [0, 1], as verification has it.
        inside: share of the scan that lies where the map has been surveyed.
        hinted: whether a pose hint came to this place.
        ratio: log-likelihood ratio of the keyframes so far against chance.
        probability: posterior probability that the robot is here.
        kept: share of what stands that is as the map has it, as the evidence has it.
    """

    hypothesis: Hypothesis
    score: float
    inside: float
    hinted: bool = False
    ratio: float = 0.0
    probability: float = 0.0
    kept: float = 0.0


@dataclass(frozen=True)
class Rivals:
    """All places that one keyframe was scored at, best score first; no two are the same.

    Attributes:
        T_map_odom: (N, 4, 4).
        scores: (N,) float32 evidence scores in [0, 1]; those of the best hypotheses from four times as many points.
        inside: (N,) float32 shares of the scan that lie where the map has been surveyed.
    """

    T_map_odom: Floats
    scores: Floats32
    inside: Floats32

    def __len__(self) -> int:
        """Return the number of places N."""
        return len(self.scores)

    @classmethod
    def none(cls) -> Rivals:
        """Return no places."""
        nothing = np.empty(0, dtype=np.float32)
        return cls(np.empty((0, 4, 4)), nothing, nothing)


@dataclass(frozen=True)
class Scored:
    """What a keyframe's hypotheses came to.

    Attributes:
        rivals: all places.
        places: those that are followed, the most probable first.
        error: probability that the robot is not at the first of them.
        none: probability that it is at no place of the map.
        by_chance: expected number of chance places as good as the first.
        second: the most probable place elsewhere than the first, if there is any.
        moved: part of the scan that fits elsewhere than at the first.
    """

    rivals: Rivals
    places: list[ScoredPlace]
    error: float = 1.0
    none: float = 1.0
    by_chance: float = np.inf
    second: ScoredPlace | None = None
    moved: MovedPart = NO_PART

    def doubted(self, moved: MovedPart) -> Scored:
        """Return it with the error that a moved part adds: either part may be the one that stayed."""
        return replace(self, error=min(1.0, self.error + 0.5 * moved.probability), moved=moved)


@dataclass(frozen=True)
class _Followed:
    """P places that are followed, and their observations.

    Attributes:
        hypotheses: at the newest keyframe.
        votes: (P,) newest rank in the votes that named each, from 0.
        observed: (P, W, 7) at the keyframes, oldest first.
        newest: of each, the number of its pose among those that the newest keyframe was scored at.
        hinted: (P,) whether a pose hint came to it.
    """

    hypotheses: list[Hypothesis]
    votes: Ints
    observed: Floats32
    newest: Ints
    hinted: Bools

    @classmethod
    def none(cls) -> _Followed:
        nothing = np.empty(0, dtype=np.int64)
        return cls([], nothing, np.empty((0, 0, len(Share)), dtype=np.float32), nothing, nothing.astype(bool))

    def __getitem__(self, order: Ints) -> _Followed:
        own = [self.hypotheses[k] for k in order]
        return _Followed(own, self.votes[order], self.observed[order], self.newest[order], self.hinted[order])


@dataclass(frozen=True)
class _Observed:
    """H hypotheses of a keyframe, those that are followed first, at the best poses near them.

    Attributes:
        poses: (H, 4).
        shares: (H, 7) observations.
        scores: (H,) as verification has them.
        groups: numbers of the hypotheses at each place, its best first, the best place first.
    """

    poses: Floats
    shares: Floats32
    scores: Floats32
    groups: list[list[int]]

    @property
    def inside(self) -> Floats32:
        """(H,) shares of the scan that lie where the map has been surveyed."""
        return np.asarray(0.5 * (self.shares[:, Share.COVERED] + self.shares[:, Share.COVERED_GROUND]))


class PlaceScorer:
    """Places of a search, and what the keyframes so far have observed at them."""

    def __init__(self, base_map: BaseMap) -> None:
        """Score by a map's likelihood field, which is loaded at the first keyframe."""
        self._base_map = base_map
        self.clear()

    @property
    def scans(self) -> list[ObservedScan]:
        """Newest keyframes that are kept, eight at most, the newest last."""
        return self._scans[-_LOOK:]

    def clear(self) -> None:
        """Forget all places and keyframes."""
        self._followed = _Followed.none()
        self._seen = 0  # keyframes
        self._scans: list[ObservedScan] = []
        self._scatter: list[Floats] = []

    def score(self, hypotheses: Sequence[Hypothesis], votes: Sequence[int], hints: int, scan: ObservedScan) -> Scored:
        """Observe the map from a keyframe's hypotheses and from the places that are followed.

        Hypotheses that come to the same place (2 m, 5 degrees) are one: the best of them.

        Args:
            hypotheses: of ``T_map_odom``, of which the last ``hints`` are pose hints.
            votes: rank of each in the votes that named it, from 0; any number for a hint.
            hints: how many pose hints there are.
            scan: the keyframe's.
        """
        seen, known = scan, self._followed
        named = len(hypotheses) - hints
        fresh = [*hypotheses[:named], *self._around_leader(), *hypotheses[named:]]
        every = [*known.hypotheses, *fresh]
        ranks = np.full(len(every), len(every))
        ranks[: len(known.votes)] = known.votes + 1
        ranks[len(known.votes) : len(known.votes) + named] = votes[:named]
        observed = self._observe(seen, len(known.hypotheses), every)
        followed = self._follow(seen, observed, every, ranks, hints)
        first = np.array([group[0] for group in observed.groups], dtype=np.int64)
        ratios, kept = self._evidence(followed, observed, first, seen)
        order = np.argsort(np.log1p(followed.votes) - ratios, kind="stable")
        self._seen += 1
        self._scans.append(seen)
        self._followed = followed = followed[order]
        self._thin_out()
        chances = posterior(ratios[order], followed.votes, len(first), 1 + self._seen // _LOOK)
        numbers = zip(order, chances.place, followed.newest, strict=True)
        places = [
            ScoredPlace(
                followed.hypotheses[k], float(observed.scores[n]), float(observed.inside[n]), bool(followed.hinted[k]),
                float(ratios[old]), float(probability), float(kept[old]),
            )
            for k, (old, probability, n) in enumerate(numbers)
        ]  # fmt: skip
        rivals = Rivals(seen.transforms(observed.poses[first]), observed.scores[first], observed.inside[first])
        if not places:
            return Scored(rivals, places)
        poses = observed.poses[followed.newest]
        elsewhere = _apart(poses, poses[0], BASIN_DISTANCE, BASIN_ANGLE)
        second = next((place for place, other in zip(places, elsewhere, strict=True) if other), None)
        by_chance = expected_by_chance(places[0].ratio, len(first))
        return Scored(rivals, places, chances.error(~elsewhere), chances.none, by_chance, second)

    def _thin_out(self) -> None:
        """Forget one of too many keyframes: the one that is nearest to those beside it, for it saw least of its own.

        The newest is kept, and the first: what was seen far from here is the least like what is seen now.
        """
        if len(self._scans) <= _KEYFRAMES:
            return
        steps = np.linalg.norm(np.diff([scan.body for scan in self._scans], axis=0), axis=1)
        least = 1 + int((steps[:-1] + steps[1:]).argmin())
        del self._scans[least], self._scatter[least]
        kept = np.arange(self._followed.observed.shape[1]) != least
        self._followed = replace(self._followed, observed=self._followed.observed[:, kept])

    def _around_leader(self) -> list[Hypothesis]:
        """Return hypotheses beside the most probable place: along a corridor it may be anywhere."""
        if not self._followed.hypotheses:
            return []
        T = np.tile(self._followed.hypotheses[0].T_map_odom, (len(_AROUND), 1, 1))
        T[:, :2, 3] += _AROUND
        return [Hypothesis(each, None, None, 0.0) for each in T]

    def _observe(self, seen: ObservedScan, known: int, every: list[Hypothesis]) -> _Observed:
        """Observe the map from hypotheses, of which the first ``known`` are followed: odometry hardly drifts."""
        if not every:
            return _Observed(np.empty((0, 4)), _NOTHING, np.empty(0, dtype=np.float32), [])
        start = seen.poses(np.array([each.T_map_odom for each in every]))
        parts = [
            seen.few.look_up(self._base_map.field, start[:known], Move.NEAR),
            seen.few.look_up(self._base_map.field, start[known:], Move.FAR),
        ]
        poses, shares, scores = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("poses", "shares", "scores")
        )
        found = _Observed(poses, shares, scores, [])
        # some points tell what is far below the best; what is not is told apart by more
        promising = np.argsort(-scores * found.inside, kind="stable")[:_PROMISING]
        closer = seen.many.look_up(self._base_map.field, poses[promising], Move.NONE)
        shares[promising], scores[promising] = closer.shares, closer.scores
        return replace(found, groups=_places(poses, scores * found.inside))

    def _follow(
        self, seen: ObservedScan, observed: _Observed, every: list[Hypothesis], ranks: Ints, hints: int
    ) -> _Followed:
        """Choose the places to follow: the best now, the best so far, and what hints came to."""
        before = self._followed
        T = seen.transforms(observed.poses)
        chosen, hinted, known = [], [], []
        for number, group in enumerate(observed.groups):
            old = min(group)
            hint = hints > 0 and max(group) >= len(every) - hints
            if number < _FOLLOWED or old < min(_KEPT, len(before.votes)) or hint:
                chosen.append(group)
                hinted.append(hint)
                known.append(old if old < len(before.votes) else -1)
        hypotheses = []
        for group in chosen:
            # the votes for the place, if it has any: a hint that came to it takes none away
            own = next((every[k] for k in group if every[k].station is not None), every[group[0]])
            hypotheses.append(replace(own, T_map_odom=T[group[0]]))
        newest = np.array([group[0] for group in chosen], dtype=np.int64)
        votes = np.array([min(ranks[group].min(), len(observed.groups) - 1) for group in chosen], dtype=np.int64)
        past = np.empty((len(chosen), len(self._scans), len(Share)), dtype=np.float32)
        of = np.array(known, dtype=np.int64)
        if len(self._scans):
            past[of >= 0] = before.observed[of[of >= 0]]
            past[of < 0] = self._ask_earlier(T[newest[of < 0]])
        shares = np.concatenate([past, observed.shares[newest][:, None]], axis=1)
        return _Followed(hypotheses, votes, shares, newest, np.array(hinted, dtype=bool))

    def _ask_earlier(self, T_map_odom: Floats) -> Floats32:
        """Return what the earlier keyframes observe (P, W, 7) at new places, the drift since then undone."""
        out = np.empty((len(T_map_odom), len(self._scans), len(Share)), dtype=np.float32)
        for k in reversed(range(len(self._scans))):
            scan = self._scans[k]
            observed = scan.few.look_up(self._base_map.field, scan.poses(T_map_odom), Move.NEAR)
            out[:, k], T_map_odom = observed.shares, scan.transforms(observed.poses)
        return out

    def _evidence(
        self, followed: _Followed, observed: _Observed, first: Ints, seen: ObservedScan
    ) -> tuple[Floats, Floats]:
        """Return log-likelihood ratios (P,), and the shares (P,) of what is as the map has it."""
        mean = followed.observed.mean(axis=1)
        if not len(mean):
            self._scatter.append(np.full(4, np.nan))
            return np.empty(0), np.empty(0)
        scans = [*self._scans, seen]
        structure, free = np.mean([each.patches for each in scans], axis=0)
        most = Most(float(structure), float(free), surroundings(scans))
        poses, places = observed.poses[followed.newest], observed.poses[first]
        chance, kept = np.ones(len(first), dtype=bool), np.ones(len(mean), dtype=bool)
        self._scatter.append(scatter(observed.shares[first]))
        asked, over_time = self._over_time(observed, first, seen)
        for last in (False, True):
            known = [each for each in self._scatter if np.isfinite(each).all()] or [self._scatter[-1]]
            spread = np.mean(known, axis=0) * left_in_mean(over_time[chance[asked]])
            background = estimate_background(observed.shares[first][chance], spread, mean[kept], most)
            ratios, q = log_likelihood_ratios(mean, background)
            if last:
                break
            leader = poses[np.argmin(np.log1p(followed.votes) - ratios)]
            # what lies around the leader shares what it explains
            chance, kept = (_apart(each, leader, _CHANCE_DISTANCE, _CHANCE_ANGLE) for each in (places, poses))
            self._scatter[-1] = scatter(observed.shares[first][chance])
        return ratios, q

    def _over_time(self, observed: _Observed, first: Ints, seen: ObservedScan) -> tuple[Ints, Floats32]:
        """Return numbers (N,) of some of the places, and the observations (N, W, 7) of all keyframes there."""
        some = np.linspace(0, len(first) - 1, min(len(first), _CHANCE)).astype(np.int64)
        past = self._ask_earlier(seen.transforms(observed.poses[first[some]]))
        return some, np.concatenate([past, observed.shares[first[some]][:, None]], axis=1)


_NOTHING = np.empty((0, len(Share)), dtype=np.float32)


def _apart(poses: Floats, leader: Floats, distance: float, angle: float) -> Bools:
    """Tell which of (P, 4) poses are more than ``distance`` metres or ``angle`` radians from a leader (4,)."""
    turn = np.abs((poses[:, 3] - leader[3] + np.pi) % (2.0 * np.pi) - np.pi)
    return np.asarray((np.linalg.norm(poses[:, :3] - leader[:3], axis=1) > distance) | (turn > angle))


def _places(pose: Floats, rank: Floats32) -> list[list[int]]:
    """Group poses (H, 4): those at each place, its best first, the best place first."""
    order = np.argsort(-rank, kind="stable")
    x, y, z, yaw = pose[order].astype(np.float32).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    gap = np.square(x[:, None] - x)
    gap += np.square(y[:, None] - y)
    gap += np.square(z[:, None] - z)
    along = np.outer(cos, cos)
    along += np.outer(sin, sin)
    same = (gap < SAME_DISTANCE**2) & (along > np.cos(SAME_ANGLE))
    free = np.ones(len(order), dtype=bool)
    out = []
    for k, row in enumerate(same):
        if free[k]:
            members = np.flatnonzero(row & free)
            free[members] = False
            out.append(order[members].tolist())
    return out
