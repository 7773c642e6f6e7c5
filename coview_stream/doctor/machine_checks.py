"""Checks of the machine: Python, processor, memory, and the native libraries.

Each library is tried in its own process, because one that crashes or hangs must not end the doctor:
``python -m coview_stream.doctor.machine_checks NAME`` prints one line of JSON.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from coview_kernels.runtime import cores
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.doctor.finding import Finding
from coview_stream.errors import PIP_INSTALL, install_command

GB = 1e9  # bytes
MIN_MEMORY = 0.6 * GB
"""Bytes: a searching node takes 0.36 GB on a small map and 0.47 GB on 1 km2 (``python -m bench memory``)."""

_TIMEOUT = 120.0  # seconds; compiling all kernels takes 3 to 10 on two cores
_MIN_ZENOH = (1, 10)  # oldest version that is tested
_CODECS = {
    "rosbags.typesys": "rosbags",
    "foxglove_schemas_protobuf.PointCloud_pb2": "foxglove-schemas-protobuf",
    "google.protobuf": "protobuf",
}
"""Modules that decode a robot's messages, and their packages."""

_PARTS = {
    "node": (("scipy", "lazrs"), "serve, locate, replay"),
    "build": (("pyproj", "laspy"), "build, simulate, demo"),
    "plot": (("matplotlib",), "pictures"),
}
"""Modules of each extra, the first of which shows whether it is installed, and the commands that need it."""


def machine_findings(probed: Callable[[str], dict[str, Any]] | None = None) -> Iterator[Finding]:
    """Judge the machine; takes some seconds to compile the kernels. ``probed`` replaces :func:`probe`."""
    probed = probed or probe
    yield python_finding(sys.version_info[:3])
    cpu = (line.partition(":") for line in _read("/proc/cpuinfo").splitlines())
    models = [" ".join(value.split()) for name, _, value in cpu if name.strip() in ("model name", "Model")]
    model = models[0] if models else platform.processor() or platform.machine()
    yield processor_finding(model, cores(), _quota())
    yield memory_finding(*memory())
    yield blas_finding(os.environ.get("OPENBLAS_NUM_THREADS", ""))
    lacking = lacking_modules()
    yield parts_finding(lacking)
    if lacking["node"] is not None:
        yield kernels_finding(probed("kernels"), bool(os.environ.get("COVIEW_KERNELS")))
    yield zenoh_finding(probed("zenoh"))
    yield codecs_finding(probed("codecs"))
    if lacking["build"] is not None:
        yield open3d_finding(probed("open3d"))
    if lacking["plot"] is not None:
        yield matplotlib_finding(probed("matplotlib"))


def lacking_modules(find: Callable[[str], object] = importlib.util.find_spec) -> dict[str, list[str] | None]:
    """Return the missing modules of each extra; None for an extra that is not installed."""
    return {
        part: [name for name in names if find(name) is None] if find(names[0]) is not None else None
        for part, (names, _) in _PARTS.items()
    }


def parts_finding(lacking: dict[str, list[str] | None]) -> Finding:
    """Judge which extras are installed: a robot's side needs none."""
    installed = {part: names for part, names in lacking.items() if names is not None}
    text = "; ".join(["client, watch, info, doctor", *(_PARTS[part][1] for part in installed)])
    broken = {part: names for part, names in installed.items() if names}
    if broken:
        reasons = "; ".join(f"{part} lacks {', '.join(names)}" for part, names in broken.items())
        return Finding("warn", "parts", f"{text}; {reasons}", install_command(",".join(broken)))
    absent = [part for part in lacking if part not in installed]
    more = f" (more: {install_command(','.join(absent))})" if absent else ""
    return Finding("ok", "parts", text + more)


def python_finding(version: tuple[int, ...]) -> Finding:
    """Judge the interpreter's version."""
    text = f"{'.'.join(map(str, version))}, {platform.system()} {platform.machine()}"
    if (3, 11) <= version[:2] < (3, 15):
        return Finding("ok", "python", text)
    return Finding("warn", "python", text, "3.11 to 3.14 are tested: make the environment with one of them")


def processor_finding(model: str, cores: int, quota: float | None) -> Finding:
    """Judge the ``cores`` available to us, of which a container grants ``quota`` at a time (None: all)."""
    text = f"{model}, {cores} core{'s' if cores != 1 else ''} to use"
    if quota is not None and quota < cores:
        text += f", {quota:g} of them at a time (container limit)"
    if min(cores, cores if quota is None else quota) < 2:
        return Finding("warn", "processor", text, "poses may come late during a search: give a node 2 or more")
    return Finding("ok", "processor", text)


def memory_finding(total: int | None, available: int | None) -> Finding:
    """Judge the memory in bytes; None: unknown."""
    if total is None or available is None:
        return Finding("ok", "memory", "unknown on this system")
    text = f"{available / GB:.1f} GB of {total / GB:.1f} GB available"
    if available < MIN_MEMORY:
        return Finding("warn", "memory", text, f"a node needs {MIN_MEMORY / GB:g} GB and more: end other programs")
    return Finding("ok", "memory", text)


def blas_finding(threads: str) -> Finding:
    """Judge the value of ``OPENBLAS_NUM_THREADS``."""
    text = f"OPENBLAS_NUM_THREADS={threads}" if threads else "OPENBLAS_NUM_THREADS is not set"
    if threads == "1":
        return Finding("ok", "BLAS threads", text)
    remedy = "threads slow small matrices down: leave it unset for coview-stream, or at 1"
    return Finding("warn", "BLAS threads", text, remedy)


def kernels_finding(result: dict[str, Any], forced: bool) -> Finding:
    """Judge the backend of the kernels; ``forced``: ``COVIEW_KERNELS`` is set."""
    if "error" in result:
        remedy = "COVIEW_KERNELS=numpy does without, but is slower; reinstall quadrants"
        if forced:
            remedy = "unset COVIEW_KERNELS, or set it to numpy"
        return Finding("FAIL", "kernels", str(result["error"]), remedy)
    text = f"{result['backend']}, ready after {result['seconds']:.1f} s"
    if result["differing"]:
        text += f"; wrong results from {', '.join(result['differing'])}"
        return Finding("FAIL", "kernels", text, "set COVIEW_KERNELS=numpy, and report it with this output")
    if result["backend"] == "numpy":
        remedy = "unset COVIEW_KERNELS" if forced else f"`{PIP_INSTALL} quadrants`"
        return Finding("warn", "kernels", text, f"slower than need be: {remedy}")
    return Finding("ok", "kernels", f"{text}; results as from their NumPy twins")


def zenoh_finding(result: dict[str, Any]) -> Finding:
    """Judge zenoh, which all live commands need."""
    if "error" in result:
        return Finding("FAIL", "zenoh", str(result["error"]), f"`{PIP_INSTALL} 'eclipse-zenoh>=1.10'`")
    version = str(result["version"])
    parts = version.split(".")[:2]
    if all(part.isdigit() for part in parts) and tuple(map(int, parts)) < _MIN_ZENOH:
        return Finding("warn", "zenoh", version, "tested with 1.10 and newer: upgrade eclipse-zenoh")
    return Finding("ok", "zenoh", version)


def codecs_finding(result: dict[str, Any]) -> Finding:
    """Judge the decoders of ROS 2, Foxglove and keelson messages."""
    missing = [result["error"]] if "error" in result else result["missing"]
    if missing:
        text = f"raw and JSON; ROS 2 CDR or Foxglove cannot be read: {', '.join(missing)}"
        return Finding("warn", "message formats", text, install_command("messages"))
    return Finding("ok", "message formats", "raw, JSON, ROS 2 CDR, Foxglove, keelson")


def open3d_finding(result: dict[str, Any]) -> Finding:
    """Judge Open3D: ray casting in simulated worlds."""
    if "error" not in result:
        return Finding("ok", "open3d", f"{result['version']}, for rays of simulate and demo")
    text, _, remedy = str(result["error"]).removeprefix("DependencyError: ").partition("; ")
    return Finding("ok", "open3d", f"{text}: simulate and demo cast their rays by a kernel, slower", remedy)


def matplotlib_finding(result: dict[str, Any]) -> Finding:
    """Judge Matplotlib, which only draws pictures."""
    if "error" not in result:
        return Finding("ok", "matplotlib", str(result["version"]))
    text = f"{result['error']}: no pictures from locate, demo, info and eval"
    return Finding("warn", "matplotlib", text, install_command("plot"))


def memory() -> tuple[int | None, int | None]:
    """Return total and available bytes, within a container's limit; None if the system does not report them."""
    numbers = (line.split() for line in _read("/proc/meminfo").splitlines())
    fields = {line[0]: int(line[1]) * 1024 for line in numbers if len(line) > 1 and line[1].isdigit()}
    total, available = fields.get("MemTotal:"), fields.get("MemAvailable:")
    limit, used = _read("/sys/fs/cgroup/memory.max").strip(), _read("/sys/fs/cgroup/memory.current").strip()
    if total is not None and available is not None and limit.isdigit() and used.isdigit() and int(limit) < total:
        return int(limit), min(available, max(0, int(limit) - int(used)))
    return total, available


def _quota() -> float | None:
    """Return the cores that a container grants at a time; None without a limit."""
    parts = _read("/sys/fs/cgroup/cpu.max").split()
    if len(parts) == 2 and parts[0].isdigit() and parts[1].isdigit() and int(parts[1]):
        return int(parts[0]) / int(parts[1])
    return None


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def probe(name: str) -> dict[str, Any]:
    """Run one of :data:`PROBES` in its own process; ``{"error": ...}`` if it fails, crashes or hangs."""
    try:
        done = subprocess.run(
            python_command("coview_stream.doctor.machine_checks", name),
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
    return read_answer(done.returncode, done.stdout, done.stderr)


def read_answer(code: int, out: str, err: str) -> dict[str, Any]:
    """Return the result printed by a probe's process, or the error that ended it."""
    try:
        result = json.loads(out.strip().splitlines()[-1])  # libraries print banners before it
    except (ValueError, IndexError):
        result = None
    if code == 0 and isinstance(result, dict):
        return result
    if code < 0:
        names = {s.value: s.name for s in signal.Signals}
        return {"error": f"the process was ended by {names.get(-code, f'signal {-code}')}"}
    last = (err.strip().splitlines() or ["it said nothing"])[-1]
    return {"error": f"the process ended with code {code}: {last[:200]}"}


def _probe_kernels() -> dict[str, Any]:
    import coview_kernels as kernels
    from coview_kernels import reference

    begin = time.perf_counter()
    backend = kernels.backend()
    kernels.warm_up()
    seconds = round(time.perf_counter() - begin, 2)
    return {"backend": backend, "seconds": seconds, "differing": differing(kernels, reference)}


def differing(native: Any, twin: Any) -> list[str]:
    """Return the kernels whose results differ from their twins' on a small cloud, by name."""
    cloud = np.random.default_rng(0).uniform(-20.0, 20.0, (2000, 3)).astype(np.float32)
    T = np.eye(4)
    T[:3, 3] = 1.0, -2.0, 0.5
    cases: dict[str, tuple[Any, ...]] = {
        "transform_unique": (cloud, T, 0.5, 1.0, 20.0),
        "polar_bin": (cloud, np.zeros(3), 20, 60, 50.0),
    }
    return [name for name, a in cases.items() if not _close(getattr(native, name)(*a), getattr(twin, name)(*a))]


def _close(one: Any, other: Any) -> bool:
    if isinstance(one, tuple):
        return len(one) == len(other) and all(_close(a, b) for a, b in zip(one, other, strict=True))
    a, b = np.asarray(one), np.asarray(other)
    # the backends sum in different orders: float32 has 7 digits
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-5, atol=1e-5))


def _probe_open3d() -> dict[str, Any]:
    from coview_stream.sim.casting import open3d

    return {"version": str(open3d().__version__)}


def _probe_matplotlib() -> dict[str, Any]:
    import matplotlib as mpl
    from matplotlib.backends import backend_agg  # the one that draws our pictures

    return {"version": str(mpl.__version__), "backend": backend_agg.__name__}


def _probe_zenoh() -> dict[str, Any]:
    from importlib.metadata import version

    import zenoh

    zenoh.Config()
    return {"version": version("eclipse-zenoh")}


def _probe_codecs() -> dict[str, Any]:
    missing = []
    for module, package in _CODECS.items():
        try:
            importlib.import_module(module)
        except Exception as error:  # an incompatible protobuf raises its own exceptions
            missing.append(f"{package} ({type(error).__name__})")
    return {"missing": missing}


PROBES: dict[str, Callable[[], dict[str, Any]]] = {
    "kernels": _probe_kernels,
    "open3d": _probe_open3d,
    "matplotlib": _probe_matplotlib,
    "zenoh": _probe_zenoh,
    "codecs": _probe_codecs,
}


def main(name: str) -> None:
    """Run a probe in this process and print its result."""
    try:
        result = PROBES[name]()
    except Exception as error:
        result = {"error": " ".join(f"{type(error).__name__}: {error}".split())[:400]}
    sys.stdout.write(f"\n{json.dumps(result)}\n")


if __name__ == "__main__":
    main(sys.argv[1])
