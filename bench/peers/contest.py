"""All peers on all worlds: places made once, then one trial at a time."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.harness.places import WORLDS, places, world
from bench.harness.worlds import isolated, map_of
from bench.peers.method import Peer
from bench.peers.roster import PEERS
from bench.peers.trial import Trial, run_trial


def contest(
    folder: Path,
    count: int,
    limit_s: float,
    peers: Sequence[Peer] = PEERS,
    scenes: Sequence[str] = tuple(WORLDS),
) -> Iterator[Trial]:
    """Yield a trial per world and peer; ``count`` places per world, ``limit_s`` seconds for each trial.

    ``folder`` keeps the worlds, which are simulated where they are missing.
    """
    with tempfile.TemporaryDirectory() as scratch:
        for scene in scenes:
            file = Path(scratch) / scene
            isolated(_keep, folder, scene, count, file)
            for peer in peers:
                yield run_trial(peer, scene, count, map_of(folder, WORLDS[scene]), file, limit_s)


def _keep(folder: Path, scene: str, count: int, file: Path) -> None:
    import coview_kernels

    world(folder, scene)
    file.write_bytes(pickle.dumps(places(folder, scene, count), protocol=pickle.HIGHEST_PROTOCOL))
    coview_kernels.shutdown()
