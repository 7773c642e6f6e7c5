"""Files that are complete or not there: written under another name beside their place, then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_path(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """Yield a name that becomes ``path`` at the end of the block, or is deleted if the block raises.

    Args:
        path: the file's name; a file that is there stays whole until the new one is complete.
        temporary: the name to write under, in the same directory; by default one of this process's own.

    Raises:
        OSError: the file cannot be renamed.
    """
    part = temporary or path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


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
