"""One peer on the queries of one world, in a process of its own with a time limit.

``python -m bench.peers.trial PEER MAP PLACES OUT`` is that process: it writes a line of JSON for the preparation and
one per query to the file OUT as it goes, so that what was done before a crash or the limit counts.
"""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.peers.method import Peer
from bench.peers.roster import PEERS

NEAR, ALIGNED = 3.0, 5.0
"""A pose is right within this, metres and degrees (the papers' success)."""
NEARER = 1.0

_ROOT = Path(__file__).parent.parent.parent


@dataclass
class Trial:
    """What one peer did on one world's queries, or why it did nothing.

    ``answers`` are of the queries in order: ``seconds``, ``vouched``, ``score``, and ``metres`` and ``degrees`` from
    the truth, None without a pose. Queries that it did not come to are missing.
    """

    peer: str
    scene: str
    asked: int
    prepare_s: float = float("nan")
    answers: list[dict[str, Any]] = field(default_factory=list)
    trouble: str = ""

    def _right(self, answer: dict[str, Any], metres: float) -> bool:
        return bool(
            answer["vouched"] and answer["metres"] is not None
            and answer["metres"] < metres and answer["degrees"] < ALIGNED
        )  # fmt: skip

    def succeeded(self, metres: float = NEAR) -> int:
        """Count answers that it vouches for and that are right."""
        return sum(self._right(a, metres) for a in self.answers)

    def false_accepts(self) -> int:
        """Count answers that it vouches for and that are wrong."""
        return sum(bool(a["vouched"]) and not self._right(a, NEAR) for a in self.answers)

    def found(self) -> int:
        """Count right answers, vouched for or not: what a perfect check would make of it."""
        return sum(self._right(a | {"vouched": True}, NEAR) for a in self.answers)

    def median_error(self) -> tuple[float, float]:
        """Metres and degrees, over the right answers that it vouches for; NaN without one."""
        right = [(a["metres"], a["degrees"]) for a in self.answers if self._right(a, NEAR)]
        metres, degrees = np.median(right, axis=0) if right else (np.nan, np.nan)
        return float(metres), float(degrees)

    def milliseconds(self) -> float:
        """Median time of a query; NaN without one."""
        return 1e3 * float(np.median([a["seconds"] for a in self.answers])) if self.answers else float("nan")


def run_trial(peer: Peer, scene: str, count: int, map_file: Path, places_file: Path, limit_s: float) -> Trial:
    """Let a peer answer; what it prints is dropped."""
    trial = Trial(peer.name, scene, count)
    if peer.module and importlib.util.find_spec(peer.module) is None:
        trial.trouble = f"not installed; pip install {peer.package}"
        return trial
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "answers"
        out.touch()
        words = [sys.executable, "-m", "bench.peers.trial", peer.name, map_file, places_file, out]
        trial.trouble = _finish([str(word) for word in words], limit_s)
        lines = [json.loads(text) for text in out.read_text().split("\n")[:-1]]
    if lines:
        trial.prepare_s = lines[0]["prepare_s"]
        trial.answers = lines[1:]
    return trial


def _finish(words: list[str], limit_s: float) -> str:
    """Run a process to its end or the limit; say what went wrong, if anything did."""
    path = os.pathsep.join(filter(None, (str(_ROOT), str(_ROOT / "kernels"), os.environ.get("PYTHONPATH"))))
    process = subprocess.Popen(
        words, env={**os.environ, "PYTHONPATH": path}, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        _, said = process.communicate(timeout=limit_s)
    except BaseException as error:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        if isinstance(error, subprocess.TimeoutExpired):
            return f"ended after {limit_s:g} s"
        raise
    if process.returncode:
        last = (said.strip().splitlines() or ["no message"])[-1]
        return f"exit code {process.returncode}: {last}"
    return ""


def main(arguments: list[str]) -> int:
    """Answer all queries (see above)."""
    from coview_stream import BaseMap

    name, map_file, places_file, out = arguments
    peer = next(peer for peer in PEERS if peer.name == name)
    places = pickle.loads(Path(places_file).read_bytes())
    site = BaseMap.load(map_file)
    with Path(out).open("w") as file:
        begin = time.perf_counter()
        method = peer.make(site)
        print(json.dumps({"prepare_s": time.perf_counter() - begin}), file=file, flush=True)
        for place in places:
            begin = time.perf_counter()
            answer = method.answer(place)
            seconds = time.perf_counter() - begin
            T = answer.T_map_submap
            metres, degrees = (None, None) if T is None else place.errors(T)
            line = {"seconds": seconds, "vouched": answer.vouched, "score": answer.score}
            print(json.dumps(line | {"metres": metres, "degrees": degrees}), file=file, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
