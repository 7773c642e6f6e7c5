"""A child process that decodes LAZ, E57 and COPC, because native decoders crash or take all memory on hostile files.

If the decoder aborts, this process gets an error. :mod:`coview_stream.clouds.decode_child` is the other end.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import subprocess
import threading
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import CloudError

_MAX_END_S = 5.0  # for a child to end by itself
_MAX_LINE = 1 << 20  # bytes of a line of an answer, at the longest a reference system's text
_IDLE_S = 10.0  # after which an idle child, which holds 90 MB, is ended
_LIMITS = {  # threads' stacks and heaps count against the child's memory limit
    "RAYON_NUM_THREADS": "4", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2",
}  # fmt: skip


class DecodingChild:
    """A child process that answers one request at a time; started on demand, ended when idle or at exit."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._owner = 0
        self._idle = threading.Timer(_IDLE_S, self.close)
        atexit.register(self.close)

    def ask(self, request: dict[str, Any], builder: CloudBuilder | None = None) -> dict[str, Any]:
        """Send a request, hand decoded points to a builder, and return the last answer.

        Raises:
            CloudError: the file is damaged, or its decoder wanted more memory than a file of its size can need.
        """
        with self._lock:
            self._idle.cancel()
            try:
                answer = self._exchange(request, builder)
            except BaseException:
                self._end(kill=True)  # or the next request would read the rest of this answer
                raise
            self._idle = threading.Timer(_IDLE_S, self.close)
            self._idle.daemon = True
            self._idle.start()
        if "error" in answer:
            raise CloudError(answer["error"])
        return answer

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._end(kill=False)

    def _exchange(self, request: dict[str, Any], builder: CloudBuilder | None) -> dict[str, Any]:
        child = self._running()
        assert child.stdin is not None
        answers: Any = child.stdout
        broken = CloudError(damaged(request["path"], "the decoder broke off"))
        try:
            child.stdin.write(json.dumps(request).encode() + b"\n")
            child.stdin.flush()
        except BrokenPipeError:
            raise broken from None
        while True:
            line = answers.readline(_MAX_LINE)
            if not line.endswith(b"\n"):
                raise broken
            answer: dict[str, Any] = json.loads(line)
            if "end" in answer or builder is None:
                return answer
            raw: Any = np.empty((answer["points"], 3))
            classes: Any = np.empty(len(raw), np.uint8)
            for array in (raw, classes):
                if array.nbytes and answers.readinto(memoryview(array).cast("B")) != array.nbytes:
                    raise broken
            builder.add(raw, classes, answer["dropped"])

    def _running(self) -> subprocess.Popen[bytes]:
        if self._child is not None and self._owner == os.getpid() and self._child.poll() is None:
            return self._child
        self._end(kill=True)
        self._child = subprocess.Popen(
            python_command("coview_stream.clouds.decode_child"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=python_environment() | _LIMITS,
            start_new_session=True,  # this process handles Ctrl-C
        )
        self._owner = os.getpid()
        return self._child

    def _end(self, kill: bool) -> None:
        child, self._child = self._child, None
        if child is None or self._owner != os.getpid():
            return
        if kill:
            child.kill()
        for stream in (child.stdin, child.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):  # unsent bytes to a dead child
                    stream.close()
        try:
            child.wait(_MAX_END_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def damaged(path: str | Path, reason: str) -> str:
    """Return the error text for a file with sizes that the decoder could not allocate."""
    kind = Path(path).suffix.removeprefix(".").upper()
    return f"{path}: damaged or truncated {kind} ({reason} at what the file asks for); copy or export the file again"


_shared = DecodingChild()


def decode_in_child(path: Path, builder: CloudBuilder) -> None:
    """Decode a LAZ or E57 file into a builder, in the shared child, with its reference system.

    CloudError as in :meth:`DecodingChild.ask`.
    """
    builder.crs = _shared.ask({"path": str(path.resolve())}, builder).get("crs")


def copy_window(source: str, low: tuple[float, float], high: tuple[float, float], target: Path) -> dict[str, int]:
    """Write the points in a window of a COPC file to a LAS file, in the shared child; return the fields of ``Fetched``.

    CloudError if the file cannot be read or is not a COPC file, or if the window has no points.
    """
    answer = _shared.ask({"path": source, "low": low, "high": high, "target": str(target)})
    return {name: answer[name] for name in ("points", "received", "requests")}
