"""Decoding of LAZ and E57 files in a child process: an abort of the decoder costs an error, not this process."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import CloudError

_IDLE_S = 10.0  # set by hand: a child that nobody needs ends after that
_THREADS = "4"  # set by hand: each thread's stack and heap count against the limit
_MAX_END = 5.0  # seconds for a child to end by itself; set by hand
_MAX_LINE = 1 << 20  # bytes of an answer's line: a reference system's text is the longest


class LazProcess:
    """A child that decodes files one after the other; started when needed, ended when idle or at exit."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._owner = 0
        self._timer: threading.Timer | None = None
        atexit.register(self.close)

    def read(self, path: Path) -> Cloud:
        """Decode a file.

        Raises:
            CloudError: as of :meth:`stream`; or it holds no point that can be used.
        """
        builder = CloudBuilder()
        builder.crs = self.stream(path, builder)
        return builder.finish(os.fspath(path))

    def stream(self, path: Path, builder: CloudBuilder) -> str | None:
        """Decode a file into a builder, and return its reference system.

        Raises:
            CloudError: it is damaged, or asked for more memory than a file of its size can need.
        """
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            whole, crs = False, None
            try:
                for answer, raw, classes in self._answers(path):
                    crs = answer.get("crs") or crs
                    builder.add(raw, classes, answer["dropped"])
                whole = True
            except _RefusedError as error:
                whole = True
                raise CloudError(str(error)) from error
            finally:
                if whole:
                    self._timer = threading.Timer(_IDLE_S, self.close)
                    self._timer.daemon = True
                    self._timer.start()
                else:  # what it sends next is of the file that was given up
                    self._end(kill=True)
            return crs

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._end(kill=False)

    def _answers(self, path: Path) -> Iterator[tuple[dict[str, Any], Any, Any]]:
        child = self._running()
        answers: Any = child.stdout
        assert child.stdin is not None
        try:
            child.stdin.write(json.dumps(str(path.resolve())).encode() + b"\n")
            child.stdin.flush()
        except BrokenPipeError:
            raise self._died(path) from None
        while True:
            line = answers.readline(_MAX_LINE)
            if not line.endswith(b"\n"):
                raise self._died(path)
            answer = json.loads(line)
            if "end" in answer:
                break
            raw: Any = np.empty((answer["points"], 3))
            classes: Any = np.empty(len(raw), np.uint8)
            for array in (raw, classes):
                if array.nbytes and answers.readinto(memoryview(array).cast("B")) != array.nbytes:
                    raise self._died(path)
            yield answer, raw, classes
        if "error" in answer:
            raise _RefusedError(answer["error"])
        if "memory" in answer:
            raise _RefusedError(_too_much(path, "too little memory"))

    def _running(self) -> subprocess.Popen[bytes]:
        if self._child is not None and self._owner == os.getpid() and self._child.poll() is None:
            return self._child
        self._end(kill=True)
        self._child = subprocess.Popen(
            python_command("coview_stream.clouds.laz_child"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=python_environment()
            | {
                "RAYON_NUM_THREADS": _THREADS, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1",
                "MALLOC_ARENA_MAX": "2",
            },
            start_new_session=True,  # a Ctrl-C is answered by this process
        )  # fmt: skip
        self._owner = os.getpid()
        return self._child

    def _died(self, path: Path) -> _RefusedError:
        self._end(kill=True)
        return _RefusedError(_too_much(path, "the decoder broke off"))

    def _end(self, kill: bool) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        child, self._child = self._child, None
        if child is None or self._owner != os.getpid():
            return
        if kill:
            child.kill()
        for stream in (child.stdin, child.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):  # what was still to be sent to a dead one
                    stream.close()
        try:
            child.wait(_MAX_END)
        except subprocess.TimeoutExpired:  # still decoding a file whose result is not wanted
            child.kill()
            child.wait()


class _RefusedError(Exception):
    """The child has answered: the file cannot be read, and the next one may come."""


def _too_much(path: Path, reason: str) -> str:
    what = path.suffix.removeprefix(".").upper()
    return f"{path}: damaged or truncated {what} ({reason} at what the file asks for); copy or export the file again"


_process = LazProcess()


def read_in_child(path: Path) -> Cloud:
    """Decode a LAZ or E57 file in the child that all share.

    Raises:
        CloudError: as :meth:`LazProcess.read`.
    """
    return _process.read(path)


def stream_from_child(path: Path, builder: CloudBuilder) -> str | None:
    """Decode a LAZ or E57 file in the child that all share, into a builder, and return its reference system.

    Raises:
        CloudError: as :meth:`LazProcess.stream`.
    """
    return _process.stream(path, builder)
