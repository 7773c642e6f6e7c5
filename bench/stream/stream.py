"""Does the streaming node keep its promises? ``python -m bench.stream [SCENARIO...] [--quick] [--json FILE]``.

An independent client: everything it sends and reads is written from the documented contract, with raw zenoh. Each
scenario starts a router, a node (through the command line) and senders as processes of their own, and prints a table
with a verdict per target; exit code 1 if one is missed. Needs the extra ``bench``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from bench.harness.tables import table
from bench.stream.node import PRODUCT, environment
from bench.stream.stage import Outcome, Setting

SCENARIOS = (
    "raw", "cdr", "protobuf", "jitter", "router", "flood", "random", "backwards", "odometry", "robots", "sigterm",
)  # fmt: skip
_VERDICTS = {True: "holds", False: "DOES NOT HOLD", None: ""}


def scenario(name: str) -> Callable[[Setting], Outcome]:
    """Return the function of that name."""
    from bench.stream import attacks as stream_attacks
    from bench.stream import outages as stream_outages
    from bench.stream import scenarios as stream_scenarios

    module = next(m for m in (stream_scenarios, stream_attacks, stream_outages) if hasattr(m, name))
    found: Callable[[Setting], Outcome] = getattr(module, name)
    return found


def prepare(folder: Path, seed: int) -> tuple[Path, Path, Path]:
    """Simulate the robot's world and another one, and build the first one's map, through the command line."""
    main, stranger = folder / f"town-{seed}", folder / f"town-{seed + 1}"
    for out, length in ((main, "80"), (stranger, "40")):
        if not (out / "truth.tum").is_file():
            _run(
                "simulate",
                str(out),
                "--seed",
                str(seed + (out == stranger)),
                "--size",
                "220",
                "--length",
                length,
            )
    site = main / "site.coview"
    if not site.is_file():
        _run("build", str(main / "base.laz"), "-o", str(site))
    return main, stranger, site


def _run(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "coview_stream", *arguments], env=environment(), check=True)


def report(outcome: Outcome) -> str:
    """One scenario's table and its numbers."""
    rows = [(what, measured[:110], target, _VERDICTS[met]) for what, measured, target, met in outcome.lines]
    verdict = "holds" if outcome.met else "DOES NOT HOLD"
    text = table((outcome.name, "measured", "target", "verdict"), rows)
    return f"{text}\n{outcome.name}: {verdict}\n{json.dumps(outcome.numbers, default=str)}\n"


def play(name: str, setting: Setting) -> Outcome:
    """Run one scenario; a benchmark that breaks is a target missed, and the next scenario runs all the same."""
    try:
        return scenario(name)(setting)
    except Exception as error:
        traceback.print_exc()
        broken = Outcome(name)
        broken.judge("scenario", f"{type(error).__name__}: {error}".splitlines()[0], "runs", False)
        return broken


def main(argv: Sequence[str] | None = None) -> int:
    """Run the scenarios one after the other."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"of {', '.join(SCENARIOS)} (all)")
    parser.add_argument("--quick", action="store_true", help="shorter streams")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers and verdicts")
    parser.add_argument(
        "--world", type=Path, metavar="DIR", help="keep worlds and map here, or find them here"
    )
    parser.add_argument("--seed", type=int, default=3101, help="of the simulated world (3101)")
    parser.add_argument("--keep", action="store_true", help="keep the node's logs, and say where")
    parser.add_argument(
        "--stand-in", action="store_true", help="try the benchmark itself: a node that knows the truth"
    )
    parser.add_argument("--serve", default="", metavar="ARGS", help="more arguments for coview-stream serve")
    args = parser.parse_args(argv)
    unknown = set(args.scenarios) - set(SCENARIOS)
    if unknown:
        parser.error(f"no scenario {', '.join(sorted(unknown))}; there are {', '.join(SCENARIOS)}")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        logs = Path(tempfile.mkdtemp(prefix="bench-stream-")) if args.keep else Path(scratch)
        world, stranger, site = prepare(args.world or Path(scratch), args.seed)
        stand_in = ("env", f"COVIEW_BENCH_WORLD={world}", sys.executable, "-m", "bench.stream.stand_in")
        command = stand_in if args.stand_in else PRODUCT
        setting = Setting(world, stranger, site, command, logs, args.quick, args.serve.split())
        outcomes, begin = [], time.monotonic()
        for name in args.scenarios or SCENARIOS:
            outcomes.append(play(name, setting))
            print(report(outcomes[-1]), flush=True)
        if args.keep:
            print(f"logs: {logs}")
    print(table(("scenario", "verdict"), [(o.name, _VERDICTS[o.met]) for o in outcomes]))
    print(f"{time.monotonic() - begin:.0f} s")
    if args.json:
        rows = [{"name": o.name, "met": o.met, "lines": o.lines, "numbers": o.numbers} for o in outcomes]
        args.json.write_text(json.dumps(rows, indent=1, default=str) + "\n")
    return 0 if all(outcome.met for outcome in outcomes) else 1


if __name__ == "__main__":
    raise SystemExit(main())
