"""Ambiguity of a map: the distance that a robot has to drive from its stations until it is localized.

A virtual scan of the map at a station (:func:`virtual_scan`), with a share of the site changed since the survey, is
scored like the keyframe of a search, at places that the station's descriptors vote for and at places around the
station. While the error exceeds the risk, the robot drives along the longest open path and adds keyframes.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from coview_stream.basemap.basemap import BaseMap, station_descriptors
from coview_stream.clouds.progress import Progress
from coview_stream.config import LocalizerConfig, RegistrationConfig
from coview_stream.descriptors.coview import EYE
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Indices, Ints
from coview_stream.geometry.rasters import min_filter
from coview_stream.geometry.transforms import Points, norms, pose_from, yaw_of
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.clouds import prepare_scan
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.places import Scored
from coview_stream.localization.search.retrieval import Retrieval, StationConsensus
from coview_stream.localization.search.scoring import AROUND, PlaceScorer

STATIONS = 1000  # at most; a twentieth of a second each
_DRIVES = 100  # simulated drives from stations that are not localized at once; the rest copy their nearest neighbour
_CHANGED = 0.3  # share of the site that has changed since the survey
_KEYFRAMES = (2.0, 4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 25.0, 30.0, 35.0, 40.0)  # metres driven
FARTHEST = _KEYFRAMES[-1]
"""Maximum driving distance in metres."""
_RIGHT_DISTANCE, _RIGHT_ANGLE = 2.0, np.radians(15.0)  # metres, radians: the place itself
_HEADINGS = 16  # directions of a drive
_SHARPEST = np.radians(100.0)  # largest turn between two straights
_STEP = 1.0  # metres; a path is open if all steps have a station
_SHORTEST = 3  # least steps of a path
_TALL, _HALF_WIDTH = 2.0, 0.8  # metres: height of obstacles, half width of the robot
_STOREY = 2.5  # metres, least height of a cell of the sample
_KEPT_SCANS = 8  # newest virtual scans that are kept

# of a virtual scan
_RANGE = 40.0  # metres, horizontally
_NEAREST = 1.0  # metres; nearer points are left out
_BEAM = np.radians(1.0)  # cell of the range image that models occlusion
_UP, _DOWN = 22, 22  # cells above and below the horizon: the field of view of common lidars
_COLUMNS = 360  # cells around
_HOLES = ((7.0, 5), (16.0, 3))  # up to these metres, surfaces of quarter-metre voxels have gaps of so many cells
_SLACK, _SLACK_SLOPE = 0.4, 0.03  # metres, and metres per metre of range, still visible behind the nearest point
_NOISE = 0.03  # metres, sigma of each coordinate
_CHANGE_PATCH = 4.0  # metres, edge of a patch that changes as a whole
_MOVED = (3.0, 6.0)  # metres, range of its shift
_TABLE = 64  # patches along each axis until the random draws repeat


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """Driving distances from K stations until a robot is localized."""

    station: Indices  # (K,) indices of the stations
    position: Floats  # (K, 3) their positions, metres, relative to the map's origin
    drive: Floats  # (K,) metres; 0 at once, infinite if not within 40 m or before the path ends
    driven: Bools  # (K,) whether drive was simulated there; otherwise it is the nearest simulated station's
    evidence: Floats  # (K,) log-likelihood ratio of the place against chance at the first keyframe, nats
    lead: Floats  # (K,) its difference to the best place elsewhere, nats
    error: Floats  # (K,) probability at the first keyframe that the robot is elsewhere
    wrong: Bools  # (K,) whether a search would have accepted another place
    risk: float  # accepted probability of an error
    changed: float  # presumed share of the site that has changed since the survey

    def __len__(self) -> int:
        """Return the number of stations K."""
        return len(self.station)

    def share(self, metres: float) -> float:
        """Return the share of the stations from which the robot is localized within ``metres``."""
        return float((self.drive <= metres).mean()) if len(self) else 0.0


def ambiguity(
    base_map: BaseMap,
    config: LocalizerConfig | None = None,
    count: int = STATIONS,
    changed: float = _CHANGED,
    progress: Progress | None = None,
) -> Ambiguity:
    """Measure a map's ambiguity at no more than ``count`` of its stations, evenly spread.

    The risk in ``config`` decides. ``changed`` is the share of the site in [0, 1] that has changed since the survey.
    ``progress`` is called with the numbers of finished stations and of all, then again for the simulated drives.

    Raises:
        MapError: the map's likelihood field cannot be used.
    """
    rehearsal = _Rehearsal(base_map, config or LocalizerConfig(), changed)
    station = sample(base_map, count)
    trials = [rehearsal.begin(int(trial)) for trial in _counted(station, progress)]
    waiting = np.flatnonzero([not trial.found and not trial.wrong for trial in trials])
    driven_rows = waiting[np.linspace(0, len(waiting) - 1, min(_DRIVES, len(waiting))).round().astype(np.int64)]
    drive = np.where([trial.found for trial in trials], 0.0, np.inf)
    wrong = np.array([trial.wrong for trial in trials], dtype=bool)
    for k in _counted(driven_rows, progress):
        drive[k], wrong[k] = rehearsal.drive(int(station[k]))
    position = base_map.stations[station].astype(np.float64)
    for k in np.setdiff1d(waiting, driven_rows):
        drive[k] = drive[driven_rows[np.argmin(np.linalg.norm(position[driven_rows] - position[k], axis=1))]]
    values = np.array([(trial.evidence, trial.lead, trial.error) for trial in trials]).reshape(-1, 3)
    evidence, lead, error = values.T
    driven = ~np.isin(np.arange(len(station)), np.setdiff1d(waiting, driven_rows))
    return Ambiguity(
        station, position, drive=drive, driven=driven, evidence=evidence, lead=lead, error=error, wrong=wrong,
        risk=rehearsal.config.acceptance.risk, changed=changed,
    )  # fmt: skip


def sample(base_map: BaseMap, count: int) -> Indices:
    """Return no more than ``count`` stations, evenly spread: one per cell of the finest possible grid."""
    stations = base_map.stations.astype(np.float64)
    block = cell = base_map.config.block
    stations -= stations.min(axis=0) - 0.5 * cell
    levels = int(np.unique(_numbers(stations[:, :2], (block, block)), return_counts=True)[1].max(initial=1))
    while len(stations) > count * levels * (cell / block + 2.0) ** 2:  # more than ``count`` cells even if all are full
        cell *= 1.05
    while True:
        number = _numbers(stations, (cell, cell, max(cell, _STOREY)))
        if len(np.unique(number)) <= count:
            middle = (np.floor(stations[:, :2] / cell) + 0.5) * cell
            order = np.argsort(np.linalg.norm(stations[:, :2] - middle, axis=1), kind="stable")
            return np.sort(order[np.unique(number[order], return_index=True)[1]])
        cell *= 1.05


def _numbers(positions: Floats, cell: tuple[float, ...]) -> Ints:
    """Return the cell number (N,) of non-negative positions (N, D)."""
    index = np.floor(positions / cell).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0, initial=0) + 1)))


def _counted(items: Indices, progress: Progress | None) -> Iterator[int]:
    for done, item in enumerate(items.tolist()):
        yield item
        if progress is not None:
            progress(done + 1, len(items))


@dataclass(frozen=True)
class _Seen:
    """Result of a search at a station, with numbers as in :class:`Ambiguity`."""

    found: bool
    wrong: bool
    evidence: float
    lead: float
    error: float


class _Rehearsal:
    """Search without a robot: its keyframes are virtual scans of the map at stations."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, changed: float) -> None:
        self.base_map = base_map
        self.config = config
        self.changed = changed
        self._retrieval = Retrieval(base_map)
        self._scorer = PlaceScorer(base_map)
        self._scans: OrderedDict[tuple[float, ...], ObservedScan | None] = OrderedDict()
        self._clear()

    def _clear(self) -> None:
        self._consensus = StationConsensus(self._retrieval, self.config.consensus)
        self._scorer.clear()

    def begin(self, station: int) -> _Seen:
        """Search for a station by one keyframe."""
        self._clear()
        return self._look(self.base_map.stations[station].astype(np.float64), station)

    def drive(self, station: int) -> tuple[float, bool]:
        """Drive from a station; return the metres until it is localized, and whether another place was accepted."""
        if self.begin(station).wrong:
            return np.inf, True
        for metres, place in self._way(self.base_map.stations[station].astype(np.float64)):
            trial = self._look(place, int(self.base_map.station_grid.at(place[None])[0]))
            if trial.found or trial.wrong:
                return (metres, False) if trial.found else (np.inf, True)
        return np.inf, False

    def _look(self, place: Floats, station: int) -> _Seen:
        """Add a keyframe at a place (3,) on the ground, near a station."""
        scan = self._scan(place)
        if scan is None:
            return _Seen(False, False, 0.0, 0.0, 1.0)
        query = {
            name: descriptor.astype(np.float32)
            for name, descriptor in station_descriptors(self.base_map, station).items()
        }
        self._consensus.vote(self.base_map.stations[station].astype(np.float64), query)
        voted = self._consensus.hypotheses()
        shifted = np.tile(np.eye(4), (len(AROUND), 1, 1))
        shifted[:, :2, 3] = AROUND
        others = [*voted, *(Hypothesis(T, station, 0, 0.0) for T in shifted)]
        scored = self._scorer.score([Hypothesis(np.eye(4), station, 0, 0.0), *others], range(len(others) + 1), 0, scan)
        return _judged(scored, scan.T_odom_body[:3, 3], self.config.acceptance.risk)

    def _scan(self, place: Floats) -> ObservedScan | None:
        """Return the virtual scan at a place (3,) on the ground."""
        key = tuple(place.tolist())
        if key not in self._scans:
            eye = place + np.array([0.0, 0.0, EYE])
            self._scans[key] = virtual_scan(self.base_map, eye, self.changed, self.config.registration)
            if len(self._scans) > _KEPT_SCANS:
                self._scans.popitem(last=False)
        return self._scans[key]

    def _way(self, place: Floats) -> Iterator[tuple[float, Floats]]:
        """Yield the next keyframes: metres driven and places (3,) on the ground."""
        driven, heading = 0.0, None
        due = deque(_KEYFRAMES)
        while due:
            places, heading = self._straight(place, heading, due[-1] - driven)
            if len(places) < _SHORTEST:
                return
            while due and due[0] <= driven + len(places) * _STEP:
                metres = due.popleft()
                yield metres, places[round((metres - driven) / _STEP) - 1]
            driven, place = driven + len(places) * _STEP, places[-1]

    def _straight(self, place: Floats, before: float | None, metres: float) -> tuple[Floats, float]:
        """Return the longest straight path (N, 3) from a place, in steps of a metre, and its heading."""
        scan = self._scan(place)
        high = np.empty((0, 3)) if scan is None else scan.cloud.points[scan.cloud.above] - place
        obstacle = high[high[:, 2] < _TALL, :2]
        best, chosen = np.empty((0, 3)), 0.0
        for heading in np.arange(_HEADINGS) * (2.0 * np.pi / _HEADINGS):
            if before is not None and abs((heading - before + np.pi) % (2.0 * np.pi) - np.pi) > _SHARPEST:
                continue
            along = np.array([np.cos(heading), np.sin(heading)])
            ahead, across = obstacle @ along, obstacle @ (-along[1], along[0])
            blocking = ahead[(np.abs(across) < _HALF_WIDTH) & (ahead > 0.0)]
            free = min(metres, float(blocking.min(initial=np.inf)) - _HALF_WIDTH)
            ways = self._with_stations(place, along, int(free / _STEP))
            if len(ways) > len(best):
                best, chosen = ways, float(heading)
        return best, chosen

    def _with_stations(self, place: Floats, along: Floats, steps: int) -> Floats:
        """Return the steps (N, 3) from a place along a direction (2,) to the last one with a station."""
        out = []
        z = place[2]
        for k in range(1, steps + 1):
            there = np.array([*(place[:2] + k * _STEP * along), z])
            station = int(self.base_map.station_grid.at(there[None])[0])
            if station < 0:
                break
            z = there[2] = float(self.base_map.stations[station, 2])
            out.append(there)
        return np.array(out).reshape(-1, 3)


def _judged(scored: Scored, body: Floats, risk: float) -> _Seen:
    """Compare the places with the true one, the identity."""
    right = [_is_right(place, body) for place in scored.places]
    if not scored.places:
        return _Seen(False, False, 0.0, 0.0, 1.0)
    true_ratio = max((p.ratio for p, yes in zip(scored.places, right, strict=True) if yes), default=0.0)
    rival = max((p.ratio for p, yes in zip(scored.places, right, strict=True) if not yes), default=0.0)
    certain = scored.error < risk
    error = scored.error if right[0] else 1.0 - sum(
        p.probability for p, yes in zip(scored.places, right, strict=True) if yes
    )  # fmt: skip
    return _Seen(certain and right[0], certain and not right[0], true_ratio, true_ratio - max(rival, 0.0), error)


def _is_right(place: Hypothesis, body: Floats) -> bool:
    T = place.T_map_odom
    apart = float(np.linalg.norm(T[:3, :3] @ body + T[:3, 3] - body))
    return apart < _RIGHT_DISTANCE and abs(yaw_of(T)) < _RIGHT_ANGLE


def virtual_scan(base_map: BaseMap, eye: Floats, changed: float, config: RegistrationConfig) -> ObservedScan | None:
    """Return a virtual scan of a map at ``eye`` (3,), with odometry frame = map frame; None if it is empty.

    It has the map's visible points within 40 m, in cells of a degree, 22 degrees up and down. In a share ``changed`` of
    all 4 m patches, the same in all scans, points are shifted by 3 to 6 m. ``config`` sets the thinning.
    """
    near = base_map.points_near(eye, _RANGE + _MOVED[1])
    visible = _in_view(_rearranged(near, changed) - eye.astype(np.float32))
    if not len(visible):
        return None
    visible += np.random.default_rng(0).normal(0.0, _NOISE, visible.shape).astype(np.float32)
    cloud = prepare_scan(visible + eye.astype(np.float32), eye, config)
    # a lidar would have several returns per direction, and a single one is ignored
    return ObservedScan.of(cloud, np.repeat(visible, 2, axis=0), pose_from(np.eye(3), eye))


def _rearranged(points: Points, changed: float) -> Points:
    """Shift the points of the changed patches."""
    if changed <= 0.0:
        return points
    x, y = (np.floor(axis * np.float32(1.0 / _CHANGE_PATCH)).astype(np.int32) % _TABLE for axis in points[:, :2].T)
    moved = np.array(points)
    moved[:, :2] += _shifts(changed).take(x * _TABLE + y, axis=0)
    return moved


@lru_cache(maxsize=1)
def _shifts(changed: float) -> Floats32:
    """Return random shifts (P, 2), metres, for a share of the patches; 0 for the others."""
    rng = np.random.default_rng(20240)
    draw, turn = rng.random(_TABLE**2), rng.uniform(0.0, 2.0 * np.pi, _TABLE**2)
    distance = rng.uniform(*_MOVED, _TABLE**2)
    shift = np.column_stack([distance * np.cos(turn), distance * np.sin(turn)])
    return shift.astype(np.float32) * (draw.astype(np.float32) < changed)[:, None]


def _in_view(points: Points) -> Points:
    """Return the visible ones of points (N, 3) relative to the sensor."""
    flat = np.hypot(points[:, 0], points[:, 1])
    ahead: Bools = (np.abs(points[:, 2]) < flat * np.float32(np.tan(_BEAM * max(_UP, _DOWN)))) & (flat < _RANGE)
    points, flat = points.compress(ahead, axis=0), flat.compress(ahead)
    ranges = norms(points).astype(np.float32)
    row = np.floor(np.arctan2(points[:, 2], flat) / _BEAM).astype(np.int32) + _DOWN
    column = np.floor(np.arctan2(points[:, 1], points[:, 0]) / _BEAM).astype(np.int32) % _COLUMNS
    inside: Bools = (ranges > _NEAREST) & (row >= 0) & (row < _UP + _DOWN)
    points, ranges = points.compress(inside, axis=0), ranges.compress(inside)
    cell = (row * _COLUMNS + column).compress(inside)
    nearest = np.full((_UP + _DOWN) * _COLUMNS, np.inf, dtype=np.float32)
    np.minimum.at(nearest, cell, ranges)
    limit = _without_holes(nearest.reshape(-1, _COLUMNS)).ravel()[cell]
    return points.compress(ranges < limit + _SLACK + _SLACK_SLOPE * ranges, axis=0)


def _without_holes(nearest: Floats32) -> Floats32:
    """Close gaps in near surfaces, so that these hide the points behind them."""
    out = nearest
    for reach, window in _HOLES:
        near = np.where(nearest < reach, nearest, np.float32(np.inf))
        out = np.minimum(out, min_filter(near, window))
    return out
