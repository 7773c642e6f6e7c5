"""Downloads of clouds from web servers, whole or by HTTP range requests, and windows of COPC files.

A window's points are written to a LAS file.
"""

from __future__ import annotations

import contextlib
import http.client
import ipaddress
import math
import os
import shutil
import socket
import time
import urllib.error
import urllib.request
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from coview_stream.clouds.decode import copy_window
from coview_stream.clouds.las import require_laspy
from coview_stream.errors import CloudError, ConfigError

_TIMEOUT = 30.0  # seconds without a byte
_TRIES = 4
_WAIT = 0.5  # seconds before the third try; half of them before the second, twice as many before the fourth
_BLOCK = 1 << 16  # least bytes of a request: a header, its records and a hierarchy are many small reads
_ANSWERS = (http.client.NOT_MODIFIED, http.client.REQUESTED_RANGE_NOT_SATISFIABLE)
_BUSY = (408, 425, 429, 500, 502, 503, 504)
_FAILURES = (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError)
_COPC_MARK = 377, b"copc"  # offset and user id of the first record of a COPC file


@dataclass(frozen=True)
class Window:
    """A rectangle in the coordinates of a cloud file.

    Attributes:
        low: west and south, in the file's units.
        high: east and north.
    """

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def parse(cls, text: str) -> Window:
        """Parse ``X0,Y0,X1,Y1``; ConfigError for any other text."""
        try:
            x0, y0, x1, y1 = map(float, text.split(","))
        except ValueError:
            raise ConfigError(f"window {text!r}: give X0,Y0,X1,Y1 in the clouds' coordinates") from None
        if not (-math.inf < x0 < x1 < math.inf and -math.inf < y0 < y1 < math.inf):
            raise ConfigError(f"window {text}: has no area; give X0,Y0,X1,Y1, the south-west corner first")
        return cls((x0, y0), (x1, y1))

    def __str__(self) -> str:
        """Return ``X0,Y0,X1,Y1``."""
        return ",".join(f"{value:.15g}" for value in (*self.low, *self.high))


@dataclass(frozen=True)
class Fetched:
    """Counts of a fetched file.

    Attributes:
        points: number of points in the window; 0 for a whole file.
        received: bytes from a web server; 0 for a local file.
        requests: number of requests to the web server.
    """

    points: int
    received: int = 0
    requests: int = 0


def is_web_address(name: str | os.PathLike[str]) -> bool:
    """Return whether a name is an address on a web server."""
    return str(name).lower().startswith(("http://", "https://"))


def is_copc(path: Path) -> bool:
    """Return whether a local file is marked as COPC."""
    at, mark = _COPC_MARK
    with contextlib.suppress(OSError), path.open("rb") as file:
        head = file.read(at + len(mark))
        return head.startswith(b"LASF") and head[at:] == mark
    return False


def fetch_cloud(source: str | os.PathLike[str], folder: Path, window: Window | None = None) -> tuple[Path, Fetched]:
    """Write a cloud from a web server, or a window of a COPC file, into a folder; return the new file, and counts.

    Raises:
        CloudError: the source cannot be read or is not a COPC file, or the window has no points.
        OSError: the file cannot be written.
    """
    name = PurePosixPath(unquote(urlsplit(str(source)).path)).name if is_web_address(source) else Path(source).name
    if name in ("", ".", "..") or "\0" in name or os.sep in name:
        raise CloudError(f"{source}: names no file")
    if window is None:
        target = _free(folder / name)
        return target, Fetched(0, download(str(source), target), 1)
    require_laspy()
    if not is_web_address(source) and not is_copc(Path(source)):
        raise CloudError(f"{source}: not a COPC file; --window reads parts of COPC files (.copc.laz) only")
    target = _free(folder / f"{name.split('.')[0] or 'cloud'}.las")
    try:
        return target, Fetched(**copy_window(str(source), window.low, window.high, target))
    except CloudError:
        target.unlink(missing_ok=True)
        raise


def _free(path: Path) -> Path:
    names = (path.with_name(f"{number}_{path.name}") for number in count(2))
    return next(name for name in chain([path], names) if not name.exists())


def download(address: str, target: Path) -> int:
    """Download a file to ``target``, and return its size in bytes; CloudError if the server breaks off."""
    with open_web_file(urllib.request.Request(address)) as answer, target.open("wb") as file:
        try:
            shutil.copyfileobj(answer, file, 1 << 20)
        except _FAILURES as error:
            raise CloudError(f"{address}: broke off after {file.tell()} bytes ({error}); try again") from error
        size, promised = file.tell(), answer.headers.get("Content-Length")
    if promised is not None and promised.isdigit() and int(promised) != size:
        raise CloudError(f"{address}: broke off after {size} of {promised} bytes; try again")
    return size


def _nearness(address: str) -> list[int]:
    """Rate each address of a web server: 0 on the internet, 1 in a private network, 2 on the link, 3 this machine."""
    try:
        found = {info[4][0] for info in socket.getaddrinfo(urlsplit(address).hostname, None)}
    except OSError:  # a proxy may know it
        return [0]
    out = []
    for text in found:
        ip = ipaddress.ip_address(text)
        ip = getattr(ip, "ipv4_mapped", None) or ip
        out.append(3 if ip.is_loopback or ip.is_unspecified else 2 if ip.is_link_local else int(not ip.is_global))
    return out


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Handler that follows redirects, but not from https to http, nor to a server nearer to this machine."""

    def redirect_request(
        self, req: urllib.request.Request, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        if not is_web_address(newurl) or (req.type == "https" and not newurl.lower().startswith("https://")):
            raise ValueError(f"{newurl[:80]!r} after {req.type}")
        if max(_nearness(newurl)) > min(_nearness(req.full_url)):
            raise ValueError(f"{newurl[:80]!r} is nearer to this machine than the server")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


_OPENER = urllib.request.build_opener(_Redirects)


def open_web_file(request: urllib.request.Request) -> Any:
    """Return the answer to a request, which is repeated while the server is busy; CloudError if all tries fail."""
    address = request.full_url
    if not is_web_address(address):
        raise CloudError(f"{address}: not an http:// or https:// address")
    for left in reversed(range(_TRIES)):
        try:
            return _OPENER.open(request, timeout=_TIMEOUT)
        except urllib.error.HTTPError as error:
            if error.code in _ANSWERS:
                return error
            if error.code not in _BUSY or not left:
                raise CloudError(f"{address}: the server answers {error.code} {error.reason}; check it") from error
        except ValueError as error:  # a bad address, perhaps from a redirect
            raise CloudError(f"{address}: leads to an address that is none ({error}); check it") from error
        except _FAILURES as error:
            if not left:
                why = getattr(error, "reason", error)
                raise CloudError(f"{address}: cannot be reached ({why}); check address and network") from error
        time.sleep(_WAIT * 2 ** (_TRIES - 2 - left))
    raise AssertionError("not reached")


class RangeFile:
    """A file on a web server, read by range requests, with the methods that laspy's reader needs.

    Attributes:
        requests: number of requests so far.
        received: bytes received so far.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._at = 0
        self._block, self._begin = b"", 0
        self.requests = 0
        self.received = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a byte counted from the beginning or from the current one."""
        self._at = offset + (self._at if whence == os.SEEK_CUR else 0)
        if whence == os.SEEK_END or self._at < 0:
            raise OSError("can only be read from its beginning on")
        return self._at

    def tell(self) -> int:
        """Return the offset of the next byte."""
        return self._at

    def read(self, size: int) -> bytes:
        """Return ``size`` bytes, fewer at the file's end; CloudError if the server lacks it or serves no ranges."""
        begin = self._at - self._begin
        if not (begin >= 0 and begin + size <= len(self._block)):
            self._block, self._begin, begin = self._request(max(size, _BLOCK)), self._at, 0
        piece = self._block[begin : begin + size]
        self._at += len(piece)
        return piece

    def close(self) -> None:
        """Drop the buffer."""
        self._block = b""

    def _request(self, size: int) -> bytes:
        span = f"bytes={self._at}-{self._at + size - 1}"
        with open_web_file(urllib.request.Request(self._address, headers={"Range": span})) as answer:
            self.requests += 1
            if answer.status == http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
                return b""
            if answer.status != http.client.PARTIAL_CONTENT:
                raise CloudError(
                    f"{self._address}: the server serves no parts of files; download it, or name it without --window"
                )
            try:
                raw: bytes = answer.read(size)
            except _FAILURES as error:
                raise CloudError(f"{self._address}: broke off ({error}); try again") from error
        self.received += len(raw)
        return raw
