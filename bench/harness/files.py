"""Results on disk that are valid for the code that made them; processes, their threads and memory."""

from __future__ import annotations

import ast
import contextlib
import fcntl
import functools
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import coview_kernels
import coview_stream
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError

ROOT = Path(__file__).parents[2]

PYTHON = (sys.executable, "-P")
"""Start of a command: this interpreter, with the import roots of :func:`environment` only."""

_ROOTS = {path.name: path for path in (*map(Path, (*coview_stream.__path__, *coview_kernels.__path__)), ROOT / "bench")}

Result = TypeVar("Result")


def folder() -> Path:
    """Folder of worlds and answers: ``--work``, the environment's ``COVIEW_BENCH``, or a temporary one."""
    return Path(os.environ.get("COVIEW_BENCH") or Path(tempfile.gettempdir()) / "coview-bench")


def data() -> Path:
    """Folder of the real runs and surveys: the environment's ``COVIEW_DATA``, or one beside the checkout."""
    return Path(os.environ.get("COVIEW_DATA") or ROOT.parent / "shared" / "data")


def add_data(parser: ArgumentParser) -> None:
    """Add the option that names the folder of the real runs."""
    parser.add_argument("--data", type=Path, default=data(), metavar="DIR", help="holds the real runs (COVIEW_DATA)")


@contextlib.contextmanager
def locked(file: Path, wait: bool = True) -> Iterator[None]:
    """Hold a named lock file; BlockingIOError if another process holds it and ``wait`` is false."""
    file.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with file.open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if not file.is_file() or not os.path.samestat(os.fstat(lock.fileno()), file.stat()):
                continue  # the one before has removed it
            try:
                yield
            finally:
                file.unlink(missing_ok=True)
            return


def remembered(file: Path, spec: dict[str, Any], make: Callable[[], Any], wait: bool = True) -> dict[str, Any]:
    """Return the result in ``file`` if it belongs to an equal ``spec``; else compute it with ``make`` and store it.

    ``spec`` holds a :func:`fingerprint` of the code. Only a dictionary is stored; ``make`` may write files itself.
    Only one of several processes computes it; without ``wait`` the others get a BlockingIOError meanwhile.
    """
    spec = json.loads(json.dumps(spec))
    beside = file.parent.with_name(f"{file.parent.name}-{file.stem}.lock")  # making a world needs an empty folder
    with locked(beside, wait):
        if not file.is_file() or json.loads(file.read_text())["spec"] != spec:
            made = make()
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(file) as part:
                result = made if isinstance(made, dict) else {}
                part.write_text(json.dumps({"spec": spec, "result": result}, indent=1) + "\n")
        return dict(json.loads(file.read_text())["result"])


def fingerprint(*parts: str, without: tuple[str, ...] = ()) -> str:
    """Return a short hash of the code and weights below ``parts``, e.g. ``coview_stream/sim``, by default of all.

    Comments, docstrings and layout do not count, as prose does not invalidate a figure, nor do files of a package whose
    paths in it begin with one of ``without``.
    """
    total = hashlib.sha256()
    for part in parts or ("coview_stream", "coview_kernels"):
        root, _, below = part.partition("/")
        path = _ROOTS[root] / below
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            name = str(file.relative_to(_ROOTS[root]))
            if file.suffix in (".py", ".npz") and not name.startswith(without):
                total.update(name.encode() + code_of(file.read_bytes(), file.suffix))
    return total.hexdigest()[:10]


@functools.cache
def code_of(content: bytes, suffix: str = ".py") -> bytes:
    """Return a Python source without comments, layout and strings that stand alone; any other file as it is."""
    return ast.unparse(_Prose().visit(ast.parse(content))).encode() if suffix == ".py" else content


@functools.cache
def imported(source: bytes) -> tuple[str, ...]:
    """Return what a Python source imports from modules: their names, and those of what may be modules in them."""
    return tuple(
        f"{node.module}{part}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom) and node.module
        for part in ("", *(f".{alias.name}" for alias in node.names))
    )


class _Prose(ast.NodeTransformer):
    """Removes docstrings."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        return None if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str) else node


def isolated(work: Callable[..., Result], *args: Any) -> Result:
    """Call ``work`` in a fresh process, whose memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *args).result()


def peak_megabytes() -> float:
    """Largest resident memory of this program so far, MB; ``getrusage`` would count the one that started it, too."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return round(next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024, 1)


def thread_settings(threads: int) -> dict[str, str]:
    """Return the environment that limits BLAS, OpenMP and our kernels to a number of threads."""
    return dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "COVIEW_THREADS"), str(threads))


def environment(threads: int | None = None) -> dict[str, str]:
    """Return our environment with this checkout's import roots first, and ``threads`` or the machine's."""
    path = os.pathsep.join(filter(None, (str(ROOT), str(ROOT / "kernels"), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path, **(thread_settings(threads) if threads else {})}


def command(*words: str | Path, threads: int) -> subprocess.CompletedProcess[str]:
    """Run ``coview-stream WORDS``."""
    line = (*PYTHON, "-m", "coview_stream", *map(str, words))
    return subprocess.run(line, env=environment(threads), capture_output=True, text=True)


def trajectory(site: Path, run: Path, out: Path) -> Path:
    """Return the trajectory that ``coview-stream locate`` writes for a run, perhaps an empty one; InputError if none.

    Its exit code is 1 if no frame has a pose, and also after a traceback.
    """
    found = out / "trajectory.tum"
    found.unlink(missing_ok=True)
    done = command("locate", site, run, "-o", out, "--no-pictures", threads=1)
    if done.returncode not in (0, 1) or not found.is_file():
        raise InputError(f"{out.name}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return found


def built(source: Path, site: Path) -> Path:
    """Return the map of a cloud by ``coview-stream build``, built if missing."""

    def build() -> None:
        site.parent.mkdir(parents=True, exist_ok=True)
        done = command("build", source, "-o", site, threads=2)
        if done.returncode:
            raise InputError(f"building {site.name}: {done.stderr.strip().splitlines()[-1]}")

    parts = (f"coview_stream/{part}" for part in ("basemap", "descriptors", "config/map.py"))
    remembered(site.with_suffix(".json"), {"bytes": source.stat().st_size, "code": fingerprint(*parts)}, build)
    return site


def commit() -> str:
    """Short hash of the checkout's commit, with ``+`` if the product or the benchmarks differ from it."""
    git = ["git", "-C", str(ROOT)]
    short = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    dirty = subprocess.run([*git, "status", "--porcelain", "coview_stream", "kernels", "bench"], capture_output=True)
    return f"{short}{'+' * bool(dirty.stdout)}" if short else "unknown"
