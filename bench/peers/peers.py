"""Other libraries on the same queries, on this machine: ``python -m bench.peers [--json FILE] [--quick]``.

Per world and peer: how often it is right (within 3 m and 5 degrees, and within 1 m) and vouches for it, how often
it vouches for a wrong pose, its errors when right, the median time of a query and the time to prepare the map. The
queries are those of a robot that was switched on eight metres ago; what each peer is given and how it is set says
the module of its name in ``bench/peers``. Extra ``peers``; who is not installed gets a line that says so.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from bench.harness.places import WORLDS
from bench.harness.tables import line, number, rule
from bench.peers.contest import contest
from bench.peers.method import Peer
from bench.peers.roster import PEERS
from bench.peers.trial import Trial
from bench.speed.engine import folder

PLACES, QUICK = 20, 4
LIMIT_S = 180.0

HEAD = (
    "peer", "world", "right < 3 m", "< 1 m", "false accepts", "found", "e_t m", "e_r deg", "query ms", "map s"
)  # fmt: skip
_WIDTHS = (24, 7, 11, 8, 13, 8, 6, 7, 8, 6)


def cells(trial: Trial) -> list[str]:
    """One line of the table; counts are of the queries that were asked."""

    def of(count: int) -> str:
        return f"{count} of {trial.asked}"

    metres, degrees = (None if math.isnan(e) else e for e in trial.median_error())
    seconds, prepare = trial.milliseconds(), trial.prepare_s
    return [
        trial.peer, trial.scene, of(trial.succeeded()), of(trial.succeeded(1.0)), str(trial.false_accepts()),
        of(trial.found()), number(metres, 2), number(degrees, 2),
        number(None if math.isnan(seconds) else seconds, 0), number(None if math.isnan(prepare) else prepare, 1),
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all peers on all worlds."""
    parser = argparse.ArgumentParser(prog="python -m bench.peers", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every answer of every peer")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} places a world instead of {PLACES}")
    parser.add_argument("--worlds", type=Path, default=folder(), help=f"keeps the worlds ({folder()})")
    parser.add_argument(
        "--only", nargs="+", metavar="PEER", help="those whose name has this in it: small_gicp kiss"
    )
    parser.add_argument(
        "--limit", type=float, default=LIMIT_S, metavar="S", help=f"per world and peer ({LIMIT_S:g} s)"
    )
    options = parser.parse_args(arguments)
    unknown = [word for word in options.only or () if not any(_is_named(peer, word) for peer in PEERS)]
    if unknown:
        print(
            f"bench.peers: no peer {', '.join(unknown)}; there are {'; '.join(p.name for p in PEERS)}",
            file=sys.stderr,
        )
        return 2
    chosen = [peer for peer in PEERS if not options.only or any(_is_named(peer, w) for w in options.only)]
    count, trials = QUICK if options.quick else PLACES, []
    print(line(HEAD, _WIDTHS), rule(_WIDTHS), sep="\n", flush=True)
    for trial in contest(options.worlds, count, options.limit, chosen, tuple(WORLDS)):
        trials.append(trial)
        if trial.prepare_s == trial.prepare_s:  # it came that far
            print(line(cells(trial), _WIDTHS), flush=True)
        if trial.trouble:
            print(f"  {trial.peer}, {trial.scene}: {trial.trouble}", flush=True)
    if options.json:
        text = json.dumps([_plain(trial) for trial in trials], indent=1, allow_nan=False) + "\n"
        part = options.json.with_name(options.json.name + ".part")
        part.write_text(text)
        part.replace(options.json)
    return 0


def _is_named(peer: Peer, word: str) -> bool:
    return word.lower() in peer.name.lower()


def _plain(trial: Trial) -> dict[str, object]:
    values = asdict(trial)
    return {**values, "prepare_s": None if math.isnan(trial.prepare_s) else trial.prepare_s}


if __name__ == "__main__":
    sys.exit(main())
