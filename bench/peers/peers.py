"""Other libraries on the same queries: robots switched on eight metres ago, in simulated worlds, real runs and surveys.

Of a survey of ``COVIEW_DATA`` one half of the points is the map, and the world is made of the other.
Each is asked twice: with the submap of the five keyframes since then, and with one scan alone. A trial ends after
``--limit`` seconds, so a slow peer answers the first queries only, and the shares of both sides are of those. Extra
``peers``; a peer that is missing gets a line with the remedy. ``--data`` has the real runs.
"""

from __future__ import annotations

import math
import pickle
import signal
import sys
import tempfile
import time
from argparse import SUPPRESS, ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

import coview_kernels
from bench.__main__ import run
from bench.accuracy.conditions import SETS, RealSet
from bench.harness.files import add_data, built, fingerprint, folder, isolated, peak_megabytes, remembered
from bench.harness.rows import Row, bounded, failed, informs, listed
from bench.harness.worlds import KEYFRAMES, WORLDS, Place, map_of, places, prepare
from bench.integrity import surveys
from bench.integrity.challenge import make, name_of
from bench.integrity.integrity import code_of_runs, with_data
from bench.integrity.plan import Run as Drive
from bench.speed.registration import SmallGicp
from coview_stream import BaseMap
from coview_stream.clouds import read_tum
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CoViewError, InputError, require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.recordings.open_run import open_run
from coview_stream.sim.casting import open3d


@dataclass(frozen=True)
class Answer:
    """A pose (4, 4) map <- submap, or None, and whether the method itself vouches for it."""

    T_map_submap: Pose | None
    vouched: bool


class Method(Protocol):
    """One way to localize; made for one map, asked many times."""

    def answer(self, place: Place) -> Answer:
        """Say where the submap lies, or that it is not known."""


class Keyframes:
    """The search over the keyframes of a drive."""

    def __init__(self, site: BaseMap) -> None:
        coview_kernels.warm_up()
        config = LocalizerConfig()
        self._search = GlobalSearch(site, config, LocalMaps(site, config.registration.source_range))

    def answer(self, place: Place) -> Answer:
        """Search until a keyframe's verdict accepts a place."""
        self._search.clear()
        for query in place.queries:
            accepted = self._search.update(query).accepted
            if accepted is not None:
                return Answer(accepted.T_map_odom @ place.T_odom_submap, True)
        return Answer(None, False)


class KissMatcher:
    """KISS-Matcher 1.0 (MIT): FasterPFH, ROBIN pruning, GNC; the submap against the whole map.

    Of voxels of 0.7 to 2 m, with its default solver and with Quatro, the pair that was right most often on six places
    of town and campus; the rest by default. It vouches by its own example's rule: a valid solution with five inliers.
    """

    VOXEL, INLIERS = 1.0, 5

    def __init__(self, site: BaseMap) -> None:
        kiss_matcher = require_library("kiss_matcher", "kiss-matcher>=1.0.2", "the comparison with KISS-Matcher")
        config = kiss_matcher.KISSMatcherConfig(voxel_size=self.VOXEL, use_quatro=True)
        self._matcher: Any = kiss_matcher.KISSMatcher(config)
        self._map = np.array(site.points, dtype=np.float32)

    def answer(self, place: Place) -> Answer:
        """Match, prune and solve."""
        found = self._matcher.estimate(place.submap, self._map)
        inliers = int(self._matcher.get_num_final_inliers())
        T = pose_from(np.asarray(found.rotation), np.asarray(found.translation).ravel())
        return Answer(T, bool(found.valid) and inliers >= self.INLIERS)


class Refined(KissMatcher):
    """KISS-Matcher, then small_gicp's GICP from there, as KISS-Matcher's own pipeline for maps does."""

    def __init__(self, site: BaseMap) -> None:
        super().__init__(site)
        self._fine = SmallGicp(self._map, "GICP", 0.5, 1.0, threads=1)

    def answer(self, place: Place) -> Answer:
        """Match, then register."""
        coarse = super().answer(place)
        assert coarse.T_map_submap is not None
        found = self._fine.align(self._fine.prepared(place.submap, 0.5)[0], coarse.T_map_submap)
        return Answer(np.array(found.T_target_source), coarse.vouched)


class MapClosures:
    """MapClosures 2.2 (MIT): ORB features of density images, a tree of binary words, 2D RANSAC.

    The submap is the query that may close a loop with one of the map's local maps. In its favour these are of 60 m,
    the submap's reach, every 15 m, much denser than its pipeline makes them; the best of all closures counts. It
    vouches by its pipeline's rule: more than five inliers.
    """

    SPACING, REACH, VOXEL = 15.0, 60.0, 0.5
    _APART = 10  # between the numbers of queries: neighbours in number are never compared

    def __init__(self, site: BaseMap) -> None:
        require_library("map_closures", "map-closures>=2.2", "the comparison with MapClosures")
        from map_closures.config import MapClosuresConfig
        from map_closures.map_closures import MapClosures as Closures

        config = MapClosuresConfig()
        self._least = config.inliers_threshold
        self._closures: Any = Closures(config)
        stations = site.stations
        low, high = stations.min(axis=0)[:2], stations.max(axis=0)[:2]
        xs, ys = (np.arange(a + self.SPACING / 2, b, self.SPACING) for a, b in zip(low, high, strict=True))
        nearest = {(x, y): np.hypot(stations[:, 0] - x, stations[:, 1] - y).argmin() for x in xs for y in ys}
        centres = [np.array([*at, stations[k, 2]]) for at, k in nearest.items()]
        self._tiles = [c for c in centres if len(site.crop(c, self.REACH)[0]) >= 1000]
        # closures are looked for with earlier numbers only: backwards, no tile is compared with another one
        for k in reversed(range(len(self._tiles))):
            points, _ = site.crop(self._tiles[k], self.REACH)
            self._closures.get_closures(k, self._thinned(points.astype(np.float64) - self._tiles[k]))
        self._asked = len(self._tiles) + self._APART

    def answer(self, place: Place) -> Answer:
        """Find the closure with most inliers among the tiles; those with earlier queries do not count."""
        found = self._closures.get_closures(self._asked, self._thinned(place.submap.astype(np.float64)))
        self._asked += self._APART
        known = [c for c in found if c.source_id < len(self._tiles)]
        best = max(known, key=lambda c: c.number_of_inliers, default=None)
        if best is None:
            return Answer(None, False)
        T = pose_from(np.eye(3), self._tiles[best.source_id]) @ inverse(np.asarray(best.pose))
        return Answer(T, best.number_of_inliers > self._least)

    def _thinned(self, points: Floats) -> Floats:
        """Thin as its pipeline does before it asks."""
        from map_closures.voxel_map import VoxelMap

        voxels = VoxelMap(self.VOXEL, 2.0 * self.REACH)
        voxels.add_points(points)
        return np.asarray(voxels.point_cloud())


class Features:
    """Open3D (MIT): FPFH features, then RANSAC or fast global registration; the submap against the whole map.

    Settings of its tutorial on global registration, with a voxel of 1 m for outdoor clouds. The tutorial looks at the
    fitness (share of points with a partner), so it vouches from 0.5.
    """

    VOXEL, FITNESS = 1.0, 0.5

    def __init__(self, site: BaseMap, way: Literal["ransac", "fgr"]) -> None:
        self._o3d: Any = open3d()
        self._registration = self._o3d.pipelines.registration
        self._o3d.utility.random.seed(1)
        self._way = way
        self._map = self._described(np.array(site.points))

    def answer(self, place: Place) -> Answer:
        """Describe the submap, match and solve."""
        cloud, feature = self._described(place.submap)
        asked, registration, near = (cloud, self._map[0], feature, self._map[1]), self._registration, 1.5 * self.VOXEL
        if self._way == "ransac":
            found = registration.registration_ransac_based_on_feature_matching(
                *asked, False, near, registration.TransformationEstimationPointToPoint(False), 4,
                [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                 registration.CorrespondenceCheckerBasedOnDistance(near)],
                registration.RANSACConvergenceCriteria(100_000, 0.999),
            )  # fmt: skip
        else:
            option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * self.VOXEL)
            found = registration.registration_fgr_based_on_feature_matching(*asked, option)
        # FGR reports no fitness of its own for all versions: measured alike for both
        fit = registration.evaluate_registration(cloud, self._map[0], near, found.transformation)
        return Answer(np.array(found.transformation), fit.fitness >= self.FITNESS)

    def _described(self, points: Points) -> tuple[Any, Any]:
        o3d, search, voxel = self._o3d, self._o3d.geometry.KDTreeSearchParamHybrid, self.VOXEL
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
        cloud = cloud.voxel_down_sample(voxel)
        cloud.estimate_normals(search(radius=2 * voxel, max_nn=30))
        cloud.orient_normals_to_align_with_direction((0.0, 0.0, 1.0))  # a viewpoint is not known for the map
        feature = self._registration.compute_fpfh_feature(cloud, search(radius=5 * voxel, max_nn=100))
        return cloud, feature


NEAR, ALIGNED = 3.0, 5.0  # a pose is right within this, metres and degrees (the papers' success)


OURS = "coview_stream"

PEERS: dict[str, Callable[[BaseMap], Method]] = {
    OURS: Keyframes,
    "KISS-Matcher": KissMatcher,
    "KISS-Matcher, then small_gicp": Refined,
    "MapClosures": MapClosures,
    "Open3D FPFH + RANSAC": partial(Features, way="ransac"),
    "Open3D FPFH + FGR": partial(Features, way="fgr"),
}
"""Methods by name, and how each is made for a map."""


@dataclass
class Trial:
    """The answers of one peer to one world's queries, as far as it came, or the reason why it gave none.

    An answer has ``seconds``, ``vouched``, and ``metres`` and ``degrees`` from the truth, None without a pose.
    """

    peer: str
    scene: str
    asked: int
    answers: list[dict[str, Any]] = field(default_factory=list)
    trouble: str = ""

    def right(self) -> list[dict[str, Any]]:
        """Return the answers that the peer vouches for and that are right."""
        posed = (a for a in self.answers if a["vouched"] and a["metres"] is not None)
        return [a for a in posed if a["metres"] < NEAR and a["degrees"] < ALIGNED]

    def false_accepts(self) -> int:
        """Count answers that the peer vouches for and that are wrong."""
        return sum(bool(a["vouched"]) for a in self.answers) - len(self.right())

    def figures(self) -> dict[str, Any]:
        """Return the figures of the table; counts are of the queries that were answered in time."""
        return {
            "peer": self.peer, "scene": self.scene, "right": f"{len(self.right())} of {len(self.answers)}",
            "false": self.false_accepts(), "ms": milliseconds([self]),
            "metres": float(np.median([a["metres"] for a in self.right()] or [math.nan])),
            "degrees": float(np.median([a["degrees"] for a in self.right()] or [math.nan])),
            "megabytes": max((a["megabytes"] for a in self.answers), default=math.nan),
        }  # fmt: skip


COLUMNS = (
    ("peer", "peer", None), ("world", "scene", None), ("right < 3 m", "right", None),
    ("wrong but vouched for", "false", 0), ("e_t m", "metres", 3), ("e_r deg", "degrees", 2), ("query ms", "ms", 0),
    ("MB", "megabytes", 0),
)  # fmt: skip


def milliseconds(trials: Sequence[Trial]) -> float:
    """Return the median time of all queries; NaN without any."""
    return 1e3 * float(np.median([a["seconds"] for t in trials for a in t.answers] or [math.nan]))


def share(trials: Sequence[Trial]) -> float:
    """Return how many of the answered queries have a right answer that the peer vouches for, %."""
    return 100.0 * sum(len(t.right()) for t in trials) / max(1, sum(len(t.answers) for t in trials))


def compared(theirs: Sequence[Trial], reference: Sequence[Trial], ours: bool) -> Iterator[Row]:
    """Rows of one peer beside ``reference``, our answers to the same queries; ``ours``: it is one of ours itself."""
    name, answered = f"peers/{theirs[0].peer}", [trial for trial in theirs if trial.answers]
    if not answered:
        why = "; ".join(dict.fromkeys(trial.trouble or "no answer" for trial in theirs))
        yield failed(name, why) if ours else informs(f"{name}: {why}", math.nan, "")
        return
    false = sum(trial.false_accepts() for trial in answered)
    if ours:
        yield bounded(f"{name}, false accepts", false, "", 0)
        yield informs(f"{name}, right", share(theirs), "%")
        yield informs(f"{name}, time of a query", milliseconds(theirs), "ms")
        return
    same = [
        replace(mine, answers=mine.answers[: len(trial.answers)])  # as far as theirs came
        for trial in answered
        for mine in reference
        if mine.scene == trial.scene
    ]
    right, their_right = share(same), share(answered)
    ratio = right / their_right if their_right else None
    yield Row(f"{name}, right", right, their_right, "%", ratio, "as often", right >= their_right)
    took, their_took = milliseconds(same), milliseconds(answered)
    yield Row(f"{name}, time of a query", took, their_took, "ms", their_took / took)
    yield informs(f"{name}, its false accepts", false, "")


def run_trial(peer: str, scene: str, count: int, map_file: Path, places_file: Path, limit_s: float) -> Trial:
    """Let a peer answer, in a process of its own; its answers before a crash or the limit count."""
    trial, limit = Trial(peer, scene, count), ["--limit", str(limit_s)]
    try:
        for row in run("peers", ["--trial", peer, str(map_file), str(places_file), *limit], None):
            if row.holds is False:
                trial.trouble = row.name.removeprefix("peers: ")
            else:
                trial.answers.append(row.details)
    except CoViewError as error:  # it is not installed
        trial.trouble = str(error)
    return trial


def _asked(name: str, map_file: str, places_file: str, limit_s: float) -> Iterator[Row]:
    """Yield the seconds of a query with its answer, until an alarm ends this process."""
    signal.alarm(math.ceil(10 * limit_s))  # for a method's preparation of the map
    found, site = pickle.loads(Path(places_file).read_bytes()), BaseMap.load(Path(map_file))
    method = PEERS[name](site)
    signal.alarm(math.ceil(limit_s))
    for k, place in enumerate(found):
        begin = time.perf_counter()
        answer = method.answer(place)
        seconds = time.perf_counter() - begin
        T = answer.T_map_submap
        metres, degrees = (None, None) if T is None else place.errors(T)
        said = {
            "seconds": seconds, "vouched": answer.vouched, "metres": metres, "degrees": degrees,
            "megabytes": peak_megabytes(),
        }  # fmt: skip
        yield informs(f"trial/query {k}", seconds, "s", said)


QUERIES = {"": KEYFRAMES, ", one scan": 1}  # suffix of the world's name, and keyframes of a query
SURVEYS = [file.stem for file in surveys.files()]
FIRST_SEED = 501_000  # of squares of surveys
PARTS = ("bench/harness/worlds.py", "bench/integrity/challenge.py", "bench/speed/registration.py")


def ground_of(scene: str, data: Path) -> tuple[Path, Path]:
    """Return the map of a world, survey or real set, and the folder of its ``run`` and truth, made if needed."""
    if scene in WORLDS:
        return map_of(folder(), WORLDS[scene]), prepare(folder(), WORLDS[scene])
    if scene in SURVEYS:
        return on_survey(scene)
    real = RealSet(data / scene)
    return built(real.survey, folder() / "conditions" / "maps" / f"{scene}.coview"), real.folder


def on_survey(name: str) -> tuple[Path, Path]:
    """Return the map and the folder of the first drive on a survey; InputError if no square of it has a way."""
    below = folder() / "peers"
    for seed in range(FIRST_SEED, FIRST_SEED + 100):
        drive = Drive("surveys", "survey", "survey", seed, 0, "os64")
        if surveys.place_of(seed).stem == name and make(drive, below, WORLDS["town"].length, WORLDS["town"].speed):
            world = below / name_of(drive)
            return built(world / "map.laz", world / "site.coview"), world
    raise InputError(f"no square of {name} has a way to drive")


def _asked_of(site: Path, world: Path, count: int, keyframes: int) -> list[Place]:
    run, truth = open_run(world / "run"), read_tum(world / "truth.tum")[1]
    return places(BaseMap.load(site), run, truth, count, keyframes)


def contest(peers: Sequence[str], scenes: dict[str, tuple[Path, Path]], count: int, limit_s: float) -> Iterator[Trial]:
    """Yield a trial per world, query and peer; ``count`` places per world, ``limit_s`` seconds for each trial."""
    code = with_data(code_of_runs()) | {"product": fingerprint(), "bench": fingerprint("bench/peers", *PARTS)}
    with tempfile.TemporaryDirectory() as scratch:
        for scene, (site, world) in scenes.items():
            for suffix, keyframes in QUERIES.items():
                file = Path(scratch) / f"{scene}{suffix}"

                def make(peer: str, name: str, site: Path = site, world: Path = world, file: Path = file,
                         keyframes: int = keyframes) -> dict[str, Any]:  # fmt: skip
                    print(f"... {peer}, {name}", file=sys.stderr, flush=True)
                    if not file.is_file():
                        file.write_bytes(pickle.dumps(isolated(_asked_of, site, world, count, keyframes)))
                    trial = run_trial(peer, name, count, site, file, limit_s)
                    if trial.answers:
                        return asdict(trial)
                    raise _NoAnswerError(trial)

                for peer in peers:
                    name, kept = f"{scene}{suffix}", folder() / "peers" / f"{scene}{suffix}-{peer}.json"
                    spec = {**code, "count": count, "limit": limit_s}
                    try:
                        yield Trial(**remembered(kept, spec, partial(make, peer, name)))
                    except _NoAnswerError as error:
                        yield error.args[0]


class _NoAnswerError(Exception):
    """A trial without an answer, which is not kept."""


def options(parser: ArgumentParser) -> None:
    """Add the worlds, how many places, and how long."""
    add_data(parser)
    parser.add_argument("--trial", nargs=3, help=SUPPRESS)
    parser.add_argument(
        "--worlds", nargs="+", metavar="NAME", help=f"of {', '.join((*WORLDS, *SETS, *SURVEYS))} (all that are there)"
    )
    parser.add_argument("--peers", nargs="+", metavar="NAME", help=f"parts of names of {', '.join(PEERS)}")
    parser.add_argument("--places", type=int, default=20, help="queries of each world (20)")
    parser.add_argument("--limit", type=float, default=180.0, metavar="S", help="per world, query and peer (180 s)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Compare ours with every peer: share of right poses, time of a query, false accepts."""
    if asked.trial:
        yield from _asked(asked.trial[0], asked.trial[1], asked.trial[2], asked.limit)
        return
    there = [*WORLDS, *SURVEYS, *(name for name in SETS if (asked.data / name).exists())]
    scenes = {name: ground_of(name, asked.data) for name in asked.worlds or (there[-1:] if asked.quick else there)}
    peers = [name for name in PEERS if name == OURS or any(part in name for part in asked.peers or [""])]
    trials = list(contest(peers, scenes, 4 if asked.quick else asked.places, asked.limit))
    reference = [trial for trial in trials if trial.peer == OURS]
    for peer in peers:
        theirs = [trial for trial in trials if trial.peer == peer]
        details = {"trials": [asdict(trial) for trial in theirs]}
        for row in compared(theirs, reference, ours=peer == OURS):
            yield replace(row, details=details)
            details = {}


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All peers in all worlds; those that did nothing say why below."""
    trials = [Trial(**values) for row in rows for values in row.details.get("trials", ())]
    troubles = [f"{trial.peer}, {trial.scene}: {trial.trouble}" for trial in trials if trial.trouble]
    return {"worlds": "\n\n".join([listed(COLUMNS, [trial.figures() for trial in trials]), *troubles])}
