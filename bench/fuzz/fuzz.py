"""Untrusted bytes into every decoder and reader: each target in a process with limits on memory and time.

Guided by coverage where atheris is installed (extra ``fuzz``), else mutations of ``tests/corpus``. A target must return
a value or raise a CoViewError; all else is a finding, and its input is stored.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench.fuzz.child import GUIDED, TARGETS
from bench.harness.files import PYTHON, ROOT, environment
from bench.harness.rows import Row
from coview_stream.errors import InputError

CORPUS = ROOT / "tests" / "corpus"
_SPARE_S = 180.0  # for the imports of a child, and its first map


def options(parser: argparse.ArgumentParser) -> None:
    """Add time, targets and the folder of findings."""
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target (%(default)g)")
    parser.add_argument("--targets", metavar="NAMES", help=f"some of {','.join(TARGETS)}")
    parser.add_argument("--found", type=Path, metavar="DIR", help="keeps the inputs of findings, and larger corpora")


def rows(asked: argparse.Namespace) -> Iterator[Row]:
    """Fuzz each target for the time asked."""
    names = asked.targets.split(",") if asked.targets else list(TARGETS)
    if unknown := [name for name in names if name not in TARGETS]:
        raise InputError(f"--targets: no target {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    seconds = min(asked.seconds, 5.0) if asked.quick else asked.seconds
    below = asked.found or Path(tempfile.mkdtemp(prefix="coview-fuzz-"))
    print(f"... by {'atheris' if GUIDED else 'mutations'}; inputs of findings in {below}", file=sys.stderr)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        outcomes = pool.map(lambda name: fuzzed(name, below / name, seconds), names)
        for name, outcome in zip(names, outcomes, strict=True):
            count, holds = outcome["executions"], not outcome["places"] and outcome["executions"] > 0
            yield Row(f"fuzz/{name}", count, unit="inputs", target="no finding", holds=holds, details=outcome)
            for place, text in outcome["places"].items():
                print(f"    {name}: {place}: {text}", file=sys.stderr, flush=True)


def fuzzed(name: str, found: Path, seconds: float) -> dict[str, Any]:
    """Fuzz one target, again and again where an input ends the child."""
    (found / "corpus").mkdir(parents=True, exist_ok=True)
    outcome: dict[str, Any] = {"executions": 0, "values": 0, "honest_mb": 0.0, "peak_mb": 0.0, "places": {}}
    end, attempt = time.monotonic() + seconds, 0
    while attempt == 0 or time.monotonic() < end - 1.0:
        attempt += 1
        (found / "result.json").unlink(missing_ok=True)
        code, output = _child(name, CORPUS / name, found, max(1.0, end - time.monotonic()), attempt)
        if (found / "result.json").is_file():
            books = json.loads((found / "result.json").read_text())
            outcome["executions"] += books["executions"]
            outcome["values"] += books["values"]
            outcome |= {name: max(outcome[name], books[name]) for name in ("honest_mb", "peak_mb")}
            outcome["places"] |= books["places"]
        if code:  # keep the input that ended the child: libFuzzer's, or the one that had just begun
            lines = output.strip().splitlines() or [""]
            reason = next((line for line in lines if "ERROR" in line or "Timeout" in line), lines[-1])
            outcome["places"][f"ended with {code}"] = reason[:200]
            for path in [*found.glob("crash-*"), *found.glob("timeout-*"), *found.glob("oom-*"), found / "current"]:
                if path.is_file():
                    path.rename(found / f"found-{code}-{path.name}-{time.time_ns()}")
    return outcome


def replayed(names: Sequence[str], found: Path) -> dict[str, dict[str, Any]]:
    """Replay the corpora of several targets in one process; a target without ``done`` was not finished."""
    code, output = _child(",".join(names), CORPUS, found, 0.0, 0)
    outcomes = {}
    for name in names:
        file = found / name / "result.json"
        outcomes[name] = json.loads(file.read_text()) if file.is_file() else {"places": {}}
        if not outcomes[name].get("done"):
            outcomes[name]["places"][f"ended with {code}"] = output[-2000:]
    return outcomes


def _child(names: str, corpus: Path, found: Path, seconds: float, seed: int) -> tuple[int, str]:
    words = [*PYTHON, "-m", "bench.fuzz.child", names, str(corpus), str(found), str(seconds), str(seed)]
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, errors="replace", env=environment(1), timeout=seconds + _SPARE_S, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        return -1, f"does not end\n{error.output!r}"
    return done.returncode, done.stdout
