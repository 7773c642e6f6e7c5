"""Check that this Python has installed what a lock says, at these versions, and nothing else.

    ENVIRONMENT/bin/python .ci/check_lock.py .ci/lock/wheel-cp311-linux-x86_64.txt

The hashes were pip's to check (``--require-hashes``): they are of the archives, which are gone. Exit code 1 names each
package that is another, missing, or not locked.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from importlib.metadata import distributions
from pathlib import Path

_LOCKED = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;]+)", re.M)
_NOT_LOCKED = {"coview-stream", "pip", "setuptools"}  # ours, and what venv puts into an environment


def plain(name: str) -> str:
    """Return a name as locks have it; by ourselves, for the environment need not have packaging."""
    return re.sub("[-_.]+", "-", name).lower()


def installed() -> dict[str, str]:
    """Return the versions, by name, that this Python has."""
    return {plain(each.metadata["Name"]): each.version for each in distributions() if each.metadata["Name"]}


def differences(locked: Mapping[str, str], there: Mapping[str, str]) -> Iterator[str]:
    """Yield a line for each package that is not as it is locked."""
    for name in sorted((locked.keys() | there.keys()) - _NOT_LOCKED):
        if name not in there:
            yield f"{name} {locked[name]} is locked and not installed"
        elif name not in locked:
            yield f"{name} {there[name]} is installed and not locked"
        elif locked[name] != there[name]:
            yield f"{name} {there[name]} is installed, {locked[name]} is locked"


def main(path: str) -> int:
    """Check; return the exit code."""
    locked = {plain(name): version for name, version in _LOCKED.findall(Path(path).read_text())}
    found = list(differences(locked, installed()))
    sys.stdout.write("".join(f"{path}: {line}\n" for line in found))
    sys.stdout.write(f"{path}: {len(locked)} packages, {len(found)} differences\n")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
