"""Other libraries on the same queries, on this machine.

The queries are those of a robot that was switched on eight metres ago; ``bench/peers/libraries.py`` says how each peer
is set, docs/results.md what the columns mean. A trial ends after ``--limit`` seconds, so that a slow peer answers
the first queries only; both sides' shares are of those. Extra ``peers``; one that is missing gets a line that says so.
"""

from __future__ import annotations

import math
import pickle
import sys
import tempfile
import time
from argparse import SUPPRESS, ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import coview_kernels
from bench.harness.files import folder, isolated
from bench.harness.rows import Row, bounded, failed, informs, number, table
from bench.harness.run import run
from bench.harness.worlds import WORLDS, map_of, places
from bench.peers.libraries import Features, Keyframes, KissMatcher, MapClosures, Method, NearbyGicp, OneScan, Tracking
from coview_stream import BaseMap
from coview_stream.errors import CoViewError

NEAR, ALIGNED = 3.0, 5.0  # a pose is right within this, metres and degrees (the papers' success)

_HEAD = (
    "peer", "world", "right < 3 m", "< 1 m", "false accepts", "found", "e_t m", "e_r deg", "query ms", "map s"
)  # fmt: skip


class Peer(NamedTuple):
    """A method with its name, and how it is made for a map; ``tracking`` starts from a pose nearby, not nowhere."""

    name: str
    make: Callable[[BaseMap], Method]
    tracking: bool = False


OURS, OUR_TRACKING = "coview_stream", "coview_stream, tracking"

PEERS = (
    Peer(OURS, Keyframes),
    Peer("coview_stream, one scan", OneScan),
    Peer("KISS-Matcher", KissMatcher),
    Peer("MapClosures", MapClosures),
    Peer("Open3D FPFH + RANSAC", partial(Features, way="ransac")),
    Peer("Open3D FPFH + FGR", partial(Features, way="fgr")),
    Peer(OUR_TRACKING, Tracking, tracking=True),
    Peer("small_gicp GICP", partial(NearbyGicp, way="GICP"), tracking=True),
    Peer("small_gicp VGICP", partial(NearbyGicp, way="VGICP"), tracking=True),
)


@dataclass
class Trial:
    """What one peer did on one world's queries, or why it did nothing.

    ``answers`` are of the queries that it came to, in order: ``seconds``, ``vouched``, and ``metres`` and ``degrees``
    from the truth, None without a pose.
    """

    peer: str
    scene: str
    asked: int
    prepare_s: float | None = None
    answers: list[dict[str, Any]] = field(default_factory=list)
    trouble: str = ""

    def _near(self, metres: float = NEAR) -> list[dict[str, Any]]:
        posed = (a for a in self.answers if a["metres"] is not None)
        return [a for a in posed if a["metres"] < metres and a["degrees"] < ALIGNED]

    def succeeded(self, metres: float = NEAR) -> int:
        """Count answers that it vouches for and that are right."""
        return sum(a["vouched"] for a in self._near(metres))

    def false_accepts(self) -> int:
        """Count answers that it vouches for and that are wrong."""
        return sum(a["vouched"] for a in self.answers) - self.succeeded()

    def found(self) -> int:
        """Count right answers, vouched for or not: what a perfect check would make of it."""
        return len(self._near())

    def median_error(self) -> tuple[float, float]:
        """Metres and degrees, over the right answers that it vouches for; NaN without one."""
        right = [(a["metres"], a["degrees"]) for a in self._near() if a["vouched"]]
        metres, degrees = np.median(right, axis=0) if right else (np.nan, np.nan)
        return float(metres), float(degrees)

    def cells(self) -> list[str]:
        """One line of the table; counts are of the queries that were asked."""
        right, near, found = (f"{n} of {self.asked}" for n in (self.succeeded(), self.succeeded(1.0), self.found()))
        metres, degrees = self.median_error()
        return [
            self.peer, self.scene, right, near, str(self.false_accepts()), found, number(metres, 2),
            number(degrees, 2), number(milliseconds([self]), 0), number(self.prepare_s, 1),
        ]  # fmt: skip


def milliseconds(trials: Sequence[Trial]) -> float:
    """Return the median time of all queries; NaN without one."""
    return 1e3 * float(np.median([a["seconds"] for t in trials for a in t.answers] or [math.nan]))


def share(trials: Sequence[Trial]) -> float:
    """Return how many of the answered queries have a right answer that the peer vouches for, %."""
    return 100.0 * sum(t.succeeded() for t in trials) / max(1, sum(len(t.answers) for t in trials))


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


def run_trial(peer: Peer, scene: str, count: int, map_file: Path, places_file: Path, limit_s: float) -> Trial:
    """Let a peer answer, in a process of its own; what it did before a crash or the limit counts."""
    trial = Trial(peer.name, scene, count)
    try:
        for row in run("peers", ["--trial", peer.name, str(map_file), str(places_file)], None, limit_s):
            if row.holds is False:
                trial.trouble = row.name.removeprefix("peers: ")
            elif row.details:
                trial.answers.append(row.details)
            else:
                trial.prepare_s = row.ours
    except CoViewError as error:  # it is not installed
        trial.trouble = str(error)
    return trial


def _asked(name: str, map_file: str, places_file: str) -> Iterator[Row]:
    """Yield the seconds of a peer's preparation, then those of each query with its answer."""
    peer = next(peer for peer in PEERS if peer.name == name)
    found, site = pickle.loads(Path(places_file).read_bytes()), BaseMap.load(Path(map_file))
    begin = time.perf_counter()
    method = peer.make(site)
    yield informs("trial/prepare", time.perf_counter() - begin, "s")
    for k, place in enumerate(found):
        begin = time.perf_counter()
        answer = method.answer(place)
        seconds = time.perf_counter() - begin
        T = answer.T_map_submap
        metres, degrees = (None, None) if T is None else place.errors(T)
        said = {"seconds": seconds, "vouched": answer.vouched, "metres": metres, "degrees": degrees}
        yield informs(f"trial/query {k}", seconds, "s", said)


def contest(count: int, limit_s: float) -> Iterator[Trial]:
    """Yield a trial per world and peer; ``count`` places per world, ``limit_s`` seconds for each trial."""
    with tempfile.TemporaryDirectory() as scratch:
        for scene, config in WORLDS.items():
            file = Path(scratch) / scene
            isolated(_keep, scene, count, file)
            for peer in PEERS:
                print(f"... {peer.name}, {scene}", file=sys.stderr, flush=True)
                yield run_trial(peer, scene, count, map_of(folder(), config), file, limit_s)


def _keep(scene: str, count: int, file: Path) -> None:
    file.write_bytes(pickle.dumps(places(scene, count), protocol=pickle.HIGHEST_PROTOCOL))
    coview_kernels.shutdown()


def options(parser: ArgumentParser) -> None:
    """Add how many places, and how long."""
    parser.add_argument("--trial", nargs=3, help=SUPPRESS)
    parser.add_argument("--places", type=int, default=20, help="queries of each world (20)")
    parser.add_argument("--limit", type=float, default=180.0, metavar="S", help="per world and peer (180 s)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Compare ours with every peer: share of right poses, time of a query, false accepts."""
    if asked.trial:
        yield from _asked(*asked.trial)
        return
    trials = list(contest(4 if asked.quick else asked.places, asked.limit))
    for peer in PEERS:
        theirs = [trial for trial in trials if trial.peer == peer.name]
        reference = [trial for trial in trials if trial.peer == (OUR_TRACKING if peer.tracking else OURS)]
        details = {"trials": [asdict(trial) for trial in theirs]}
        for row in compared(theirs, reference, ours=peer.name.startswith(OURS)):
            yield replace(row, details=details)
            details = {}


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All peers in all worlds; those that did nothing say why below."""
    trials = [Trial(**values) for row in rows for values in row.details.get("trials", ())]
    trials.sort(key=lambda trial: list(WORLDS).index(trial.scene))
    troubles = [f"{trial.peer}, {trial.scene}: {trial.trouble}" for trial in trials if trial.trouble]
    return {"worlds": "\n\n".join([table(_HEAD, [trial.cells() for trial in trials]), *troubles])}
