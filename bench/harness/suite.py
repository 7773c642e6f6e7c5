"""The benchmarks that ``python -m bench`` runs, and the process that each of them runs in.

``python -m bench.suite MODULE FD [--quick]`` is that process: it imports the module and writes each row as a line
of JSON to the open file descriptor FD, so that what a benchmark prints does not mix with its rows.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """A benchmark of the suite."""

    name: str
    what: str
    threads: tuple[int | None, ...] = (1, 2)
    """Thread counts to run it with; None leaves the count to the machine."""
    limit_s: float = 240.0
    """Wall time after which it is ended: a row that does not hold."""
    module: str = ""
    """Where its ``rows`` are, if not in ``bench.NAME``."""

    @property
    def source(self) -> str:
        """Module to import."""
        return self.module or f"bench.speed.{self.name}"


SUITE = (
    Entry("kernels", "each kernel beside its NumPy twin"),
    Entry("match", "one query against all stations at all shifts, top-K"),
    Entry("learned_match", "dense correlation and cliques of learned re-localization"),
    Entry("intake", "a frame: transform, filter, voxels, polar bins"),
    Entry("describe", "descriptor and co-visibility of a keyframe"),
    Entry("map_build", "descriptors of 10,000 stations", threads=(None,)),
    Entry("registration", "trimmed ICP beside small_gicp"),
    Entry("engine", "Localizer.step on a large map: times, CPU share, memory", threads=(None,)),
    Entry("start", "import, first run, ready to serve", threads=(None,), module="bench.stream.start"),
    Entry(
        "peers",
        "other libraries on the same queries",
        threads=(None,),
        limit_s=420.0,
        module="bench.peers.summary",
    ),
)

OWN = {
    "accuracy": "errors, share localised and false fixes in held-out worlds",
    "ablation": "what each choice of the method is worth",
    "build_map": "seconds and memory of building a map",
    "forest": "learned re-localization beside descriptors and canopy heights",
    "ground": "the ground filter on labelled LAS files",
    "tracking": "errors, covariance, loss and recovery while tracked",
    "stream": "robots over zenoh: rates, delays, attacks",
    "peers": "each peer in each world, every answer as JSON",
    "plots": "the plots of docs/performance.md",
    "where": "where the time of a step goes, stage by stage",
    "publish": "puts measured tables into docs/performance.md",
}
"""Benchmarks with a command and tables of their own: ``python -m bench.NAME``."""


def thread_settings(threads: int | None) -> dict[str, str]:
    """Environment that gives BLAS, OpenMP and our kernels so many threads; empty for the machine's own."""
    if threads is None:
        return {}
    return dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "COVIEW_THREADS"), str(threads))


def main(arguments: Sequence[str]) -> int:
    """Run the rows of one module (see above)."""
    module, descriptor, *options = arguments
    with os.fdopen(int(descriptor), "w") as out:
        for row in importlib.import_module(module).rows(quick="--quick" in options):
            print(json.dumps(row.to_dict(), allow_nan=False), file=out, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
