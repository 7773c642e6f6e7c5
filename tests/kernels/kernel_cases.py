"""Clouds and poses that the kernel tests draw from."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coview_kernels import runtime

ROOT = Path(__file__).resolve().parents[2]
BAD = (np.nan, np.inf, -np.inf, 3.0e38)


@st.composite
def clouds(draw: st.DrawFn, max_points: int = 400) -> np.ndarray:
    """(N, 3) float32: spread, piled up in one place, or on a lattice; some rows NaN, infinite or huge."""
    n = draw(st.integers(0, max_points))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["spread", "lattice", "one place", "axes"]))
    points = rng.uniform(-60.0, 60.0, (n, 3))
    if kind == "lattice":
        points = np.round(points / 2.5) * 2.5
    elif kind == "one place":
        points = np.full((n, 3), rng.uniform(-20, 20)) + rng.uniform(-0.01, 0.01, (n, 3))
    elif kind == "axes" and n:
        points[np.arange(n), rng.integers(0, 2, n)] = rng.choice([0.0, -0.0], n)
    points = points.astype(np.float32)
    if n and draw(st.booleans()):
        bad = rng.integers(0, n, max(1, n // 10))
        points[bad, rng.integers(0, 3, len(bad))] = rng.choice(BAD, len(bad))
    return points


@st.composite
def poses(draw: st.DrawFn) -> np.ndarray:
    """(4, 4) poses: any, identity, and quarter turns, which leave a lattice on a lattice."""
    T = np.eye(4)
    kind = draw(st.sampled_from(["any", "identity", "quarter"]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if kind == "any":
        T[:3, :3] = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
        T[:3, 3] = rng.uniform(-100, 100, 3)
    elif kind == "quarter":
        T[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        T[:3, 3] = rng.integers(-5, 5, 3)
    return T


@contextmanager
def parallel_parts(count: int) -> Iterator[None]:
    """Have the kernels split their work into so many parts, whatever the number of cores."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runtime, "workers", lambda: count)
        yield


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``code`` in a fresh interpreter that finds the packages of this checkout."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "kernels")])
    inherited = {k: v for k, v in os.environ.items() if not k.endswith("_HEADER_PRINT")}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**inherited, "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
