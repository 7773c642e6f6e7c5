"""Windows of COPC files, local or of a web server: only the chunks of points that meet the window are read.

Its points are written to a LAS file, which is then read like any other. laspy reads COPC, in a process of its own: its
decoder is native code that believes sizes in the file.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from coview_stream.clouds.http_file import download, is_web_address
from coview_stream.clouds.las import require_laspy
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import CloudError, ConfigError

_INFO = 375, 4  # where a COPC file says so


@dataclass(frozen=True)
class Window:
    """A rectangle in the coordinates of a cloud file.

    Attributes:
        low: west and south, in the file's units.
        high: east and north.
    """

    low: tuple[float, float]
    high: tuple[float, float]

    def __post_init__(self) -> None:
        """Check it; ConfigError where it has no area."""
        if not all(map(math.isfinite, (*self.low, *self.high))) or not (
            self.low[0] < self.high[0] and self.low[1] < self.high[1]
        ):
            raise ConfigError(f"window {self}: has no area; give X0,Y0,X1,Y1, the south-west corner first")

    @classmethod
    def parse(cls, text: str) -> Window:
        """Return the window that ``X0,Y0,X1,Y1`` means; ConfigError where it means none."""
        try:
            x0, y0, x1, y1 = map(float, text.split(","))
        except ValueError:
            raise ConfigError(f"window {text!r}: give X0,Y0,X1,Y1 in the clouds' coordinates") from None
        return cls((x0, y0), (x1, y1))

    def __str__(self) -> str:
        """Return it as it is given."""
        return ",".join(f"{value:.15g}" for value in (*self.low, *self.high))


@dataclass(frozen=True)
class Fetched:
    """What was read of a COPC file.

    Attributes:
        points: in the window.
        nodes: chunks that were read.
        received: bytes that came from a web server, 0 of a local file.
        requests: that it was asked.
    """

    points: int
    nodes: int
    received: int = 0
    requests: int = 0


def is_copc(path: Path) -> bool:
    """Tell whether a local file says that it is COPC."""
    begin, size = _INFO
    try:
        with path.open("rb") as file:
            head = file.read(begin + 2 + size)
    except OSError:
        return False
    return head[:4] == b"LASF" and head[begin + 2 :] == b"copc"


def fetch_cloud(source: str | os.PathLike[str], folder: Path, window: Window | None = None) -> tuple[Path, Fetched]:
    """Write a cloud of a web server, or a window of a COPC file, into a folder.

    Args:
        source: address of a cloud file; or, with a window, of a COPC file, or the name of one.
        folder: exists; an existing file is not written over.
        window: only its points; None: the file as it is.

    Returns:
        The new file, and what was read for it (without a window: of it only the bytes and requests).

    Raises:
        CloudError: it cannot be read, is no COPC file, or no point is in the window. OSError: it cannot be written.
    """
    name = PurePosixPath(unquote(urlsplit(str(source)).path)).name if is_web_address(source) else Path(source).name
    if name in ("", ".", "..") or "\0" in name or os.sep in name:
        raise CloudError(f"{source}: names no file")
    if window is None:
        target = _free(folder / name)
        return target, Fetched(0, 0, download(str(source), target), 1)
    require_laspy()
    if not is_web_address(source) and not is_copc(Path(source)):
        raise CloudError(f"{source}: not a COPC file; --window reads parts of COPC files (.copc.laz) only")
    stem = name.split(".")[0] or "cloud"
    target = _free(folder / f"{stem}.las")
    task = {"source": str(source), "low": window.low, "high": window.high, "target": str(target)}
    child = subprocess.run(
        python_command("coview_stream.clouds.copc_child"),
        input=json.dumps(task).encode(),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=python_environment() | {"OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"},
        check=False,
    )
    answer = _answer(child.stdout)
    if "error" in answer or child.returncode:
        target.unlink(missing_ok=True)
        raise CloudError(answer.get("error", f"{source}: damaged COPC file (the decoder broke off); export it again"))
    return target, Fetched(**answer)


def _answer(raw: bytes) -> dict[str, Any]:
    try:
        answer = json.loads(raw)
    except ValueError:
        return {}
    return answer if isinstance(answer, dict) else {}


def _free(path: Path) -> Path:
    """Return a name that no file has."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_name(f"{number}_{path.name}")
    return found
