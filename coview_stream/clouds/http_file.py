"""Files of web servers: whole ones, and parts of them by HTTP range requests, with limits on time and size."""

from __future__ import annotations

import http.client
import os
import shutil
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from coview_stream.errors import CloudError

_TIMEOUT = 30.0  # seconds without a byte; set by hand, as all that follows
_TRIES = 4
_WAIT = 0.5  # seconds before the second try, twice as many before each further one
_BLOCK = 1 << 16  # bytes that are asked for at least: a header, its records and a hierarchy are many small reads
_ANSWERS = (http.client.NOT_MODIFIED, http.client.REQUESTED_RANGE_NOT_SATISFIABLE)
_AGAIN = (408, 425, 429, 500, 502, 503, 504)
_FAILURES = (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError)


def is_web_address(name: str | os.PathLike[str]) -> bool:
    """Tell whether a name is an address of a web server."""
    return str(name).lower().startswith(("http://", "https://"))


class HttpFile:
    """A file of a web server that is read in parts, as far as ``read``, ``seek``, ``tell`` and ``close`` go.

    Attributes:
        requests: that were made.
        received: bytes that came.
    """

    def __init__(self, address: str) -> None:
        """Take an address; nothing is asked for yet."""
        self._address = address
        self._at = 0
        self._block, self._begin = b"", 0
        self.requests = 0
        self.received = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a byte from the beginning, or from here."""
        self._at = offset + (self._at if whence == os.SEEK_CUR else 0)
        if whence == os.SEEK_END or self._at < 0:
            raise OSError("can only be read from its beginning on")
        return self._at

    def tell(self) -> int:
        """Return the byte that is read next."""
        return self._at

    def read(self, size: int) -> bytes:
        """Return as many bytes, less at the end of the file.

        Raises:
            CloudError: the server cannot be reached, has no such file, or does not serve parts of it.
        """
        begin = self._at - self._begin
        if not (begin >= 0 and begin + size <= len(self._block)):
            self._block, self._begin, begin = self._ranged(self._at, max(size, _BLOCK)), self._at, 0
        found = self._block[begin : begin + size]
        self._at += len(found)
        return found

    def close(self) -> None:
        """Forget what was read."""
        self._block = b""

    def _ranged(self, begin: int, size: int) -> bytes:
        request = urllib.request.Request(self._address, headers={"Range": f"bytes={begin}-{begin + size - 1}"})
        with open_web_file(request) as answer:
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


def download(address: str, target: Path) -> int:
    """Write a file of a web server to ``target``, and return its bytes.

    Raises:
        CloudError: the server cannot be reached, has no such file, or broke off. OSError: it cannot be written.
    """
    with open_web_file(urllib.request.Request(address)) as answer, target.open("wb") as file:
        try:
            shutil.copyfileobj(answer, file, 1 << 20)
        except _FAILURES as error:
            raise CloudError(f"{address}: broke off after {file.tell()} bytes ({error}); try again") from error
        size, promised = file.tell(), answer.headers.get("Content-Length")
    if promised is not None and promised.isdigit() and int(promised) != size:
        raise CloudError(f"{address}: broke off after {size} of {promised} bytes; try again")
    return size


def open_web_file(request: urllib.request.Request) -> Any:
    """Return the answer to a request, after some tries where a server is busy.

    Raises:
        CloudError: the address is none of a web server, it cannot be reached, or does not give the file.
    """
    address = request.full_url
    if not is_web_address(address):
        raise CloudError(f"{address}: not an http:// or https:// address")
    for left in reversed(range(_TRIES)):
        try:
            return urllib.request.urlopen(request, timeout=_TIMEOUT)
        except urllib.error.HTTPError as error:
            if error.code in _ANSWERS:
                return error
            if error.code not in _AGAIN or not left:
                raise CloudError(f"{address}: the server answers {error.code} {error.reason}; check it") from error
        except _FAILURES as error:
            if not left:
                why = getattr(error, "reason", error)
                raise CloudError(f"{address}: cannot be reached ({why}); check address and network") from error
        time.sleep(_WAIT * 2 ** (_TRIES - 2 - left))
    raise AssertionError("not reached")
