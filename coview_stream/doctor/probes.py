"""Probes of native libraries, each in a process of its own: one that crashes or hangs must not end the doctor.

``python -m coview_stream.doctor.probes NAME`` prints one line of JSON.
"""

from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from coview_stream.clouds.python_child import python_command, python_environment

_TIMEOUT = 120.0  # seconds, set by hand; compiling all kernels takes 3 to 10 on two cores

# imports that reading a robot's messages needs, and the installation that brings each
_CODECS = {
    "rosbags.typesys": "rosbags",
    "foxglove_schemas_protobuf.PointCloud_pb2": "foxglove-schemas-protobuf",
    "google.protobuf": "protobuf",
}


def probe(name: str) -> dict[str, Any]:
    """Run one of :data:`PROBES` in a process of its own; ``{"error": ...}`` if it fails, crashes or hangs."""
    try:
        done = subprocess.run(
            python_command(__name__, name),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            env=python_environment(),
            timeout=_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"error": f"no answer within {_TIMEOUT:g} s"}
    return _answer(done.returncode, done.stdout, done.stderr)


def _answer(code: int, out: str, err: str) -> dict[str, Any]:
    try:
        found = json.loads(out.strip().splitlines()[-1])  # libraries print banners before it
    except (ValueError, IndexError):
        found = None
    if code == 0 and isinstance(found, dict):
        return found
    if code < 0:
        names = {s.value: s.name for s in signal.Signals}
        return {"error": f"the process was ended by {names.get(-code, f'signal {-code}')}"}
    last = (err.strip().splitlines() or ["it said nothing"])[-1]
    return {"error": f"the process ended with code {code}: {last[:200]}"}


def _kernels() -> dict[str, Any]:
    import coview_kernels as api
    from coview_kernels import reference

    begin = time.perf_counter()
    backend = api.backend()
    api.warm_up()
    seconds = time.perf_counter() - begin
    return {"backend": backend, "seconds": round(seconds, 2), "differing": differing(api, reference)}


def differing(native: Any, twin: Any) -> list[str]:
    """Return the names of the kernels whose results differ from their twins' on a small cloud."""
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-20.0, 20.0, (2000, 3)).astype(np.float32)
    T = np.eye(4)
    T[:3, 3] = 1.0, -2.0, 0.5
    cases: dict[str, tuple[Any, ...]] = {
        "transform_unique": (cloud, T, 0.5, 1.0, 20.0),
        "polar_bin": (cloud, np.zeros(3), 20, 60, 50.0),
        "describe_points": (cloud, np.zeros(3), 20, 60, 50.0),
    }
    return [
        name for name, args in cases.items() if not _close(getattr(native, name)(*args), getattr(twin, name)(*args))
    ]


def _close(one: Any, other: Any) -> bool:
    if isinstance(one, tuple):
        return len(one) == len(other) and all(_close(a, b) for a, b in zip(one, other, strict=True))
    a, b = np.asarray(one), np.asarray(other)
    # sums are taken in another order: float32 has 7 digits
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-5, atol=1e-5))


def _open3d() -> dict[str, Any]:
    from coview_stream.clouds.filters import open3d

    return {"version": str(open3d().__version__)}


def _matplotlib() -> dict[str, Any]:
    import matplotlib as mpl
    from matplotlib.backends import backend_agg  # what the pictures are drawn with

    return {"version": str(mpl.__version__), "backend": backend_agg.__name__}


def _zenoh() -> dict[str, Any]:
    from importlib.metadata import version

    import zenoh

    zenoh.Config()
    return {"version": version("eclipse-zenoh")}


def _codecs() -> dict[str, Any]:
    missing = []
    for module, package in _CODECS.items():
        try:
            importlib.import_module(module)
        except Exception as error:  # an incompatible protobuf raises an error of its own
            missing.append(f"{package} ({type(error).__name__})")
    return {"missing": missing}


PROBES: dict[str, Callable[[], dict[str, Any]]] = {
    "kernels": _kernels,
    "open3d": _open3d,
    "matplotlib": _matplotlib,
    "zenoh": _zenoh,
    "codecs": _codecs,
}


def main(name: str) -> None:
    """Run a probe in this process and print what it found."""
    try:
        found = PROBES[name]()
    except Exception as error:
        found = {"error": " ".join(f"{type(error).__name__}: {error}".split())[:400]}
    sys.stdout.write(f"\n{json.dumps(found)}\n")


if __name__ == "__main__":
    main(sys.argv[1])
