"""Scoring of hypotheses: hundreds per keyframe, and the evidence of the best ones over all keyframes.

A hypothesis moves to the best pose within three metres and seven degrees by the map's likelihood field
(:mod:`coview_stream.localization.evidence.observation`), and a hundred of them once more, by other points, so that the
leader is compared with rivals at their best. The best places are followed: later keyframes observe the map there too,
and earlier keyframes are looked up at new places, so all places have the same observations. The evidence of a place is
the log-likelihood ratio of its mean observation against the background of all others
(:mod:`coview_stream.localization.evidence.likelihood`). The places that lead are moved to one pose for all keyframes
(:mod:`coview_stream.localization.evidence.paths`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_kernels import Move
from coview_stream.basemap.basemap import BaseMap
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.transforms import Circle, Pose
from coview_stream.localization.evidence.background import (
    NEARBY_VARIANCE,
    Most,
    estimate_background,
    left_in_mean,
    observe_around,
    scatter,
)
from coview_stream.localization.evidence.likelihood import (
    expected_by_chance,
    log_likelihood_ratios,
    odds_of,
    posterior,
    ratio_variances,
)
from coview_stream.localization.evidence.observation import Observations, ObservedScan, Share, surroundings
from coview_stream.localization.evidence.open_places import SIGHT, OpenPlaces
from coview_stream.localization.evidence.paths import Paths, look_back
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.places import BASIN_ANGLE, BASIN_DISTANCE, Scored, apart, grouped, same
from coview_stream.localization.search.request import SAME_ANGLE, SAME_DISTANCE

_PROMISING = 96  # best hypotheses that are looked up with many points
_FOLLOWED = 64  # best places that the next keyframe observes again
_KEPT = 16  # places kept by their evidence, whatever their rank at the newest keyframe
_SETTLED = 8  # best places that are moved to one pose for all keyframes
_BEHIND = 12.0  # difference of log-ratios to the first place from which on a place is not moved: odds of 6e-6
_ASIDE = 3.0  # metres from the first place: nearer poses are its modes; benchmarks call a farther fix false
_NOWHERE = -60.0  # ratio of a place without a shift that counts: finite, as messages have to be
_FINER = 0.5, np.radians(0.5)  # metres, radians within which the newest keyframe's own pose is better
_KEYFRAMES = 12  # keyframes with observations: the newest and the most spread earlier ones
_NEWEST = 8  # newest keyframes, searched for a moved part
_CHANCE = 112  # places that measure the correlation of chance over keyframes
_RENEWED = 28  # of them, the oldest, replaced at each keyframe: only new ones are looked up at the earlier ones
_CHANCE_REACH = 6.0, np.radians(20.0)  # metres, radians from the leader; closer places share its explanation
# metres: shifts (25, 4) of poses x, y, z and heading among which a rival's best pose is
_AT_BEST = np.array([(x, y, 0.0, 0.0) for x in (-0.5, -0.25, 0.0, 0.25, 0.5) for y in (-0.5, -0.25, 0.0, 0.25, 0.5)])
AROUND = np.array([(r * np.cos(a), r * np.sin(a)) for r in (3.5, 7.0) for a in np.arange(8) * np.pi / 4])
"""Shifts of the leader, metres, as further hypotheses: along a corridor it may be anywhere."""


@dataclass(frozen=True)
class Followed:
    """P followed places and their observations."""

    hypotheses: list[Hypothesis]  # at the newest keyframe
    votes: Ints  # (P,) best rank of each in the votes, from 0; one more for each keyframe since
    observed: Floats32  # (P, W, 15) observations at and around the places at the keyframes, oldest first
    poses: Floats  # (P, W, 4) poses of these observations
    newest: Ints  # (P,) rows among the newest keyframe's poses

    @classmethod
    def none(cls) -> Followed:
        """Return no places, at no keyframes."""
        nothing = np.empty(0, dtype=np.int64)
        return cls([], nothing, np.empty((0, 0, NEARBY_VARIANCE.stop), dtype=np.float32), np.empty((0, 0, 4)), nothing)

    def __getitem__(self, order: Ints) -> Followed:
        hypotheses = [self.hypotheses[k] for k in order]
        return Followed(hypotheses, self.votes[order], self.observed[order], self.poses[order], self.newest[order])


@dataclass(frozen=True)
class _Observed:
    """Observations of a keyframe at H hypotheses, followed ones first, moved to the best poses near them."""

    poses: Floats  # (H, 4)
    shares: Floats32  # (H, 15) observations, also around the places' best hypotheses
    scores: Floats32  # (H,) evidence scores
    groups: list[list[int]]  # rows by place, best hypothesis and best place first

    @property
    def first(self) -> Ints:
        """(N,) rows of the places' best hypotheses."""
        return np.array([group[0] for group in self.groups], dtype=np.int64)

    @property
    def inside(self) -> Floats32:
        """(H,) shares of the scan in the surveyed area."""
        return np.asarray(0.5 * (self.shares[:, Share.COVERED] + self.shares[:, Share.COVERED_GROUND]))


class PlaceScorer:
    """Scorer of a search's places, with the keyframes' observations there.

    Attributes:
        starts: number of starts of the search since a place was accepted.
        area: the only searched part of the map; None for all of it.
        chance: chance places: poses (S, 4) at the newest keyframe, observations (S, W, 15) there at all keyframes.
    """

    def __init__(self, base_map: BaseMap) -> None:
        """Score by a map's likelihood field, which is loaded at the first keyframe."""
        self._base_map = base_map
        self.area: Circle | None = None
        self._open = OpenPlaces()
        self.clear()

    @property
    def scans(self) -> list[ObservedScan]:
        """Newest keyframes, eight at most, the newest last."""
        return self._scans[-_NEWEST:]

    @property
    def followed(self) -> Followed:
        """Followed places, the most probable first."""
        return self._followed

    def clear(self) -> None:
        """Forget all places, keyframes and starts."""
        self.starts = 1
        self._open.clear()
        self._followed = Followed.none()
        self._scans: list[ObservedScan] = []
        self._scatter: list[Floats] = []
        self.chance = np.empty((0, 4)), self._followed.observed

    def go_on_with(self, scans: list[ObservedScan]) -> None:
        """Start with earlier keyframes, oldest first, by which places are compared, too."""
        self._scans, self._scatter = scans, [np.full(4, np.nan)] * len(scans)
        nowhere = np.empty((0, len(scans), NEARBY_VARIANCE.stop), dtype=np.float32)
        none = replace(Followed.none(), observed=nowhere, poses=np.empty((0, len(scans), 4)))
        self._followed, self.chance = none, (np.empty((0, 4)), nowhere)

    def score(
        self, hypotheses: Sequence[Hypothesis], votes: Sequence[int], hints: int, scan: ObservedScan, prior: float = 0.0
    ) -> Scored:
        """Observe the map from a keyframe's hypotheses and from the followed places.

        Of hypotheses within 2 m and 5 degrees of each other only the best counts. The last ``hints`` hypotheses are
        pose hints. ``votes`` are the ranks of the hypotheses in their votes, from 0, any number for a hint. ``prior``,
        the log-probability of this reading of the scan, is added to the ratios of its places.
        """
        followed, voted = self._followed, len(hypotheses) - hints
        count = len(followed.hypotheses)
        all_hypotheses = [*followed.hypotheses, *hypotheses[:voted], *self._around_leader(), *hypotheses[voted:]]
        ranks = np.full(len(all_hypotheses), len(all_hypotheses))
        ranks[:count] = followed.votes + 1
        ranks[count : count + voted] = votes[:voted]
        observed = self._observe(scan, count, all_hypotheses)
        followed = self._follow(scan, observed, all_hypotheses, ranks, hints)
        first = observed.first
        ratios, variances = self._evidence(followed, observed, scan)
        if len(self._scans) and len(ratios):
            followed, ratios, variances = self._settled(followed, ratios, variances, scan)
        chances = posterior(ratios + prior, followed.votes, len(first), self.starts, variances)
        order = np.lexsort((np.log1p(followed.votes) - ratios, -chances.place))
        chances = replace(chances, place=chances.place[order])
        self._scans.append(scan)
        self._followed = followed = followed[order]
        self._leader = ratios[order[:1]], variances[order[:1]]
        self._thin_out()
        numbers = zip(ratios[order].tolist(), chances.place.tolist(), followed.newest, strict=True)
        places = [
            replace(place, score=float(observed.scores[row]), ratio=ratio, probability=probability)
            for place, (ratio, probability, row) in zip(followed.hypotheses, numbers, strict=True)
        ]
        if not places:
            return Scored(len(first), places)
        poses = scan.poses(np.array([place.T_map_odom for place in places]))
        elsewhere = apart(poses, poses[0], BASIN_DISTANCE, BASIN_ANGLE)
        second = next((place for place, other in zip(places, elsewhere, strict=True) if other), None)
        by_chance = expected_by_chance(places[0].ratio, len(first))
        return Scored(len(first), places, chances.error(~elsewhere), chances.none, by_chance, second)

    def beside_leader(self, T_map_odom: Floats, scan: ObservedScan) -> list[Hypothesis]:
        """Return those of further places (H, 4, 4) that are not scored yet, with their odds against the leader.

        They have the leader's prior probability, as no vote has ranked them, and the background of the newest keyframe.
        """
        layers = self._base_map.field
        known = scan.poses(np.array([place.T_map_odom for place in self._followed.hypotheses]))
        part = scan.many.look_up(layers, scan.few.look_up(layers, scan.poses(T_map_odom), Move.FAR).poses, Move.NEAR)
        new = [
            group[0] for group in grouped(part.poses, part.scores)
            if apart(known, part.poses[group[0]], SAME_DISTANCE, SAME_ANGLE).all()
            and apart(part.poses[group[:1]], known[0], BASIN_DISTANCE, BASIN_ANGLE).all()
        ]  # fmt: skip
        return self._against_leader(part, new, scan) if new else []

    def at_their_best(self, leader: Pose, T_map_odom: Floats, votes: Ints, scan: ObservedScan) -> list[Hypothesis]:
        """Return H other places with their odds against the leader, by registered poses (4, 4) and (H, 4, 4).

        Each, and the leader, is moved to the pose, of 25 around it, that the newest keyframe's evidence prefers: half a
        metre may change the evidence more than a copy. ``votes`` (H,) are the places' ranks in their votes. Zero odds
        if a place is moved to the leader.
        """
        poses, layers = scan.poses(np.stack([leader, *T_map_odom])), self._base_map.field
        grid = (poses[:, None] + _AT_BEST).reshape(-1, 4)
        part, around = scan.many.look_up(layers, grid, Move.HEIGHT), observe_around(layers, scan.few, poses)
        shares = np.column_stack([part.shares, np.repeat(around, len(_AT_BEST), axis=0)])
        ratios = log_likelihood_ratios(shares, self._background).reshape(len(poses), -1)
        best = ratios.argmax(axis=1) + len(_AT_BEST) * np.arange(len(poses))
        aside = apart(part.poses[best[1:]], part.poses[best[0]], BASIN_DISTANCE, BASIN_ANGLE)
        first = self._followed.votes[:1]
        out = self._against_leader(part, best.tolist(), scan, np.log1p(np.append(first, votes)) - np.log1p(first))[1:]
        return [place if other else replace(place, probability=0.0) for place, other in zip(out, aside, strict=True)]

    def _against_leader(
        self, part: Observations, new: list[int], scan: ObservedScan, behind: Floats | None = None
    ) -> list[Hypothesis]:
        """Return places at the rows ``new`` of observed poses, with their odds against the leader by all keyframes.

        ``behind`` are log-odds of the leader's prior against theirs, even by default; with them the first row is a
        further pose of the leader.
        """
        layers, scans = self._base_map.field, self._scans
        at = scan.transforms(part.poses[new])
        newest = np.column_stack([part.shares[new], observe_around(layers, scan.few, part.poses[new])])
        seen, poses = look_back(layers, scans[:-1], at)
        each = np.concatenate([seen, newest[:, None]], axis=1)
        observed = each.mean(axis=1)
        ratios = log_likelihood_ratios(observed, self._background)
        if len(scans) > 1:  # as the leader's
            poses = np.concatenate([poses, part.poses[new][:, None]], axis=1)
            found = Paths.of(layers, scans, poses, each).settled(self._background)
            aside = None
            if behind is not None:  # shifts of a rival that lead to the leader are no evidence for the rival
                aside = apart(found.shifted.reshape(-1, 4), part.poses[new[0]], _ASIDE, BASIN_ANGLE)
                aside = aside.reshape(found.table.shape)
                aside[0] = True
            ratios = np.maximum(ratios, found.ratios(aside))
        leader, variance = self._leader
        gaps = leader - ratios
        if behind is not None:
            gaps = np.maximum(leader, ratios[0]) - ratios + behind
        odds = odds_of(gaps, variance + self._left * ratio_variances(observed, self._background))
        rows = zip(at, part.scores[new].tolist(), ratios.tolist(), odds.tolist(), strict=True)
        return [Hypothesis(T, score=score, ratio=ratio, probability=each) for T, score, ratio, each in rows]

    def look_back(self, T_map_odom: Floats) -> tuple[Pose, Floats]:
        """Return odometry's pose (4, 4) at the first keyframe, and there poses (M, 4) of the paths of (M, 4, 4)."""
        newest = self._scans[-1].poses(T_map_odom)
        observed, poses = look_back(self._base_map.field, self._scans[:-1], self._scans[-1].transforms(newest))
        poses = np.concatenate([poses, newest[:, None]], axis=1)
        return self._scans[0].T_odom_body, Paths.of(self._base_map.field, self._scans, poses, observed).poses[:, 0]

    def beside(self, T_map_odom: Floats) -> Floats:
        """Return log-likelihood ratios (M,) of poses (M, 4, 4) beside the most probable place.

        A pose shifts the place's whole path, by the same step at all keyframes. Chance is the same for all poses, as is
        its error.
        """
        layers, first = self._base_map.field, self._followed[np.arange(1)]
        newest = self._scans[-1].poses(first.hypotheses[0].T_map_odom[None])
        _, poses = look_back(layers, self._scans[:-1], self._scans[-1].transforms(newest))
        paths = Paths.of(layers, self._scans, np.concatenate([poses, newest[:, None]], axis=1), first.observed)
        moves = self._scans[-1].poses(T_map_odom) - paths.poses[:, -1]
        moves[:, 2], moves[:, 3] = 0.0, (moves[:, 3] + np.pi) % (2.0 * np.pi) - np.pi
        return log_likelihood_ratios(paths.observe(moves[None], many=True)[0], self._background)

    def _thin_out(self) -> None:
        """Drop the keyframe closest to its neighbours if there are too many; the first and the newest stay."""
        if len(self._scans) <= _KEYFRAMES:
            return
        steps = np.linalg.norm(np.diff([scan.body for scan in self._scans], axis=0), axis=1)
        least = 1 + int((steps[:-1] + steps[1:]).argmin())
        del self._scans[least], self._scatter[least]
        self._open.forget(least)
        rest = np.arange(self._followed.observed.shape[1]) != least
        followed = self._followed
        self._followed = replace(followed, observed=followed.observed[:, rest], poses=followed.poses[:, rest])
        self.chance = self.chance[0], self.chance[1][:, rest]

    def _around_leader(self) -> list[Hypothesis]:
        if not self._followed.hypotheses:
            return []
        T = np.tile(self._followed.hypotheses[0].T_map_odom, (len(AROUND), 1, 1))
        T[:, :2, 3] += AROUND
        return [Hypothesis(pose) for pose in T]

    def _observe(self, scan: ObservedScan, followed: int, hypotheses: list[Hypothesis]) -> _Observed:
        """Observe the map from hypotheses; the first ``followed`` are followed places and hardly drift."""
        if not hypotheses:
            nothing = np.empty((0, NEARBY_VARIANCE.stop), dtype=np.float32)
            return _Observed(np.empty((0, 4)), nothing, np.empty(0, dtype=np.float32), [])
        start, layers = scan.poses(np.array([hypothesis.T_map_odom for hypothesis in hypotheses])), self._base_map.field
        parts = (
            scan.few.look_up(layers, start[:followed], Move.NEAR),
            scan.few.look_up(layers, start[followed:], Move.FAR),
        )
        poses, shares, scores = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("poses", "shares", "scores")
        )
        coarse = _Observed(poses, shares, scores, [])
        # a few points rule out most hypotheses; more points move the rest again, mostly by decimetres, and rank them
        promising = np.argsort(-scores * coarse.inside, kind="stable")[:_PROMISING]
        closer = scan.many.look_up(layers, poses[promising], Move.NEAR)
        poses[promising], shares[promising], scores[promising] = closer.poses, closer.shares, closer.scores
        found = replace(coarse, groups=grouped(poses, scores * coarse.inside))
        around = np.zeros((len(poses), 8), dtype=np.float32)
        around[found.first] = observe_around(layers, scan.few, poses[found.first])
        return replace(found, shares=np.column_stack([shares, around]))

    def _follow(
        self, scan: ObservedScan, observed: _Observed, hypotheses: list[Hypothesis], ranks: Ints, hints: int
    ) -> Followed:
        """Choose the places to follow: the best at this keyframe, the best so far, and those of hints."""
        before = self._followed
        count = len(before.votes)
        T = scan.transforms(observed.poses)
        chosen, origins = [], []
        for number, group in enumerate(observed.groups):
            origin = min(group)
            hinted = hints > 0 and max(group) >= len(hypotheses) - hints
            if number < _FOLLOWED or origin < min(_KEPT, count) or hinted:
                # keep the votes of the place, if any, even if a hint is there
                hypothesis = next(
                    (hypotheses[k] for k in group if hypotheses[k].station is not None), hypotheses[group[0]]
                )
                chosen.append((group, replace(hypothesis, T_map_odom=T[group[0]], hinted=hinted)))
                origins.append(origin if origin < count else -1)
        newest = np.array([group[0] for group, _ in chosen], dtype=np.int64)
        rank, last = ranks.tolist(), len(observed.groups) - 1
        votes = np.array([min(last, *(rank[row] for row in group)) for group, _ in chosen], dtype=np.int64)
        history = np.empty((len(chosen), len(self._scans), NEARBY_VARIANCE.stop), dtype=np.float32)
        poses = np.empty((len(chosen), len(self._scans), 4))
        row = np.array(origins, dtype=np.int64)
        if len(self._scans):
            # a pose refined by more keyframes is better: the best places are looked up again from there
            anew = row < min(_KEPT, count)
            history[~anew], poses[~anew] = before.observed[row[~anew]], before.poses[row[~anew]]
            history[anew], poses[anew] = look_back(self._base_map.field, self._scans, T[newest[anew]])
        shares = np.concatenate([history, observed.shares[newest][:, None]], axis=1)
        poses = np.concatenate([poses, observed.poses[newest][:, None]], axis=1)
        return Followed([place for _, place in chosen], votes, shares, poses, newest)

    def _settled(
        self, followed: Followed, ratios: Floats, variances: Floats, scan: ObservedScan
    ) -> tuple[Followed, Floats, Floats]:
        """Move each leading place to one pose for all keyframes; return the places, their ratios and variances.

        If this moves a place to the first place, only the evidence of its shifts that are not beside the first counts.
        """
        order = np.argsort(np.log1p(followed.votes) - ratios, kind="stable")
        top = order[:_SETTLED]
        top = top[ratios[top] > ratios[top[0]] - _BEHIND]
        part = followed[top]
        found = Paths.of(self._base_map.field, [*self._scans, scan], part.poses, part.observed).settled(
            self._background
        )
        mean, spread = found.ratios(), self._left * ratio_variances(found.observed, self._background)
        better = mean > ratios[top]
        own, several = part.poses[:, -1], np.where(better, mean, ratios[top])
        away = apart(found.poses - own, np.zeros(4), *_FINER)
        at = np.where(away[:, None], found.poses, own)
        first = int(np.argmin(np.log1p(part.votes) - several))
        reach = BASIN_DISTANCE, BASIN_ANGLE
        leads = ~apart(found.poses, at[first], *reach) & apart(own, at[first], *reach)
        shifts = found.shifted.reshape(-1, 4)
        rest = found.ratios(apart(shifts, at[first], _ASIDE, BASIN_ANGLE).reshape(found.table.shape))
        ratios, variances, places = ratios.copy(), variances.copy(), list(followed.hypotheses)
        ratios[top] = np.where(leads, np.maximum(rest, _NOWHERE), several)
        variances[top] = np.where(better | leads, spread, variances[top])
        T = scan.transforms(np.where(leads[:, None], own, at))
        for k, row in enumerate(top.tolist()):
            places[row] = replace(places[row], T_map_odom=T[k])
        return replace(followed, hypotheses=places), ratios, variances

    def _evidence(self, followed: Followed, observed: _Observed, scan: ObservedScan) -> tuple[Floats, Floats]:
        """Return log-likelihood ratios (P,) against the places that are not around the leader, and their variances."""
        mean, first = followed.observed.mean(axis=1), observed.first
        if not len(mean):
            self._scatter.append(np.full(4, np.nan))
            self._open.clear()
            self.chance = np.empty((0, 4)), followed.observed
            return np.empty(0), np.empty(0)
        scans = [*self._scans, scan]
        structure, free = np.mean([at.patches for at in scans], axis=0)
        most = Most(float(structure), float(free), surroundings(scans))
        poses, places = observed.poses[followed.newest], observed.poses[first]
        chance, distant = np.ones(len(first), dtype=bool), np.ones(len(mean), dtype=bool)
        grounds, near = np.concatenate([observed.shares[first], mean]), np.zeros(len(first) + len(mean), dtype=bool)
        self._scatter.append(scatter(observed.shares[first]))
        stations = [-1 if place.station is None else place.station for place in followed.hypotheses]
        above = (poses[:, 2] - self._base_map.stations[stations, 2])[np.array(stations) >= 0]
        anywhere = self._base_map.stations
        anywhere = anywhere if self.area is None else anywhere[self.area.holds(anywhere)]
        height = float(np.median(above)) if len(above) else 0.0
        self._open.look(self._base_map.field, anywhere, self._scans, scan, height)
        self.chance = sample, over_time = self._over_time(places, observed.shares[first], scan)
        wrong, elsewhere, leader = np.ones(len(sample), dtype=bool), np.ones(len(sample), dtype=bool), None
        for last in (False, True):
            measured = [row for row in self._scatter if np.isfinite(row).all()] or [self._scatter[-1]]
            left = left_in_mean(over_time[wrong])
            spread = np.mean(measured, axis=0) * left
            wide = np.concatenate([chance, distant])
            # ground near the leader counts only where there is little elsewhere
            ground = grounds[wide][np.argsort(near[wide], kind="stable")[: max(_FOLLOWED, int((wide & ~near).sum()))]]
            background = estimate_background(observed.shares[first][chance], spread, ground, most)
            background = replace(background, open=self._open.share(over_time[elsewhere].mean(1), background, leader))
            ratios = log_likelihood_ratios(mean, background)
            if last:
                break
            leader = poses[np.argmin(np.log1p(followed.votes) - ratios)]
            elsewhere = apart(sample, leader, SIGHT, np.pi)
            # places around the leader share its explanation
            chance, distant, wrong = (apart(at, leader, *_CHANCE_REACH) for at in (places, poses, sample))
            near = ~apart(np.concatenate([places, poses]), leader, SIGHT, np.pi)
            self._scatter[-1] = scatter(observed.shares[first][chance])
        self._background, self._left = background, float(left[:3].mean())
        return ratios, self._left * ratio_variances(mean, background)  # shrinks like the scatter

    def _over_time(self, places: Floats, shares: Floats32, scan: ObservedScan) -> tuple[Floats, Floats32]:
        """Return poses (S, 4) of chance places at a keyframe, and observations (S, W, 15) there at all keyframes.

        They are the newest of the last keyframe, and some of ``places`` (N, 4), best first, seen as ``shares`` (N, 15).
        """
        layers, (poses, history) = self._base_map.field, self.chance
        poses, history = poses[_RENEWED - _CHANCE :], history[_RENEWED - _CHANCE :]
        poses = scan.poses(self._scans[-1].transforms(poses)) if self._scans else poses
        again = scan.few.look_up(layers, poses, Move.NEAR)
        now = np.column_stack([again.shares, observe_around(layers, scan.few, again.poses)])
        history = np.concatenate([history, now[:, None]], axis=1)
        others = np.flatnonzero(~same(places, again.poses).any(axis=1))
        rows = others[np.linspace(0, len(others) - 1, min(len(others), _CHANCE - len(poses))).astype(np.int64)]
        rows = rows[np.argsort(np.arange(len(rows)) % (_CHANCE // _RENEWED), kind="stable")]  # renewed at all scores
        earlier = look_back(layers, self._scans, scan.transforms(places[rows]))[0]
        new = np.concatenate([earlier, shares[rows][:, None]], axis=1)
        return np.concatenate([again.poses, places[rows]]), np.concatenate([history, new])
