"""Simulated worlds for the benchmarks: made once, kept on disk, made again when their makers change."""

from __future__ import annotations

import hashlib
import json
import resource
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import coview_kernels
import coview_stream
from coview_stream.config import MapConfig
from coview_stream.sim import SimulationConfig

TUNED_SEEDS = frozenset(range(1, 21))
"""Seeds of ``coview_stream.sim`` that defaults were chosen on; those of the unit tests are among them."""

KINDS = ("town", "campus", "village", "industrial")
LIDARS = ("vlp16", "os64", "mid360")
UTM = (512_000.0, 5_403_000.0, 120.0)

_SIMULATOR = ("coview_stream/sim",)
_MAPPER = (*_SIMULATOR, "coview_stream/basemap", "coview_stream/clouds", "coview_stream/place/descriptor.py")
_ROOTS = {
    "coview_stream": Path(coview_stream.__file__).parent,
    "coview_kernels": Path(coview_kernels.__file__).parent,
    "bench": Path(__file__).parents[1],
}
_PRODUCT = ("coview_stream", "coview_kernels")

Result = TypeVar("Result")


def world_name(config: SimulationConfig) -> str:
    """Directory of a world below the benchmark's folder."""
    return f"{config.scene}-{config.sensor}-{config.seed}"


def prepare(folder: Path, config: SimulationConfig) -> dict[str, float]:
    """Simulate a world into ``folder`` and build its map beside it, unless both are there already.

    Returns the seconds that each took when it was made.
    """
    from coview_stream.sim import simulate

    out = folder / world_name(config)
    wanted = {"world": config.to_dict(), "code": fingerprint(*_SIMULATOR)}
    seconds = remembered_seconds(
        out / "simulated.json", wanted, lambda: simulate(out, config, overwrite=True)
    )
    wanted = {"map": asdict(MapConfig()), "code": fingerprint(*_MAPPER, "coview_kernels")}
    return {
        "simulate_s": seconds,
        "build_s": remembered_seconds(out / "built.json", wanted, lambda: _build(out)),
    }


def map_of(folder: Path, config: SimulationConfig) -> Path:
    """Return where :func:`prepare` puts a world's map."""
    return folder / world_name(config) / "site.coview"


def remembered_seconds(file: Path, spec: dict[str, Any], make: Callable[[], Any]) -> float:
    """Seconds that ``make`` took, now or when ``file`` was written for an equal ``spec``."""
    import time

    def timed() -> dict[str, Any]:
        begin = time.perf_counter()
        make()
        return {"seconds": round(time.perf_counter() - begin, 2)}

    return float(remembered(file, spec, timed)["seconds"])


def remembered(file: Path, spec: dict[str, Any], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the result in ``file`` if it was made for an equal ``spec``; else make it and keep it there.

    This is what lets an interrupted benchmark resume, yet never on the results of other code: ``spec`` holds
    a :func:`fingerprint`.
    """
    spec = json.loads(json.dumps(spec))
    if file.is_file():
        known = json.loads(file.read_text())
        if known["spec"] == spec:
            return dict(known["result"])
    result = make()
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part")
    part.write_text(json.dumps({"spec": spec, "result": result}, indent=1) + "\n")
    part.replace(file)
    return dict(json.loads(json.dumps(result)))


def fingerprint(*parts: str) -> str:
    """Short hash of the Python sources below ``parts`` (of the whole product, if none are named)."""
    total = hashlib.sha256()
    for part in parts or _PRODUCT:
        root, _, below = part.partition("/")
        path = _ROOTS[root] / below
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            total.update(str(file.relative_to(_ROOTS[root])).encode() + file.read_bytes())
    return total.hexdigest()[:10]


def isolated(work: Callable[..., Result], *args: Any) -> Result:
    """Call ``work`` in a fresh process: its memory is its own, and given back."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *args).result()


def peak_megabytes() -> float:
    """Largest resident memory of this process so far, MB (Linux counts in KiB)."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def _build(out: Path) -> None:
    from coview_stream import BaseMap

    BaseMap.build(out / "base.laz").save(out / "site.coview")
