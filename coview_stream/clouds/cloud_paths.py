"""Cloud files by name, folder or pattern."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable
from pathlib import Path

from coview_stream.clouds.files import CLOUD_SUFFIXES, is_cloud_name
from coview_stream.errors import CloudError


def expand_cloud_paths(given: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return the files that names, folders and patterns (``tiles/*.laz``) mean, in natural order within each.

    Of a folder those that are clouds by their suffix, not those in folders within it; hidden files and unfinished ones
    (``.part``) are none. A file that is named is returned whatever it is, for its reader to judge.

    Raises:
        CloudError: a folder or a pattern holds no cloud.
    """
    out: list[Path] = []
    for path in map(Path, given):
        if path.is_dir():
            found = sorted(filter(is_cloud_name, path.iterdir()), key=natural_key)
            if not found:
                raise CloudError(f"{path}: holds no cloud ({', '.join(sorted(CLOUD_SUFFIXES))}); {_instead(path)}")
            out += found
        elif not path.exists() and glob.has_magic(str(path)):  # where the shell has not expanded it
            names = glob.glob(str(path), recursive=True)  # noqa: PTH207 - Path.glob takes no absolute pattern
            found = sorted(map(Path, names), key=natural_key)
            out += [name for name in found if is_cloud_name(name) and name.is_file()]
            if not any(map(is_cloud_name, found)):
                raise CloudError(f"{path}: no cloud has such a name; check the pattern")
        else:
            out.append(path)
    return out


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Return a key by which ``tile2`` comes before ``tile10``."""
    parts = re.split(r"(\d+)", str(path))
    return tuple((1, int(part), "") if k % 2 else (0, 0, part) for k, part in enumerate(parts))


def _instead(folder: Path) -> str:
    within = next(
        (sub for sub in sorted(folder.iterdir()) if sub.is_dir() and any(map(is_cloud_name, sub.iterdir()))), None
    )
    return "name another folder, or the files" if within is None else f"did you mean {within}?"
