"""Results kept on disk as long as the code that made them is the same; code of an earlier commit; stage clocks."""

from __future__ import annotations

import hashlib
import io
import json
import os
import resource
import subprocess
import sys
import tarfile
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import coview_kernels
import coview_stream
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError

ROOT = Path(__file__).parents[2]

COMMIT = "1c85769b98b75633f82754048a1a67ec46fd42d2"
"""The last commit whose search registered and verified every place of a vote, one by one."""

_ROOTS = {
    "coview_stream": Path(coview_stream.__file__).parent,
    "coview_kernels": Path(coview_kernels.__file__).parent,
    "bench": ROOT / "bench",
}

Result = TypeVar("Result")


def folder() -> Path:
    """Folder of worlds and answers: ``--work``, the environment's ``COVIEW_BENCH``, or a temporary one."""
    return Path(os.environ.get("COVIEW_BENCH") or Path(tempfile.gettempdir()) / "coview-bench")


def remembered(file: Path, spec: dict[str, Any], make: Callable[[], Any]) -> dict[str, Any]:
    """Return the result in ``file`` if it was made for an equal ``spec``; else make it and keep it there.

    So an interrupted benchmark resumes, but never on results of other code: ``spec`` holds a :func:`fingerprint`.
    Only a dictionary is kept; ``make`` may return something else after writing files itself.
    """
    spec = json.loads(json.dumps(spec))
    if file.is_file():
        known = json.loads(file.read_text())
        if known["spec"] == spec:
            return dict(known["result"])
    made = make()
    result = json.loads(json.dumps(made if isinstance(made, dict) else {}))
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(file) as part:
        part.write_text(json.dumps({"spec": spec, "result": result}, indent=1) + "\n")
    return dict(result)


def fingerprint(*parts: str) -> str:
    """Short hash of the Python sources below ``parts``, e.g. ``coview_stream/sim`` (none: of the whole product)."""
    total = hashlib.sha256()
    for part in parts or ("coview_stream", "coview_kernels"):
        root, _, below = part.partition("/")
        path = _ROOTS[root] / below
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            total.update(str(file.relative_to(_ROOTS[root])).encode() + file.read_bytes())
    return total.hexdigest()[:10]


def isolated(work: Callable[..., Result], *args: Any) -> Result:
    """Call ``work`` in a fresh process, whose memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *args).result()


def peak_megabytes() -> float:
    """Largest resident memory of this process so far, MB (Linux counts in KiB)."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def thread_settings(threads: int | None) -> dict[str, str]:
    """Environment that gives BLAS, OpenMP and our kernels so many threads; empty for the machine's own."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "COVIEW_THREADS")
    return {} if threads is None else dict.fromkeys(names, str(threads))


def environment(threads: int | None = None) -> dict[str, str]:
    """Our environment with both import roots of this checkout in front and so many threads."""
    path = os.pathsep.join(filter(None, (str(ROOT), str(ROOT / "kernels"), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path, **thread_settings(threads)}


class Clock:
    """Seconds by name, added up; ``with clock("name"):`` adds to them."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the seconds of the block."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - begin


class Code(NamedTuple):
    """Checkout with both import roots, and the version that its results depend on."""

    root: Path
    version: str

    def command(self, *words: str) -> list[str]:
        """Return the command that runs Python with these words, the working directory no import root."""
        return [sys.executable, "-P", *words]

    def environment(self, threads: int = 1) -> dict[str, str]:
        """Return ours with this code's import roots and so many threads."""
        roots = os.pathsep.join((str(self.root), str(self.root / "kernels")))
        return {**os.environ, "PYTHONPATH": roots, **thread_settings(threads)}

    def built(self, sources: Sequence[Path], site: Path, threads: int = 2) -> Path:
        """Return the map that this code's command builds of clouds, built now unless it is there."""
        words = ("-m", "coview_stream", "build", *map(str, sources), "-o", str(site))

        def build() -> None:
            site.parent.mkdir(parents=True, exist_ok=True)
            done = subprocess.run(
                self.command(*words), env=self.environment(threads), cwd=site.parent, capture_output=True, text=True
            )
            if done.returncode:
                raise InputError(f"building {site.name}: {done.stderr.strip().splitlines()[-1]}")

        spec = {"sources": [[path.name, path.stat().st_size] for path in sources], "code": self.version}
        remembered(site.with_suffix(".json"), spec, build)
        return site


def today() -> Code:
    """Return this checkout; its maps depend on map building, descriptors and configuration."""
    return Code(ROOT, fingerprint("coview_stream/basemap", "coview_stream/descriptors", "coview_stream/config"))


def pinned(commit: str = COMMIT) -> Code:
    """Return the product at a commit, extracted from this repository's history; InputError if it is not there."""
    root = folder() / f"code-{commit[:7]}"
    if not (root / "kernels").is_dir():
        words = ["git", "-C", str(ROOT), "archive", commit, "coview_stream", "kernels"]
        try:
            packed = subprocess.run(words, check=True, capture_output=True).stdout
        except (OSError, subprocess.CalledProcessError) as error:
            raise InputError(f"commit {commit[:7]} is not in this history; fetch all of it") from error
        root.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=root.parent) as part:
            with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
                archive.extractall(Path(part) / "code", filter="data")
            (Path(part) / "code").rename(root)
    return Code(root, commit)


def commit() -> str:
    """Short hash of the checkout's commit, with ``+`` if the product or the benchmarks differ from it."""
    git = ["git", "-C", str(ROOT)]
    short = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    dirty = subprocess.run([*git, "status", "--porcelain", "coview_stream", "kernels", "bench"], capture_output=True)
    return f"{short}{'+' * bool(dirty.stdout)}" if short else "unknown"
