"""Checks of the machine: Python, processor, memory, and the libraries that do the work."""

from __future__ import annotations

import importlib.util
import os
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from coview_kernels.runtime import cores
from coview_stream.doctor.finding import Finding
from coview_stream.doctor.probes import probe

GB = 1e9
MIN_MEMORY = 0.6 * GB
"""Bytes, set by hand: a node is three processes of 0.17 GB each before any search, and some to spare."""

_MIN_ZENOH = (1, 10)


def machine_findings(probed: Callable[[str], dict[str, Any]] = probe) -> Iterator[Finding]:
    """Judge the machine; takes some seconds: the kernels are compiled."""
    yield python_finding(sys.version_info[:3])
    yield processor_finding(_model(), cores(), _quota())
    total, available = memory()
    yield memory_finding(total, available)
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


_PARTS = {
    "node": (("scipy", "gtsam", "onnxruntime"), "serve, locate, replay"),
    "build": (("open3d", "laspy", "pyproj"), "build, simulate, demo"),
    "plot": (("matplotlib",), "pictures"),
}
"""Modules of each part, of which the first tells whether it is installed, and what the part does."""


def lacking_modules(found: Callable[[str], object] = importlib.util.find_spec) -> dict[str, list[str] | None]:
    """Return, for each part, which of its modules are not there; None where the part is not installed."""
    return {
        part: [name for name in names if found(name) is None] if found(names[0]) is not None else None
        for part, (names, _) in _PARTS.items()
    }


def parts_finding(lacking: dict[str, list[str] | None]) -> Finding:
    """Judge which parts of the package are installed: a robot's side needs none of them."""
    installed = {part: names for part, names in lacking.items() if names is not None}
    text = "; ".join(["client, watch, info, doctor", *(_PARTS[part][1] for part in installed)])
    broken = [f"{part} lacks {', '.join(names)}" for part, names in installed.items() if names]
    if broken:
        remedy = f"pip install 'coview-stream[{','.join(part for part, names in installed.items() if names)}]'"
        return Finding("warn", "parts", f"{text}; {'; '.join(broken)}", remedy)
    absent = [part for part in lacking if part not in installed]
    more = "" if not absent else f" (more: pip install 'coview-stream[{','.join(absent)}]')"
    return Finding("ok", "parts", text + more)


def python_finding(version: tuple[int, ...]) -> Finding:
    """Judge the interpreter's version."""
    text = f"{'.'.join(map(str, version))}, {platform.system()} {platform.machine()}"
    if (3, 11) <= version[:2] < (3, 14):
        return Finding("ok", "python", text)
    return Finding("warn", "python", text, "3.11, 3.12 and 3.13 are tested: make the environment with one of them")


def processor_finding(model: str, cores: int, quota: float | None) -> Finding:
    """Judge ``cores`` that we may run on, ``quota`` of which a container grants at a time (None: all)."""
    text = f"{model}, {cores} core{'s' if cores != 1 else ''} to use"
    if quota is not None and quota < cores:
        text += f", {quota:g} of them at a time (container limit)"
    usable = cores if quota is None else min(cores, quota)
    if usable < 2:
        return Finding("warn", "processor", text, "poses may come late during a search: give a node 2 or more")
    return Finding("ok", "processor", text)


def memory_finding(total: int | None, available: int | None) -> Finding:
    """Judge the memory in bytes; None is unknown."""
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
    remedy = "for small matrices threads cost more than they bring: leave it unset for coview-stream, or at 1"
    return Finding("warn", "BLAS threads", text, remedy)


def kernels_finding(found: dict[str, Any], forced: bool) -> Finding:
    """Judge the backend of the kernels; ``forced``: ``COVIEW_KERNELS`` is set."""
    if "error" in found:
        remedy = "COVIEW_KERNELS=numpy does without, but is slower; reinstall taichi"
        if forced:
            remedy = "unset COVIEW_KERNELS, or set it to numpy"
        return Finding("FAIL", "kernels", str(found["error"]), remedy)
    text = f"{found['backend']}, ready after {found['seconds']:.1f} s"
    if found["differing"]:
        text += f"; wrong results from {', '.join(found['differing'])}"
        return Finding("FAIL", "kernels", text, "set COVIEW_KERNELS=numpy, and report it with this output")
    text += "; results as from their NumPy twins" if found["backend"] != "numpy" else ""
    if found["backend"] == "numpy":
        remedy = "unset COVIEW_KERNELS" if forced else "`pip install taichi` (on aarch64: quadrants)"
        return Finding("warn", "kernels", text, f"slower than need be: {remedy}")
    return Finding("ok", "kernels", text)


def zenoh_finding(found: dict[str, Any]) -> Finding:
    """Judge zenoh, which all live commands need."""
    if "error" in found:
        return Finding("FAIL", "zenoh", str(found["error"]), "`pip install 'eclipse-zenoh>=1.10'`")
    parts = str(found["version"]).split(".")[:2]
    if all(p.isdigit() for p in parts) and tuple(map(int, parts)) < _MIN_ZENOH:
        return Finding("warn", "zenoh", str(found["version"]), "tested with 1.10 and newer: upgrade eclipse-zenoh")
    return Finding("ok", "zenoh", str(found["version"]))


def codecs_finding(found: dict[str, Any]) -> Finding:
    """Judge what reading ROS 2, Foxglove and keelson messages needs."""
    missing = [found["error"]] if "error" in found else found["missing"]
    if missing:
        text = f"raw and JSON; ROS 2 CDR or Foxglove cannot be read: {', '.join(missing)}"
        return Finding("warn", "message formats", text, "pip install 'coview-stream[messages]'")
    return Finding("ok", "message formats", "raw, JSON, ROS 2 CDR, Foxglove, keelson")


def open3d_finding(found: dict[str, Any]) -> Finding:
    """Judge Open3D: normals and outliers of maps to be built, and ray casting in simulated worlds."""
    if "error" in found:
        text, _, remedy = str(found["error"]).removeprefix("DependencyError: ").partition("; ")
        return Finding("warn", "open3d", f"{text}: build, simulate and demo will not work, the rest does", remedy)
    return Finding("ok", "open3d", str(found["version"]))


def matplotlib_finding(found: dict[str, Any]) -> Finding:
    """Judge Matplotlib: pictures only."""
    if "error" in found:
        text = f"{found['error']}: no pictures from locate, demo, info and eval"
        return Finding("warn", "matplotlib", text, "pip install 'coview-stream[plot]'")
    return Finding("ok", "matplotlib", str(found["version"]))


def memory() -> tuple[int | None, int | None]:
    """Return bytes in total and available, a container's limit included; None where the system does not say."""
    fields: dict[str, int] = {}
    for line in _read("/proc/meminfo").splitlines():
        name, _, rest = line.partition(":")
        number = rest.split()[:1]
        if number and number[0].isdigit():
            fields[name] = int(number[0]) * 1024
    total, available = fields.get("MemTotal"), fields.get("MemAvailable")
    limit, used = _read("/sys/fs/cgroup/memory.max").strip(), _read("/sys/fs/cgroup/memory.current").strip()
    if total is not None and available is not None and limit.isdigit() and used.isdigit() and int(limit) < total:
        return int(limit), min(available, max(0, int(limit) - int(used)))
    return total, available


def _model() -> str:
    for line in _read("/proc/cpuinfo").splitlines():
        name, _, value = line.partition(":")
        if name.strip() in ("model name", "Model"):
            return " ".join(value.split())
    return platform.processor() or platform.machine()


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
