"""Untrusted bytes into every decoder and reader: each target in a process with limits on memory and time.

Coverage-guided by atheris where that is installed (extra ``fuzz``), else mutations of the corpus, which is said. What
comes out must be a value or a CoViewError; everything else is a finding, and its input is kept.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from bench.fuzz.targets import TARGETS
from bench.harness.files import ROOT
from bench.harness.rows import Row, table
from coview_stream.errors import InputError

CORPUS = ROOT / "tests" / "corpus"
_SECONDS = 60.0
_SPARE_S = 60.0  # for the imports of a child; set by hand


def options(parser: argparse.ArgumentParser) -> None:
    """Add what only this benchmark has."""
    parser.add_argument("--seconds", type=float, default=_SECONDS, help="for each target (%(default)g)")
    parser.add_argument("--targets", metavar="NAMES", help=f"some of {','.join(TARGETS)}")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time (%(default)d)")
    parser.add_argument("--found", type=Path, metavar="DIR", help="keeps the inputs of findings, and larger corpora")
    parser.add_argument("--no-atheris", action="store_true", help="mutate the corpus, as where there is no atheris")


@dataclass
class Outcome:
    """What came of one target."""

    name: str
    executions: int = 0
    values: int = 0
    edges: int = 0
    corpus: int = 0
    findings: dict[str, str] = field(default_factory=dict)


def rows(asked: argparse.Namespace) -> Iterator[Row]:
    """Fuzz each target for the time asked."""
    names = asked.targets.split(",") if asked.targets else list(TARGETS)
    if unknown := [name for name in names if name not in TARGETS]:
        raise InputError(f"--targets: no target {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    seconds = min(asked.seconds, 5.0) if asked.quick else asked.seconds
    way = "atheris" if importlib.util.find_spec("atheris") and not asked.no_atheris else "mutations"
    if way != "atheris":
        print("... atheris is not used (pip install atheris): mutations of the corpus, blind", file=sys.stderr)
    kept = asked.found or Path(tempfile.mkdtemp(prefix="coview-fuzz-"))
    with ThreadPoolExecutor(max(1, asked.jobs)) as pool:
        runs = pool.map(lambda name: fuzzed(name, CORPUS / name, kept / name, seconds, way), names)
        for outcome in runs:
            yield Row(
                f"fuzz/{outcome.name}", outcome.executions, unit="inputs", target="no finding",
                holds=not outcome.findings and outcome.executions > 0,
                details={"edges": outcome.edges, "corpus": outcome.corpus, "values": outcome.values,
                         "findings": outcome.findings, "seconds": seconds, "way": way},
            )  # fmt: skip
            for place, text in outcome.findings.items():
                print(f"    {outcome.name}: {place}: {text}", file=sys.stderr, flush=True)
    if asked.found is None and not any(kept.glob("*/found-*")):
        shutil.rmtree(kept, ignore_errors=True)
    else:
        print(f"... inputs are in {kept}", file=sys.stderr)


def tables(rows: Sequence[Row], asked: argparse.Namespace) -> dict[str, str]:
    """Lay out executions, coverage and findings."""
    lines = []
    for row in rows:
        seen = row.details
        found = "; ".join(seen["findings"]) or "none"
        edges = f"{seen['edges']:,}" if seen["edges"] else "-"
        counts = [f"{seen['seconds']:g}", f"{round(row.ours):,}", f"{seen['values']:,}", edges]
        cells = [row.name.partition("/")[2], *counts]
        lines.append([*cells, f"{seen['corpus']:,}", found])
    return {"": table(["target", "seconds", "inputs", "accepted", "edges", "corpus", "findings"], lines)}


def fuzzed(name: str, corpus: Path, found: Path, seconds: float, way: str) -> Outcome:
    """Fuzz one target, again and again where a child is ended by an input; 0 seconds replay the corpus."""
    (found / "corpus").mkdir(parents=True, exist_ok=True)
    outcome = Outcome(name)
    end, attempt = time.monotonic() + seconds, 0
    while attempt == 0 or time.monotonic() < end - 1.0:
        attempt += 1
        left = max(0.0, end - time.monotonic()) if seconds else 0.0
        (found / "result.json").unlink(missing_ok=True)
        code, said = _child(name, corpus, found, left, way, attempt)
        if (found / "result.json").is_file():
            result = json.loads((found / "result.json").read_text())
            outcome.executions += result["executions"]
            outcome.values += result["values"]
            outcome.findings |= result["places"]
        edges = [int(number) for number in re.findall(r" cov: (\d+) ", said)]
        outcome.edges = max([outcome.edges, *edges])
        if code:
            _note_end(outcome, found, code, said)
        if not seconds:
            break
    outcome.corpus = len(list((found / "corpus").iterdir())) + len(list(corpus.iterdir()))
    return outcome


def replayed(names: Sequence[str], corpus: Path, found: Path) -> list[Outcome]:
    """Replay the corpora of several targets in one process; one that it did not get to the end of has a finding."""
    code, said = _child(",".join(names), corpus, found, 0.0, "replay", 0)
    outcomes = []
    for name in names:
        outcome = Outcome(name, corpus=len(list((corpus / name).iterdir())))
        books = found / name / "result.json"
        result = json.loads(books.read_text()) if books.is_file() else {}
        if not result.get("done"):
            outcome.findings[f"ended with {code}"] = said[-2000:]
        outcome.executions, outcome.values = result.get("executions", 0), result.get("values", 0)
        outcome.findings |= result.get("places", {})
        outcomes.append(outcome)
    return outcomes


def _child(name: str, corpus: Path, found: Path, seconds: float, way: str, seed: int) -> tuple[int, str]:
    words = [
        sys.executable,
        "-P",
        "-m",
        "bench.fuzz.child",
        name,
        str(corpus),
        str(found),
        f"{seconds}",
        way,
        f"{seed}",
    ]
    paths = os.pathsep.join([str(ROOT), *(path for path in sys.path if path)])
    own = {"PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            errors="replace", env=os.environ | own, timeout=seconds + _SPARE_S, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        return -1, f"does not end\n{error.output!r}"
    return done.returncode, done.stdout


def _note_end(outcome: Outcome, found: Path, code: int, said: str) -> None:
    """Keep the input that ended a child: libFuzzer's, or the one that it had just begun."""
    reason = next((line for line in said.splitlines() if "ERROR" in line or "Timeout" in line), "")
    last = said.strip().splitlines()[-1:] or [""]
    outcome.findings[f"ended with {code}"] = (reason or last[0])[:200]
    (found / "last-words.txt").write_text(said[-20_000:])
    for path in [*found.glob("crash-*"), *found.glob("timeout-*"), *found.glob("oom-*"), found / "current"]:
        if path.is_file():
            path.rename(found / f"found-{code}-{path.name}-{time.time_ns()}")
