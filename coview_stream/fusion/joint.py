"""Joint adjustment of the poses of several runs by registrations to the map, registrations to each other, and odometry.

The unknowns X_k are the poses of keyframes, 4 m apart. With e(A, B) = log(A^-1 B), the solution is the most probable
given

* registrations to the map: e(Y_k, X_k) ~ N(0, R_k)
* odometry within a run: e(Z_k, X_{k-1}^-1 X_k) ~ N(0, Q_k), Q estimated from the registrations, as in tracking
* registrations of overlapping submaps, from two runs or from one run at two times: e(Z_jk, X_j^-1 X_k) ~ N(0, R_jk)

all under Cauchy's kernel, beside a weak prior at ``locate``'s poses. Held-out pairs of submaps judge the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.fusion.constraints import AGREE, Registrar, Submap, off_by, overlapping, path_of, submaps_of
from coview_stream.fusion.fuse import Progress
from coview_stream.fusion.localized_run import LocalizedRun
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Poses, along_body, along_map, boxminus, interpolate, inverse
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.tracking.batch_graph import BatchGraph, Constraint
from coview_stream.localization.tracking.motion import DriftEstimator, worth_learning

# chosen by hand
_KERNEL = 3.0  # sigmas, scale of Cauchy's weights
_ANYWHERE = np.array([np.radians(10.0)] * 3 + [3.0] * 3)  # sigmas of the weak prior: radians, metres
_HELD_OUT = 4  # every fourth pair is held out to judge the result
_MIN_HELD_OUT = 3
_MAP_WORSE, _MAP_ROUNDING = 1.05, 0.002  # factor and metres by which the distance to the map may grow


@dataclass(frozen=True)
class Judgement:
    """Distances between surfaces before and after, metres: the mean of the pairs' or submaps' medians; NaN for none."""

    runs: tuple[float, float]  # between held-out submaps
    to_map: tuple[float, float]  # between submaps and the base map

    @property
    def better(self) -> bool:
        """Whether runs agree better with each other, and no worse with the map."""
        allowed = _MAP_WORSE * self.to_map[0] + _MAP_ROUNDING
        return self.runs[1] < self.runs[0] and not self.to_map[1] > allowed


@dataclass(frozen=True, eq=False)
class Joint:
    """Result of a joint adjustment: poses by run, (K, 4, 4) map <- body in the coordinates of the map's sources."""

    located: tuple[Poses, ...]  # by locate
    adjusted: tuple[Poses, ...]
    keyframes: int
    on_map: int  # registrations
    odometry: int  # steps between keyframes
    between: int  # used pairs of submaps from two runs
    loops: int  # used pairs of submaps from one run
    held_out: int  # pairs that judge the result
    residuals: tuple[float, float]  # median residual (off_by) of the used pairs before and after, sigmas
    judgement: Judgement | None  # None if too few pairs are held out

    @property
    def accepted(self) -> bool:
        """Whether the held-out overlaps show that the adjusted poses are better."""
        return self.judgement is not None and self.judgement.better

    @property
    def poses(self) -> tuple[Poses, ...]:
        """The adjusted poses if they are accepted, else the poses of ``locate``."""
        return self.adjusted if self.accepted else self.located

    def said(self) -> str:
        """Describe the result in a few lines."""
        first = (
            f"{'joint':<18} {self.keyframes} keyframes, {self.on_map} on the map, {self.odometry} by odometry, "
            f"{self.between} between runs, {self.loops} loops"
        )
        if self.judgement is None:
            why = f"only {self.held_out} overlaps to judge by; the poses of locate are kept"
            return f"{first}\n{'':<18} {why}"
        runs, to_map = self.judgement.runs, self.judgement.to_map
        both = zip(self.adjusted, self.located, strict=True)
        moved = [float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max()) for a, b in both]
        shift = f"runs moved by up to {', '.join(f'{metres:.2f}' for metres in moved)} m"
        return "\n".join([
            first,
            f"{'':<18} constraints between submaps off by {self.residuals[0]:.1f} sigma, then {self.residuals[1]:.1f}",
            f"{'':<18} {self.held_out} overlaps not used: surfaces {100 * runs[0]:.1f} cm apart, then "
            f"{100 * runs[1]:.1f}; from the map {100 * to_map[0]:.1f} cm, then {100 * to_map[1]:.1f} (medians)",
            f"{'':<18} {shift if self.accepted else 'not better: the poses of locate are kept'}",
        ])  # fmt: skip


def adjust(
    base_map: BaseMap, runs: Sequence[LocalizedRun], progress: Progress | None = None, *, relative: bool = True
) -> Joint:
    """Adjust the poses of runs jointly; the runs stay unchanged.

    Args:
        base_map: the map on which the runs were localized.
        runs: one or more runs.
        progress: called after each step.
        relative: use registrations between submaps; False adjusts by the map and odometry alone, for comparison.
    """
    submaps: list[Submap] = []
    for number, run in enumerate(runs):
        submaps += submaps_of(run, number, base_map.origin)
        if progress:
            progress(number + 1, len(runs), "submaps")
    registrar = Registrar(submaps, LocalMaps(base_map, 40.0))
    on_map = [constraint for k in range(len(submaps)) if (constraint := registrar.to_map(k))]
    pairs, candidates = [], overlapping(submaps)
    for done, (k, other) in enumerate(candidates, start=1):
        constraint = registrar.to_submap(k, other)
        if constraint is not None:
            pairs.append(constraint)
        if progress:
            progress(done, len(candidates), "overlaps")
    held_out, used = pairs[::_HELD_OUT], [pair for k, pair in enumerate(pairs) if k % _HELD_OUT]
    steps = _odometry(submaps, on_map)
    before = np.array([submap.T_map_body for submap in submaps])
    after = _solved(submaps, on_map, [*steps, *(used if relative else [])])
    judgement = None
    if len(held_out) >= _MIN_HELD_OUT:
        judgement = Judgement(
            _medians(lambda at: [registrar.apart(pair.source, pair.target, at) for pair in held_out], before, after),
            _medians(lambda at: [registrar.apart_from_map(k, at[k]) for k in range(len(submaps))], before, after),
        )
    loops = sum(submaps[pair.source].run == submaps[pair.target].run for pair in used)
    return Joint(
        tuple(run.poses for run in runs),
        tuple(_spread(run, number, submaps, after, base_map.origin) for number, run in enumerate(runs)),
        keyframes=len(submaps),
        on_map=len(on_map),
        odometry=len(steps),
        between=len(used) - loops,
        loops=loops,
        held_out=len(held_out),
        residuals=(_residual(used, before), _residual(used, after)),
        judgement=judgement,
    )


def _odometry(submaps: Sequence[Submap], on_map: Sequence[Constraint]) -> list[Constraint]:
    """Return odometry's steps, with the drift estimated from the run's registrations to the map.

    If an end of a step is not registered, the step of ``locate`` is used, unless it disagrees with odometry.
    """
    config = LocalizerConfig().tracking
    registered = {constraint.source: constraint for constraint in on_map}
    drifts = {submap.run: DriftEstimator(config) for submap in submaps}
    steps = [k for k in range(1, len(submaps)) if submaps[k].run == submaps[k - 1].run]
    out = []
    for k in steps:
        a, b = submaps[k - 1], submaps[k]
        driven, turned = b.driven - a.driven, b.turned - a.turned
        if k in registered and k - 1 in registered and worth_learning(driven, turned):
            first, second = registered[k - 1], registered[k]
            step = inverse(a.T_odom_body) @ b.T_odom_body
            noise = np.array([np.diag(along_map(end.covariance, end.T)) for end in (first, second)]).sum(axis=0)
            drifts[a.run].add(boxminus(second.T, first.T @ step), noise, driven, turned)
    for k in steps:
        a, b = submaps[k - 1], submaps[k]
        spread = drifts[a.run].drift.covariance(b.driven - a.driven, b.turned - a.turned)
        T = inverse(a.T_odom_body) @ b.T_odom_body
        by_odometry = Constraint(k, k - 1, T, along_body(spread, b.T_map_body))
        T_located = inverse(a.T_map_body) @ b.T_map_body
        alone = k not in registered or k - 1 not in registered
        smooth = alone and off_by(by_odometry, T_located) < AGREE
        out.append(replace(by_odometry, T=T_located) if smooth else by_odometry)
    return out


def _solved(submaps: Sequence[Submap], on_map: Sequence[Constraint], relative: Sequence[Constraint]) -> Floats:
    """Return the most probable poses (S, 4, 4)."""
    graph = BatchGraph(np.array([submap.T_map_body for submap in submaps]))
    anywhere = np.diag(_ANYWHERE**2)
    graph.add([Constraint(k, -1, submap.T_map_body, anywhere) for k, submap in enumerate(submaps)])
    graph.add([*on_map, *relative], ("Cauchy", _KERNEL))
    return graph.solve()


def _residual(constraints: Sequence[Constraint], poses: Floats) -> float:
    """Return the median residual (:func:`off_by`) of constraints between submaps, sigmas."""
    if not constraints:
        return float("nan")
    return float(np.median([off_by(c, inverse(poses[c.target]) @ poses[c.source]) for c in constraints]))


def _medians(apart: Callable[[Floats], list[Floats]], before: Floats, after: Floats) -> tuple[float, float]:
    def median(poses: Floats) -> float:
        medians = [np.median(distances) for distances in apart(poses) if len(distances)]
        return float(np.mean(medians)) if medians else float("nan")

    return median(before), median(after)


def _spread(run: LocalizedRun, number: int, submaps: Sequence[Submap], poses: Floats, origin: Floats) -> Poses:
    """Return poses (K, 4, 4) of all frames, moved like the keyframes around, interpolated by metres driven."""
    driven, _ = path_of(run.odometry)
    keys = [k for k, submap in enumerate(submaps) if submap.run == number]
    at = np.array([submaps[k].driven for k in keys])
    moves = [poses[k] @ inverse(submaps[k].T_map_body) for k in keys]
    old = run.poses.copy()
    old[:, :3, 3] -= origin
    out = np.empty_like(old)
    for k in range(len(out)):
        after = int(np.clip(np.searchsorted(at, driven[k]), 1, max(len(at) - 1, 1)))
        before, after = after - 1, min(after, len(at) - 1)
        share = 0.0 if after == before else float(np.clip((driven[k] - at[before]) / (at[after] - at[before]), 0, 1))
        out[k] = interpolate(moves[before] @ old[k], moves[after] @ old[k], share)
    out[:, :3, 3] += origin
    return np.asarray(out)
