"""Memory of processes by what it holds."""

from argparse import Namespace
from collections import Counter
from pathlib import Path

import psutil
import pytest

from bench.harness.rows import Row
from bench.speed.memory import CONTENTS, contents, tables


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="Linux lists the mappings")
def test_contents_of_a_process_are_all_of_its_memory():
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    whole = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    parts = contents(psutil.Process())
    assert set(parts) <= set(CONTENTS)
    assert parts.total() == pytest.approx(whole, rel=0.05)
    assert min(parts[name] for name in ("NumPy, SciPy", "interpreter", "heap")) > 0
    assert contents(Namespace(pid=0)) == Counter()


def test_table_has_each_process_and_their_sum():
    parts = {"main": {"heap": 30_000_000}, "track": {"heap": 50_000_000, "map": 4_000_000}}
    details = {"km2": "1", "doing": "tracking", "parts": parts}
    row = Row.from_dict(Row("memory/1 km2, tracking", 84.0, details=details).to_dict())
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables([row], Namespace())[""].splitlines()]
    assert [(line[2], line[3], line[-1]) for line in lines[2:]] == [
        ("main", "30", "30"), ("track", "54", "50"), ("all", "84", "80")
    ]  # fmt: skip
