"""Files that are complete or not there: written under another name beside their place, then renamed."""

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

_ABANDONED = 86_400.0  # seconds since the last write, after which a partial file is deleted; set by hand
_BOOT = Path("/proc/sys/kernel/random/boot_id")


@contextmanager
def atomic_path(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """Yield a name that becomes ``path`` at the end of the block, or is deleted if the block raises.

    What processes that were killed have left of the same file is deleted first: those of this host and its process
    numbers at once, others, whose processes cannot be seen from here or were before the host's last start, after a day.

    Args:
        path: the file's name; a file that is there stays whole until the new one is complete.
        temporary: the name to write under, in the same directory; by default one of this process's own.

    Raises:
        OSError: the file cannot be renamed.
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
    """Delete partial files of ``path`` whose writer has ended; any other file of such a name stays."""
    form = re.compile(re.escape(f".{path.name}.") + r"(?:([0-9a-f]{8})\.)?([0-9]{1,10})\.part")
    with contextlib.suppress(OSError):  # the writing that follows says what is wrong with the directory
        for entry in os.scandir(path.parent):
            found = form.fullmatch(entry.name)
            if found is None or not 0 < (process := int(found[2])) < 1 << 31:
                continue
            ours = found[1] == _host() and not _lives(process)
            if ours or time.time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED:
                Path(entry.path).unlink(missing_ok=True)


def _host() -> str:
    """Return a short name of this start of this host and of its process numbers, of which each container has its own.

    Hosts that are copies of one image have the same name, and the same number for the processes outside of containers.
    """
    try:
        numbers, start = Path("/proc/self/ns/pid").stat().st_ino, _BOOT.read_text()
    except OSError:
        numbers, start = 0, ""
    return f"{zlib.crc32(f'{platform.node()} {numbers} {start}'.encode()):08x}"


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is of another user
        return True
    return True


@contextmanager
def atomic_file(path: Path, *, sync: bool = False, temporary: Path | None = None) -> Iterator[BinaryIO]:
    """Open a binary stream that becomes ``path`` at the end of the block, or is deleted if the block raises.

    Args:
        path: as for :func:`atomic_path`.
        sync: wait until the disk has the bytes before the name changes, so that a power cut leaves no empty file.
        temporary: as for :func:`atomic_path`.

    Raises:
        OSError: the directory does not exist or cannot be written.
    """
    with atomic_path(path, temporary) as part, part.open("wb") as stream:
        yield stream
        if sync:
            stream.flush()
            os.fsync(stream.fileno())
