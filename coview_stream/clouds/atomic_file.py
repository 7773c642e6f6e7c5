"""Files that are complete or not there: written under another name beside their place, then renamed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_path(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """Yield a name that becomes ``path`` at the end of the block, or is deleted if the block raises.

    What processes that were killed have left of the same file is deleted first.

    Args:
        path: the file's name; a file that is there stays whole until the new one is complete.
        temporary: the name to write under, in the same directory; by default one of this process's own.

    Raises:
        OSError: the file cannot be renamed.
    """
    part = temporary or path.with_name(f".{path.name}.{os.getpid()}.part")
    if temporary is None:
        _remove_left(path)
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _remove_left(path: Path) -> None:
    """Delete the parts of ``path`` whose processes are gone; any other file of such a name is left alone."""
    begin, end = f".{path.name}.", ".part"
    with contextlib.suppress(OSError):  # the writing that follows says what is wrong with the directory
        for entry in os.scandir(path.parent):
            process = entry.name[len(begin) : -len(end)]
            if not (entry.name.startswith(begin) and entry.name.endswith(end) and process.isascii()):
                continue
            if process.isdigit() and 0 < int(process) < 1 << 31 and not _lives(int(process)):
                Path(entry.path).unlink(missing_ok=True)


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
