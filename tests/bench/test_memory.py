"""Memory of processes by what it holds."""

from argparse import Namespace
from collections import Counter
from pathlib import Path

import psutil
import pytest

from bench.speed.memory import CONTENTS, contents


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="Linux lists the mappings")
def test_contents_of_a_process_are_all_of_its_memory():
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    whole = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    parts = contents(psutil.Process())
    assert set(parts) <= set(CONTENTS)
    assert parts.total() == pytest.approx(whole, rel=0.05)
    assert min(parts[name] for name in ("NumPy, SciPy", "interpreter", "heap")) > 0
    assert contents(Namespace(pid=0)) == Counter()
