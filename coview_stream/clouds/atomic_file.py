"""Atomic files: written under a temporary name in the same directory, then renamed."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

_ABANDONED = 86_400.0  # seconds since the last write after which any partial file is deleted
_BOOT = Path("/proc/sys/kernel/random/boot_id")


@contextmanager
def atomic_path(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """Yield a path that is renamed to ``path`` at the end of the block, or deleted if the block raises.

    An existing file stays whole until the new one is complete. ``temporary`` is the path to write to, in the same
    directory, by default unique to this process. Partial files that killed processes have left are deleted first: at
    once if written on this host and in this process namespace, otherwise after a day, as their processes are invisible.
    """
    part = temporary or path.with_name(f".{path.name}.{_host()}.{os.getpid()}.part")
    if temporary is None:
        _remove_left(path)
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _remove_left(path: Path) -> None:
    """Delete partial files of ``path`` whose writer has ended."""
    form = re.compile(re.escape(f".{path.name}.") + r"(?:([0-9a-f]{8})\.)?([0-9]{1,10})\.part")
    with contextlib.suppress(OSError):  # the write reports a bad directory
        for entry in os.scandir(path.parent):
            match = form.fullmatch(entry.name)
            if match is None or not 0 < (process := int(match[2])) < 1 << 31:
                continue
            dead = False
            if match[1] == _host():
                try:
                    os.kill(process, 0)
                except OSError as error:  # another user's process is alive
                    dead = isinstance(error, ProcessLookupError)
            if dead or time.time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED:
                Path(entry.path).unlink(missing_ok=True)


def _host() -> str:
    """Return a short name of this host, its process namespace (one per container) and its boot.

    The boot id distinguishes hosts cloned from one image, which share name and namespace number.
    """
    try:
        namespace, boot = Path("/proc/self/ns/pid").stat().st_ino, _BOOT.read_text()
    except OSError:
        namespace, boot = 0, ""
    return f"{zlib.crc32(f'{platform.node()} {namespace} {boot}'.encode()):08x}"


@contextmanager
def atomic_file(path: Path, *, sync: bool = False, private: bool = False) -> Iterator[BinaryIO]:
    """Open a binary stream that becomes ``path`` at the end of the block (:func:`atomic_path`); OSError if it cannot.

    With ``sync`` the file is flushed to disk before it is renamed; otherwise a power cut may leave an empty file. Only
    its owner can read a ``private`` file, and a link in place of its temporary file is not followed.
    """
    flags, mode = (os.O_EXCL, 0o600) if private else (os.O_TRUNC, 0o666)
    flags |= os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0)
    with atomic_path(path) as part, os.fdopen(os.open(part, flags, mode), "wb") as stream:
        yield stream
        if sync:
            stream.flush()
            os.fsync(stream.fileno())
